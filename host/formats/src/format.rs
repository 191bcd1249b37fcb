//! The formats by name, by suffix and by their first bytes.

use std::fmt;
use std::path::Path;
use std::str::FromStr;

use super::compression::Compression;
use super::csv::CsvDialect;
use super::trc::TrcVersion;
use super::{
    blf, busmaster, candump_screen, canhacker, canking, crtd, gvret, kvaser, mf4, microchip, pcap, pcapng,
    printer,
};

/// A trace file format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Format {
    /// can-utils' log, as `candump -l` writes it.
    Candump,
    /// Vector's text format.
    Asc,
    /// Vector's binary format.
    Blf,
    /// PEAK's trace. Reading takes the version from the file.
    Trc(TrcVersion),
    /// Comma-separated values. Reading takes the dialect from the file.
    Csv(CsvDialect),
    /// Wireshark's format, with SocketCAN packets.
    Pcapng,
    /// The older format of Wireshark and tcpdump.
    Pcap,
    /// The earlier CANanalyser's table in the format of old spreadsheets.
    Dif,
    /// ASAM MDF 4 with the traffic of buses, as loggers write it.
    Mf4,
    /// What candump shows on a screen.
    CandumpScreen,
    /// BUSMASTER's log.
    Busmaster,
    /// The log of the Open Vehicle Monitoring System.
    Crtd,
    /// Kvaser's text of a Memorator's log.
    Kvaser,
    /// The log of Microchip's CAN Bus Analyzer.
    Microchip,
    /// CANHacker's trace.
    CanHacker,
    /// What python-can's Printer prints.
    Printer,
    /// What Kvaser's CanKing shows.
    CanKing,
    /// python-can's table in an SQLite database.
    Sqlite,
}

/// The first bytes of an SQLite database.
const SQLITE_MAGIC: &[u8] = b"SQLite format 3\0";

/// Names, suffixes and a description of each format. The first name is the one shown; a suffix
/// selects the first format that has it.
const FORMATS: &[(Format, &[&str], &[&str])] = &[
    (Format::Candump, &["candump", "log"], &["log", "txt"]),
    (Format::Asc, &["asc"], &["asc"]),
    (Format::Blf, &["blf"], &["blf"]),
    (Format::Trc(TrcVersion::V2_1), &["trc", "trc2.1"], &["trc"]),
    (Format::Trc(TrcVersion::V2_0), &["trc2.0"], &[]),
    (Format::Trc(TrcVersion::V1_3), &["trc1.3"], &[]),
    (Format::Trc(TrcVersion::V1_2), &["trc1.2"], &[]),
    (Format::Trc(TrcVersion::V1_1), &["trc1.1"], &[]),
    (Format::Trc(TrcVersion::V1_0), &["trc1.0"], &[]),
    (Format::Csv(CsvDialect::PythonCan), &["csv", "csv-python-can"], &["csv"]),
    (Format::Csv(CsvDialect::Full), &["csv-full"], &[]),
    (Format::Csv(CsvDialect::Analyser), &["csv-analyser"], &[]),
    (Format::Csv(CsvDialect::Gvret), &["csv-gvret", "gvret"], &[]),
    (Format::Pcapng, &["pcapng"], &["pcapng", "ntar"]),
    (Format::Pcap, &["pcap"], &["pcap", "cap"]),
    (Format::Dif, &["dif"], &["dif"]),
    (Format::Mf4, &["mf4"], &["mf4", "mdf"]),
    (Format::CandumpScreen, &["candump-screen"], &["txt", "log"]),
    (Format::Busmaster, &["busmaster"], &["log"]),
    (Format::Crtd, &["crtd"], &["crtd", "crt"]),
    (Format::Kvaser, &["kvaser"], &["txt", "log"]),
    (Format::Microchip, &["microchip"], &["can"]),
    (Format::CanHacker, &["canhacker"], &["trc"]),
    (Format::Printer, &["printer"], &["txt", "log"]),
    (Format::CanKing, &["canking"], &["txt", "log"]),
    (Format::Sqlite, &["sqlite"], &["db", "sqlite", "sqlite3"]),
];

/// There is no such format.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum UnknownFormat {
    /// Not a format's name.
    #[error("'{0}' is not a trace format; the formats are {known}", known = Format::names())]
    Name(String),
    /// A file's suffix does not name a format.
    #[error("the name '{0}' does not show the format")]
    Suffix(String),
}

/// A format that can be read but not written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0} is a format that is only read; those that are written are {written}", written = Format::written_names())]
pub struct NotWritten(pub Format);

impl Format {
    /// Every format.
    pub fn all() -> impl Iterator<Item = Self> {
        FORMATS.iter().map(|(format, ..)| *format)
    }

