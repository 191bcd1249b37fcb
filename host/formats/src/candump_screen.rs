//! candump's screen output: `(time) can0 123 [8] 11 22 33 44 55 66 77 88 '.."3DUfw'`, with any of its options for times
//! (`-t a`, `-t d`, `-t z`, `-t A`), `-x` and `-a`, with or without colours.

use super::battery_emulator;
use super::date_time_ns;
use super::error_frames::ErrorFrames;
use super::frame_fields::{FdFields, FrameFields, Payload, hex_byte, identifier};
use super::interfaces::Interfaces;
use super::issue::Fault;
use super::row_format::{Line, RowFormat};
use super::text::{self, NS_PER_S};
use super::zone::Zone;
use cantap_trace::socketcan::ERROR_FLAG;
use cantap_trace::{Direction, TraceRecord};

const NO_TIMES: &str = "frames have no time: candump shows one with -t a";
const DIFFERENCES: &str = "times are added up: candump showed the differences from frame to frame (-t d)";

/// Reads candump's screen output.
#[derive(Default)]
pub(crate) struct Decoder {
    interfaces: Interfaces,
    errors: ErrorFrames,
    /// Whether times are differences.
    differences: bool,
    last_ns: i64,
    /// What to report about the last line.
    note: Option<&'static str>,
}

/// Whether a line is in this format.
pub(crate) fn is_line(line: &[u8]) -> bool {
    let line = plain(line);
    if battery_emulator::is_line(&line) {
        return false;
    }
    let Some((_, rest)) = stamp(&line) else { return false };
    let mut words = rest.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
    // The interface, which may be missing, the columns of -x, the identifier, then the length.
    let mut before = words.next().unwrap_or_default();
    for word in words.take(5) {
        if length(word).is_some() {
            return number(before).is_some();
        }
        before = word;
    }
    false
}

/// Whether a line is the command itself, with or without what a shell shows before it, or what the first candump printed about its interface.
pub(crate) fn is_command(line: &[u8]) -> bool {
    let command = memchr::memmem::find(line, b"$ ").map_or(line, |at| &line[at + 2..]).trim_ascii();
    command.starts_with(b"candump ") || line.starts_with(b"interface = ")
}

/// An identifier, and whether it has 29 bits: three digits or eight, `<0x123>` as the first candump wrote it, or four digits, of which the first
/// is 0, as people's own programs do.
fn number(word: &[u8]) -> Option<(u32, bool)> {
    let digits = word.strip_prefix(b"<0x").and_then(|word| word.strip_suffix(b">")).unwrap_or(word);
    let is_extended = match digits {
        [_, _, _] | [b'0', _, _, _] => false,
        _ => (digits.len() == 8).then_some(true)?,
    };
    text::hex(digits).map(|raw| (raw, is_extended))
}

/// `[8]` for a classical frame, `[08]` for one of CAN FD, `{F}` for a length code above 8.
fn length(word: &[u8]) -> Option<(u8, bool)> {
    match word {
        [b'[', digit @ b'0'..=b'8', b']'] => Some((digit - b'0', false)),
        [b'{', digit, b'}'] => text::hex_digit(*digit).filter(|code| *code > 8).map(|code| (code, false)),
        [b'[', tens, ones, b']'] => {
            let len = text::decimal(&[*tens, *ones]).filter(|len| *len <= 64)?;
            Some((len as u8, true))
        }
        _ => None,
    }
}

/// A line without its colour sequences: `ESC [`, numbers, `m`. Any other use of the character stays, and the line is then not a row.
fn plain(line: &[u8]) -> std::borrow::Cow<'_, [u8]> {
    const ESCAPE: u8 = 0x1B;
    if !line.contains(&ESCAPE) {
        return line.into();
    }
    let (mut out, mut rest) = (Vec::with_capacity(line.len()), line);
    while let [first, after @ ..] = rest {
        let colour = after.strip_prefix(b"[").filter(|_| *first == ESCAPE).and_then(|numbers| {
            let digits = numbers.iter().take_while(|byte| byte.is_ascii_digit() || **byte == b';').count();
            numbers[digits..].strip_prefix(b"m")
        });
        rest = colour.unwrap_or_else(|| {
            out.push(*first);
            after
        });
    }
    out.into()
}

