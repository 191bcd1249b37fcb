//! Describes what the beginning of a file looks like, for users who gave the wrong one.

use super::{Format, table};

/// How many bytes to look at.
pub(crate) const HEAD_BYTES: usize = 512;

/// Other files that users mistake for traces, by their first bytes.
const KNOWN: [(&[u8], &str); 17] = [
    (b"PK\x03\x04", "a ZIP archive or spreadsheet"),
    (b"%PDF", "a PDF document"),
    (b"\x7FELF", "a program"),
    (b"\x89PNG", "a picture"),
    (b"7z\xBC\xAF\x27\x1C", "a 7z archive"),
    (b"Rar!", "a RAR archive; unpack it first"),
    (b"icsbin", "a file of Vehicle Spy (.vsb), which saves traces as CSV or ASC, too"),
    (b"MATLAB 5.0 MAT-file", "a file of MATLAB, whose writetable makes a CSV of a table of frames"),
    (b"VERSION \"", "a DBC database"),
    (b"<", "XML or HTML"),
    (b"{", "JSON"),
    (b"[", "JSON or settings"),
    (b"FormatVersion=", "a SYM database"),
    (b"\"No.\",\"Time\",", LIST_OF_WIRESHARK),
    (b"No.     Time ", LIST_OF_WIRESHARK),
    (b"Frame 1: ", LIST_OF_WIRESHARK),
    (
        b"Generic File",
        "a compressed or encrypted file of a CANedge logger (.MFC, .MFE, .MFM): its maker's converters make an MF4 of it, which is read here",
    ),
];

const LIST_OF_WIRESHARK: &str = "a list of packets that Wireshark printed, in which its newer versions have no bytes of frames: what it saves as pcapng has all, and is read here";

/// What else than a trace a file with this beginning is, if that is known.
pub(crate) fn known(head: &[u8]) -> Option<&'static str> {
    if head.get(257..262) == Some(b"ustar") {
        return Some("a tar archive; `tar -xf` unpacks it");
    }
    let text = head.trim_ascii_start();
    KNOWN.iter().find(|(begin, _)| text.starts_with(begin)).map(|(_, what)| *what)
}

/// What a file with this beginning looks like. `read_as` is the format it was taken for.
pub(crate) fn looks_like(head: &[u8], read_as: Format) -> String {
    let text = head.trim_ascii();
    if text.is_empty() {
        return if head.is_empty() { "an empty file" } else { "nothing but spaces" }.to_owned();
    }
    if let Some(format) = Format::of_content(head).filter(|format| !format.is_kind_of(read_as)) {
        return format!("a trace in the format {format}");
    }
    if let Some(what) = known(head) {
        return what.to_owned();
    }
    let line = text.split(|byte| matches!(byte, b'\n' | b'\r')).next().unwrap_or_default();
    if line.iter().any(|byte| *byte < b' ' && *byte != b'\t') {
        if read_as == Format::Parquet {
            return "a Parquet file that is damaged, or whose columns are not those of a trace, such as time, id and data"
                .to_owned();
        }
        if Format::of_content(head).is_some() {
            return format!("a file of the format {read_as} that is damaged or has nothing usual in it");
        }
        let bytes: Vec<_> = head.iter().take(8).map(|byte| format!("{byte:02X}")).collect();
        return format!("binary data that begins with {}", bytes.join(" "));
    }
    if is_of_journal(line) {
        return "lines of a system's journal: `journalctl -o cat` prints what the program wrote, without what stands before it".to_owned();
    }
    let line = String::from_utf8_lossy(line);
    let shown: String =
        line.chars().filter(|character| !cantap_trace::clean::is_harmful(*character)).take(60).collect();
    let more = if shown.len() < line.len() { "…" } else { "" };
    let text = format!("text that begins with '{shown}{more}'");
    // Read as a table in certain columns, it may be one in others.
    let is_table = matches!(read_as, Format::Csv(_) | Format::Table);
    let of_names = table::proposal(head).filter(|_| is_table);
    // Names that say nothing may be those of a row.
    let said = of_names.clone().filter(|columns| columns != "time=?,id=?,data=?");
    match said.or_else(|| table::proposal_of_rows(head)).or(of_names) {
        Some(mut columns) => {
            columns.retain(|character| !cantap_trace::clean::is_harmful(character));
            format!("{text}; if it is a table of frames, say what its columns are: --columns '{columns}'")
        }
        None => text,
    }
}

/// Whether a line is one of syslog: month, day, time of day, computer, program.
fn is_of_journal(line: &[u8]) -> bool {
    let mut words = line.split(|byte| *byte == b' ').filter(|word| !word.is_empty());
    let is_month =
        words.next().is_some_and(|word| word.len() == 3 && word.iter().all(u8::is_ascii_alphabetic));
    let is_day = words.next().is_some_and(|word| word.len() <= 2 && word.iter().all(u8::is_ascii_digit));
    let is_clock = words.next().is_some_and(|word| memchr::memchr_iter(b':', word).count() == 2);
    is_month && is_day && is_clock && words.nth(1).is_some_and(|word| word.ends_with(b":"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_trace_is_told_in_words() {
        for (head, words) in [
            (&b""[..], "an empty file"),
            (b"PK\x03\x04....", "a ZIP archive or spreadsheet"),
            (b"%PDF-1.7", "a PDF document"),
            (&[&[b'a'; 257][..], b"ustar\0"].concat(), "a tar archive; `tar -xf` unpacks it"),
            (b"icsbin\x02", "a file of Vehicle Spy (.vsb), which saves traces as CSV or ASC, too"),
            (b"(1.0) can0 123#11\n", "a trace in the format candump"),
            (b"\0\x01\x02", "binary data that begins with 00 01 02"),
            (
                b"\"No.\",\"Time\",\"Source\",\"Destination\",\"Protocol\",\"Length\",\"Info\"\n\"1\",\"0.0\",\"\",\"\",\"CAN\",\"16\",\"ID: 291 (0x123), Length: 8\"\n",
                LIST_OF_WIRESHARK,
            ),
            (b"dear diary\ntoday", "text that begins with 'dear diary'"),
            (b"\xFF\xFEa", "text that begins with '\u{FFFD}\u{FFFD}a'"),
        ] {
            assert_eq!(looks_like(head, Format::Asc), words);
        }
        let journal = b"Nov 14 22:13:20 pi candump[812]:  can0  123   [2]  11 22";
        assert!(looks_like(journal, Format::Candump).starts_with("lines of a system's journal"));
        let words = "a file of the format blf that is damaged or has nothing usual in it";
        assert_eq!(looks_like(b"LOGG\x90\0\0\0", Format::Blf), words);
        assert!(
            looks_like(b"PAR1\x15\x04\x15", Format::Parquet)
                .contains("whose columns are not those of a trace")
        );
        assert_eq!(looks_like(b"date nonsense", Format::Asc), "text that begins with 'date nonsense'");
    }
}