    /// Whether files of the format can be written, not only read.
    pub fn is_written(self) -> bool {
        !matches!(
            self,
            Self::Pcap
                | Self::CandumpScreen
                | Self::Busmaster
                | Self::Crtd
                | Self::Kvaser
                | Self::Microchip
                | Self::CanHacker
                | Self::Printer
                | Self::CanKing
                | Self::Sqlite
        )
    }

    /// Whether its files begin with something other than a record, so that an empty file is not one of them.
    pub(crate) fn has_head(self) -> bool {
        !matches!(self, Self::Candump | Self::CandumpScreen | Self::Crtd | Self::Printer)
    }

    /// Every format that can be written.
    pub fn written() -> impl Iterator<Item = Self> {
        Self::all().filter(|format| format.is_written())
    }

    /// The names of the formats that can be written, for messages.
    pub fn written_names() -> String {
        Self::written().map(|format| format.to_string()).collect::<Vec<_>>().join(", ")
    }

    /// The names of all formats, for messages.
    pub fn names() -> String {
        FORMATS.iter().map(|(_, names, _)| names[0]).collect::<Vec<_>>().join(", ")
    }

    /// By a path's suffix; `.gz`, `.zst`, `.xz` and `.lz4` are skipped.
    pub fn of_path(path: &Path) -> Result<Self, UnknownFormat> {
        Self::all()
            .find(|format| format.has_suffix_of(path))
            .ok_or_else(|| UnknownFormat::Suffix(path.display().to_string()))
    }

    /// Whether a file of the format may have this name.
    pub(crate) fn has_suffix_of(self, path: &Path) -> bool {
        let name = path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        let (bare, _) = Compression::split(&name);
        let suffixes =
            FORMATS.iter().find(|(format, ..)| *format == self).map_or(&[][..], |(_, _, suffixes)| suffixes);
        bare.rsplit_once('.').is_some_and(|(_, suffix)| suffixes.contains(&suffix))
    }

    /// Whether both are read by the same reader: the content shows which version or dialect it is.
    pub fn is_kind_of(self, other: Self) -> bool {
        std::mem::discriminant(&self) == std::mem::discriminant(&other)
    }

    /// By a file's first bytes.
    pub fn of_content(head: &[u8]) -> Option<Self> {
        /// Where the header of a log names its program.
        const HEAD_BYTES: usize = 1024;
        let text = head[..head.len().min(HEAD_BYTES)].trim_ascii_start();
        let line = text.split(|byte| *byte == b'\n').next().unwrap_or_default().trim_ascii_end();
        if head.starts_with(blf::FILE_MAGIC) {
            Some(Self::Blf)
        } else if head.starts_with(mf4::FILE_MAGIC) || head.starts_with(mf4::UNFINISHED_MAGIC) {
            Some(Self::Mf4)
        } else if pcap::is_head(head) {
            Some(Self::Pcap)
        } else if head.starts_with(&pcapng::SECTION_HEADER.to_le_bytes()) {
            Some(Self::Pcapng)
        } else if text.starts_with(b"timestamp,") || text.starts_with(b"time,") || text.starts_with(b"Index")
        {
            Some(Self::Csv(CsvDialect::PythonCan))
        } else if text.starts_with(b"TABLE") {
            Some(Self::Dif)
        } else if gvret::is_head(line) {
            Some(Self::Csv(CsvDialect::Gvret))
        } else if head.starts_with(SQLITE_MAGIC) {
            Some(Self::Sqlite)
        } else if canking::is_head(line) {
            Some(Self::CanKing)
        } else if busmaster::is_head(text) {
            Some(Self::Busmaster)
        } else if kvaser::is_head(text) {
            Some(Self::Kvaser)
        } else if microchip::is_head(text) {
            Some(Self::Microchip)
        } else if canhacker::is_head(line) {
            Some(Self::CanHacker)
        } else if printer::is_line(line) {
            Some(Self::Printer)
        } else if candump_screen::is_line(line) {
            Some(Self::CandumpScreen)
        } else if crtd::is_line(line) {
            Some(Self::Crtd)
        } else if text.starts_with(b"(") {
            Some(Self::Candump)
        } else if is_asc(text) {
            Some(Self::Asc)
        } else if text.starts_with(b";$FILEVERSION")
            || text.starts_with(b";####")
            || line.starts_with(b";") && memchr::memmem::find(text, b"Start time:").is_some()
        {
            Some(Self::Trc(TrcVersion::V2_1))
        } else {
            // Comments of the people who kept it come before the log.
            let mut lines = text.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii_end);
            let first = lines.find(|line| !line.is_empty() && !line.starts_with(b"#"))?;
            if candump_screen::is_line(first) {
                Some(Self::CandumpScreen)
            } else {
                first.starts_with(b"(").then_some(Self::Candump)
            }
        }
    }
}