/// The time in parentheses at the beginning of a line, empty if there is none, and the text after it.
fn stamp(line: &[u8]) -> Option<(&[u8], &[u8])> {
    let line = line.trim_ascii();
    match line.strip_prefix(b"(") {
        None => Some((b"", line)),
        Some(rest) => {
            let end = memchr::memchr(b')', rest)?;
            Some((rest[..end].trim_ascii(), &rest[end + 1..]))
        }
    }
}

/// Whether times that begin at about zero are differences. Times from the start would not go back, and no two frames on a
/// bus have the same one.
fn are_differences(times: &[i64]) -> bool {
    let pairs = || times.windows(2).map(|pair| (pair[0], pair[1]));
    let same = pairs().filter(|(before, after)| before == after && *after > 0).count();
    pairs().any(|(before, after)| after < before) || 2 * same > times.len().saturating_sub(1)
}

impl RowFormat for Decoder {
    fn begin(&mut self, buffered: &[u8]) {
        const ENOUGH: usize = 1000;
        let time = |line: &[u8]| {
            let line = plain(line);
            let (time, _) = stamp(&line)?;
            text::time(time, NS_PER_S, b'.')
        };
        let lines = buffered.split(|byte| *byte == b'\n');
        let times: Vec<i64> = lines.filter_map(time).take(ENOUGH).collect();
        let from_start = times.first().is_some_and(|first| *first < NS_PER_S);
        self.differences = from_start && are_differences(&times);
    }

    fn line(&mut self, line: &[u8], zone: &Zone) -> Result<Line, Fault> {
        let line = plain(line);
        // The explanation of an error frame (-e) is on the lines below it.
        // Comments are those of the people who kept it, and `--` is what grep writes between parts.
        let is_other = line.starts_with(b"\t") || is_comment(&line) || *line == *b"--";
        if line.is_empty() || is_other || is_command(&line) {
            return Ok(Line::Nothing);
        }
        let missing = || Fault::malformed("a line of candump such as 'can0  123   [2]  11 22'", &line);
        let (time, rest) = stamp(&line).ok_or_else(missing)?;
        let row = self.row(&line, time, rest, zone)?;
        if time.is_empty() {
            self.note = Some(NO_TIMES);
        } else if self.differences {
            self.note = Some(DIFFERENCES);
        }
        Ok(row)
    }

    fn note(&mut self) -> Option<&'static str> {
        self.note.take().or_else(|| self.errors.note())
    }

    fn trims(&self) -> bool {
        false
    }

    fn may_be_cut(&self, line: &[u8], record: &TraceRecord) -> bool {
        // There are as many bytes as the length says.
        record.frame().is_none_or(cantap_trace::TraceFrame::is_remote) && !line.ends_with(b"remote request")
    }
}

impl Decoder {
    fn row(&mut self, line: &[u8], time: &[u8], rest: &[u8], zone: &Zone) -> Result<Line, Fault> {
        let missing = || Fault::malformed("a line of candump such as 'can0  123   [2]  11 22'", line);
        let time_ns = self.time(time, zone)?;
        let (first, behind) = text::word(rest);
        // Without an interface, the length follows the first word.
        let (interface, rest) = match number(first).and(length(text::word(behind).0)) {
            Some(_) => (&b"can0"[..], rest),
            None => (first, behind),
        };
        let (mut id, mut rest) = text::word(rest);
        let (mut direction, mut flags) = (Direction::Rx, FdFields::default());
        if let b"RX" | b"TX" = id {
            direction = if id == b"TX" { Direction::Tx } else { Direction::Rx };
            let (brs, behind) = text::word(rest);
            let (esi, behind) = text::word(behind);
            flags = FdFields { brs: brs == b"B", esi: esi == b"E" };
            (id, rest) = text::word(behind);
        }
        let (len, rest) = text::word(rest);
        let (raw, is_extended) = number(id).ok_or_else(missing)?;
        let (len, is_fd) = length(len).ok_or_else(missing)?;
        let channel = self.interfaces.channel(interface);
        let record = |event| TraceRecord { time_ns, device_ns: None, channel, event };
        let mut words = rest.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        if is_extended && raw & ERROR_FLAG != 0 {
            let data = Payload::words(words, usize::from(len.min(8)), hex_byte)?;
            let (event, second) = self.errors.read(raw, data.first_eight());
            return Ok(match second {
                Some(second) => Line::Two(record(event), second),
                None => Line::Record(record(event)),
            });
        }
        let remote = rest.trim_ascii().starts_with(b"remote request");
        let fd = is_fd.then_some(flags);
        let id = identifier(raw, is_extended, id)?;
        let fields = FrameFields { id, remote, direction, len, fd };
        let (shown, _) = text::word(rest);
        let swapped: Vec<_> = shown.rsplit(|byte| *byte == b'`').collect();
        if swapped.len() > 1 {
            let data = Payload::exactly(swapped.into_iter(), fields.data_len(), byte)?;
            return Ok(Line::Record(record(fields.event(&data)?)));
        }
        let data = Payload::words(&mut words, fields.data_len(), byte)?;
        // With a byte too many, the length is wrong: a digit was changed.
        if !remote && words.next().and_then(byte).is_some() {
            return Err(Fault::malformed(format!("{len} data bytes"), rest.trim_ascii()));
        }
        Ok(Line::Record(record(fields.event(&data)?)))
    }