/// Whether a text begins like Vector's: with its date or the base of its numbers, possibly after comments.
fn is_asc(text: &[u8]) -> bool {
    let lines = text.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii_start);
    let mut lines = lines.skip_while(|line| line.is_empty() || line.starts_with(b"//"));
    let first = lines.next().unwrap_or_default();
    ["date ", "base hex", "base dec"]
        .iter()
        .any(|word| first.get(..word.len()).is_some_and(|start| start.eq_ignore_ascii_case(word.as_bytes())))
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = FORMATS.iter().find(|(format, ..)| format == self).map_or("", |(_, names, _)| names[0]);
        f.write_str(name)
    }
}

impl FromStr for Format {
    type Err = UnknownFormat;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let lower = text.to_ascii_lowercase();
        FORMATS
            .iter()
            .find(|(_, names, _)| names.contains(&lower.as_str()))
            .map(|(format, ..)| *format)
            .ok_or_else(|| UnknownFormat::Name(text.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_known_by_their_beginning() {
        let utf8 = |text: &str| text.as_bytes().to_vec();
        for (head, format) in [
            (utf8("(1410714882.622188) can0 123#11\n"), Format::Candump),
            (utf8("date Sam Sep 30 15:06:13.191 2017\n"), Format::Asc),
            (utf8("// a comment\n\ndate Sam Sep 30 15:06:13.191 2017\n"), Format::Asc),
            (utf8("base hex  timestamps absolute\n"), Format::Asc),
            (utf8(";   Start time: 18.12.2021 14:28:07.062\n;\n"), Format::Trc(TrcVersion::V2_1)),
            (utf8(";$FILEVERSION=1.1\n"), Format::Trc(TrcVersion::V2_1)),
            (utf8("LOGG\0\0\0\0"), Format::Blf),
            (utf8("MDF     4.10    "), Format::Mf4),
            (utf8("UnFinMF 4.11    "), Format::Mf4),
            (vec![0x0A, 0x0D, 0x0D, 0x0A], Format::Pcapng),
            (vec![0xD4, 0xC3, 0xB2, 0xA1], Format::Pcap),
            (vec![0xA1, 0xB2, 0x3C, 0x4D], Format::Pcap),
            (utf8("Time Stamp,ID,Extended,Dir,Bus,LEN,D1\n"), Format::Csv(CsvDialect::Gvret)),
            (utf8("timestamp,arbitration_id,extended\n"), Format::Csv(CsvDialect::PythonCan)),
            (utf8("  can0  123   [8]  11 22 33 44 55 66 77 88\n"), Format::CandumpScreen),
            (utf8(" (000.000000)  can0  RX - -  12345678   [0]\n"), Format::CandumpScreen),
            (utf8("# drive 3\n\n can0  123   [2]  11 22\n"), Format::CandumpScreen),
            (utf8("# drive 3\n(1410714882.622188) can0 123#11\n"), Format::Candump),
            (utf8("***BUSMASTER Ver 2.4.0***\n"), Format::Busmaster),
            (utf8("1320745424.000 CXX OVMS converted log\n"), Format::Crtd),
            (utf8("123.431 2R11 27E 00\n"), Format::Crtd),
            (utf8("                              Kvaser Memorator Log\n"), Format::Kvaser),
            (utf8("Chn Identifier Flg   DLC  D0...1...2...3\n"), Format::CanKing),
            (utf8("SQLite format 3\0"), Format::Sqlite),
            (utf8("//-----\nMicrochip Technology Inc.\n"), Format::Microchip),
            (utf8("Time   ID     DLC Data                    Comment\n"), Format::CanHacker),
            (utf8("Timestamp: 1410714882.000000    ID:      123    S Rx"), Format::Printer),
        ] {
            assert_eq!(Format::of_content(&head), Some(format), "{}", String::from_utf8_lossy(&head));
        }
        for head in ["", "rubbish", "   0.015991 1 123 Rx d 1 0A", "[8]", "{}"] {
            assert_eq!(Format::of_content(head.as_bytes()), None, "{head}");
        }
    }

    #[test]
    fn a_format_that_is_only_read_is_not_written_and_nothing_is_created() {
        let dir = tempfile::tempdir().unwrap();
        for format in Format::all().filter(|format| !format.is_written()) {
            let path = dir.path().join("a");
            let options = crate::WriteOptions { format: Some(format), ..Default::default() };
            let error = crate::create_writer(&path, &options).err().unwrap().to_string();
            assert!(error.contains("only read") && error.contains("mf4"), "{error}");
            assert!(!path.exists());
        }
    }
}