    fn time(&mut self, time: &[u8], zone: &Zone) -> Result<i64, Fault> {
        if time.is_empty() {
            return Ok(self.last_ns);
        }
        let fault =
            || Fault::malformed("a time such as 1436509052.249713 or 2015-07-10 08:17:32.249713", time);
        let time_ns = match text::time(time, NS_PER_S, b'.') {
            Some(difference_ns) if self.differences => self.last_ns.saturating_add(difference_ns),
            Some(time_ns) => time_ns,
            None => {
                let clock = std::str::from_utf8(time).ok().and_then(date_time_ns);
                zone.utc_ns(clock.ok_or_else(fault)?)
            }
        };
        self.last_ns = time_ns;
        Ok(time_ns)
    }
}

/// A byte: two hexadecimal digits, or eight binary ones (`-i`).
fn byte(word: &[u8]) -> Option<u8> {
    let is_binary = word.len() == 8 && word.iter().all(|digit| matches!(digit, b'0' | b'1'));
    if is_binary {
        return Some(word.iter().fold(0, |byte, digit| byte << 1 | (digit - b'0')));
    }
    hex_byte(word)
}

/// From the beginning, or in front of words: a bracket before a time can be damaged to this character.
fn is_comment(line: &[u8]) -> bool {
    let words = line.trim_ascii_start().strip_prefix(b"#").map(<[u8]>::trim_ascii_start);
    line.starts_with(b"#") || words.is_some_and(|words| !words.first().is_some_and(u8::is_ascii_digit))
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::Format;

    fn as_log(screen: &str) -> (String, Vec<String>) {
        tests::as_log(Format::CandumpScreen, screen)
    }

    /// As `candump can0 | grep -A1 7DF` leaves them, with comments of the people who kept them.
    #[test]
    fn what_grep_puts_between_parts_is_no_fault() {
        let (log, issues) = as_log("--\n  # answers\n  can0  7DF   [2]  01 00\n--\n  can0  7E8   [1]  02\n");
        assert_eq!((log.lines().count(), issues), (2, vec![]));
        let file = b"--\n  can0  7DF   [2]  01 00\n";
        assert_eq!(Format::of_content(file), Some(Format::CandumpScreen));
    }

    #[test]
    fn every_kind_of_line_is_read() {
        let (log, issues) = as_log(
            " (1436509052.249713)  vcan0  RX - -  044   [8]  2A 36 6E 4C 11 22 33 44   '*6nL.\"3D'\n \
             (1436509052.249714)  vcan0  TX - -  18DAF110   [0] \n (1436509052.249715)  vcan0  RX - -  123   [2]  remote request\n \
             (1436509052.249716)  vcan0  RX - -  321   {F}  01 02 03 04 05 06 07 08\n \
             (1436509052.249717)  vcan1  RX - -  20000088   [8]  00 00 04 00 00 00 00 00   ERRORFRAME\n\
             \tprotocol-violation{{bit-stuffing-error}{}}\n\tbus-error\n \
             (1436509052.249718)  vcan1       \x1b[1;31m7FF\x1b[0m   [1]  AA\n",
        );
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            log,
            "(1436509052.249713) can0 044#2A366E4C11223344\n(1436509052.249714) can0 18DAF110# T\n\
             (1436509052.249715) can0 123#R2\n(1436509052.249716) can0 321#0102030405060708_F\n\
             (1436509052.249717) can1 20000088#0000040000000000\n(1436509052.249718) can1 7FF#AA\n"
        );
    }

    #[test]
    fn differences_are_added_up_and_times_from_the_start_are_not() {
        let lines = |times: [&str; 4]| times.map(|time| format!(" ({time})  can0  123   [1]  11\n")).concat();
        let differences = ["000.000000", "000.010000", "000.000500", "000.010000"];
        let (log, _) = as_log(&lines(differences));
        let stamps: Vec<_> = log.lines().map(|line| &line[..10]).collect();
        assert_eq!(stamps, ["(0.000000)", "(0.010000)", "(0.010500)", "(0.020500)"]);
        let even = ["000.000000", "000.010000", "000.010000", "000.010000"];
        assert!(as_log(&lines(even)).0.contains("(0.030000)"));
        let from_start = ["000.000000", "000.010000", "000.010000", "000.020500"];
        assert!(as_log(&lines(from_start)).0.contains("(0.020500)"));
        let absolute = ["2015-07-10 08:17:32.249713"; 4];
        assert!(as_log(&lines(absolute)).0.starts_with("(1436516252.249713)"));
    }

    /// As people keep it: with the command, from a program of their own, from the first candump of all.
    #[test]
    fn a_command_a_missing_interface_and_old_identifiers_are_read() {
        let (log, issues) = as_log(
            "pi@car:~ $ candump can0\n  can0  080   [0] \ncandump any\n0128 [2] 0b 61 \n18DAF110 [1] AA\n\
             interface = can0, family = 29, type = 3, proto = 1\n<0x18eeff01> [2] 05 a0 \n<0x123> [0]\n (1.5)  7FF [1] 00\n",
        );
        assert_eq!(issues, Vec::<String>::new());
        let lines = ["080#", "128#0B61", "18DAF110#AA", "18EEFF01#05A0", "123#"]
            .map(|frame| format!("(0.000000) can0 {frame}\n"));
        assert_eq!(log, format!("{}(1.500000) can0 7FF#00\n", lines.concat()));
        let (log, issues) = as_log("1128 [2] 0b 61\n<0x923> [0]\n<0x12> [0]\n0128 [2] 0b\n");
        assert_eq!((log.as_str(), issues.len()), ("", 4), "{issues:#?}");
    }

    /// With -S the last byte comes first, with marks between; with -i each has eight digits.
    #[test]
    fn swapped_and_binary_bytes_are_read() {
        let (log, issues) = as_log(
            "  can0  123   [3]  33`22`11   `3\".`\n  can0  123   [1]  11\n  can0  123   [2]  00010001 00100010\n\
             \x20 can0  123   [2]  00100010`00010001\n  can0  123   [2]  33`22`11\n  can0  123   [3]  22`11\n",
        );
        let lines = ["112233", "11", "1122", "1122"].map(|data| format!("(0.000000) can0 123#{data}\n"));
        assert_eq!(log, lines.concat());
        assert_eq!(issues.len(), 2, "{issues:?}");
    }

    #[test]
    fn frames_without_times_are_read_and_broken_lines_are_named() {
        let (log, issues) = as_log(
            "  can0  123   [2]  11 22\n  can0  123   [2]  11\n  can0  123   [2]  11 22 33\n  can0  1G3   [0]\n\
             rubbish\n (x)  can0  123   [0]\n  can0  923   [0]\n  can0  123   [9]  11\n  can0  123   [2]  1",
        );
        assert_eq!(log, "(0.000000) can0 123#1122\n");
        let line = "a line of candump such as 'can0  123   [2]  11 22'";
        let stamp = "a time such as 1436509052.249713 or 2015-07-10 08:17:32.249713";
        assert_eq!(
            issues,
            [
                "test, line 2: expected 2 data bytes, found nothing".to_owned(),
                "test, line 3: expected 2 data bytes, found '11 22 33'".to_owned(),
                format!("test, line 4: expected {line}, found '  can0  1G3   [0]'"),
                format!("test, line 5: expected {line}, found 'rubbish'"),
                format!("test, line 6: expected {stamp}, found 'x'"),
                "test, line 7: expected an identifier up to 7FF, or a mark that it is extended, found '923'"
                    .to_owned(),
                format!("test, line 8: expected {line}, found '  can0  123   [9]  11'"),
                "test, line 9: the file ends inside a line; everything before it was read".to_owned(),
            ]
        );
    }
}
