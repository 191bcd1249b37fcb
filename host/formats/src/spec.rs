//! What is known of each format, in one table: its names, its files' suffixes and beginnings, its reader and its writer. Help, completion,
//! recognition and dispatch follow from it.

use std::fmt;
use std::path::Path;
use std::str::FromStr;

use super::analyser::{CsvLayout, TableEncoder};
use super::codec::{Decode, Encode};
use super::compression::Compression;
use super::csv::CsvDialect;
use super::dif::{self, DifLayout};
use super::format::Format;
use super::read_options::ReadOptions;
use super::row_format::Rows;
use super::trc::TrcVersion;
use super::writer::WriteOptions;
use super::{
    asc, battery_emulator, blf, busmaster, candump, candump_screen, canedge, canhacker, canking, carbus,
    crtd, csv, gvret, kvaser, mf4, microchip, nmea2000, pcap, pcapng, printer, table, trc,
};

/// One format.
pub(crate) struct FormatSpec {
    format: Format,
    /// Its names. The first is the one shown.
    names: &'static [&'static str],
    /// What the names of its files may end with. A suffix selects the first format that has it.
    suffixes: &'static [&'static str],
    /// Whether a file begins like one of it: of no file may two say so.
    begins: fn(&Head<'_>) -> bool,
    /// Whether its files begin with something other than a record, so that an empty file is not one of them.
    pub has_head: bool,
    /// Makes a reader.
    pub reader: fn(&ReadOptions) -> Box<dyn Decode>,
    /// Makes a writer; `None` if the format is only read.
    pub writer: Option<MakeWriter>,
}

type MakeWriter = fn(&WriteOptions) -> Box<dyn Encode>;

/// The beginning of a file.
struct Head<'a> {
    bytes: &'a [u8],
    /// What a program may have put before the first row, without leading space.
    text: &'a [u8],
    /// The first line of that.
    line: &'a [u8],
    /// The first line that is no comment of the people who kept it.
    first: &'a [u8],
}

impl<'a> Head<'a> {
    fn of(bytes: &'a [u8]) -> Self {
        /// Where the header of a log names its program.
        const HEAD_BYTES: usize = 1024;
        let text = bytes[..bytes.len().min(HEAD_BYTES)].trim_ascii_start();
        let lines = text.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii_end);
        let line = lines.clone().next().unwrap_or_default();
        let is_comment = |line: &[u8]| line.starts_with(b"#") || candump_screen::is_command(line);
        // The first line is not among the others any more.
        let first = std::iter::once(line).chain(lines).find(|line| !line.is_empty() && !is_comment(line));
        Self { bytes, text, line, first: first.unwrap_or_default() }
    }
}

/// Its content shows a kind, and which version or dialect of it is for the kind's reader to find out.
const NEVER: fn(&Head<'_>) -> bool = |_| false;

#[cfg(feature = "sqlite")]
fn sqlite_reader() -> Box<dyn Decode> {
    Box::new(super::sqlite::Decoder::default())
}

#[cfg(not(feature = "sqlite"))]
fn sqlite_reader() -> Box<dyn Decode> {
    Box::new(super::codec::Missing("this build reads no SQLite; build it with the feature `sqlite`"))
}

/// All of them.
const FORMATS: &[FormatSpec] = &[
    FormatSpec {
        format: Format::Candump,
        names: &["candump", "log"],
        suffixes: &["log", "txt"],
        begins: |head| {
            let others = [candump_screen::is_line, battery_emulator::is_line];
            let timed = head.first.starts_with(b"(") && !others.iter().any(|is_line| is_line(head.first));
            timed || candump::is_untimed(head.first)
        },
        has_head: false,
        reader: |_| Box::new(candump::Decoder::default()),
        writer: Some(|_| Box::new(candump::Encoder::default())),
    },
    FormatSpec {
        format: Format::Asc,
        names: &["asc"],
        suffixes: &["asc"],
        begins: |head| asc::is_head(head.text),
        has_head: true,
        reader: |options| Box::new(asc::Decoder::new(&options.zone)),
        writer: Some(|options| Box::new(asc::Encoder::new(&options.zone))),
    },
    FormatSpec {
        format: Format::Blf,
        names: &["blf"],
        suffixes: &["blf"],
        begins: |head| head.bytes.starts_with(blf::FILE_MAGIC),
        has_head: true,
        reader: |options| Box::new(blf::Decoder::new(&options.zone)),
        writer: Some(|options| Box::new(blf::Encoder::new(&options.zone))),
    },
    FormatSpec {
        format: Format::Trc(TrcVersion::V2_1),
        names: &["trc", "trc2.1"],
        suffixes: &["trc"],
        begins: |head| trc::is_head(head.text, head.line),
        has_head: true,
        reader: |options| Box::new(trc::Decoder::new(&options.zone)),
        writer: Some(|options| Box::new(trc::Encoder::new(TrcVersion::V2_1, &options.zone))),
    },
    FormatSpec {
        format: Format::Trc(TrcVersion::V2_0),
        names: &["trc2.0"],
        suffixes: &[],
        begins: NEVER,
        has_head: true,
        reader: |options| Box::new(trc::Decoder::new(&options.zone)),
        writer: Some(|options| Box::new(trc::Encoder::new(TrcVersion::V2_0, &options.zone))),
    },
    FormatSpec {
        format: Format::Trc(TrcVersion::V1_3),
        names: &["trc1.3"],
        suffixes: &[],
        begins: NEVER,
        has_head: true,
        reader: |options| Box::new(trc::Decoder::new(&options.zone)),
        writer: Some(|options| Box::new(trc::Encoder::new(TrcVersion::V1_3, &options.zone))),
    },
    FormatSpec {
        format: Format::Trc(TrcVersion::V1_2),
        names: &["trc1.2"],
        suffixes: &[],
        begins: NEVER,
        has_head: true,
        reader: |options| Box::new(trc::Decoder::new(&options.zone)),
        writer: Some(|options| Box::new(trc::Encoder::new(TrcVersion::V1_2, &options.zone))),
    },
    FormatSpec {
        format: Format::Trc(TrcVersion::V1_1),
        names: &["trc1.1"],
        suffixes: &[],
        begins: NEVER,
        has_head: true,
        reader: |options| Box::new(trc::Decoder::new(&options.zone)),
        writer: Some(|options| Box::new(trc::Encoder::new(TrcVersion::V1_1, &options.zone))),
    },
    FormatSpec {
        format: Format::Trc(TrcVersion::V1_0),
        names: &["trc1.0"],
        suffixes: &[],
        begins: NEVER,
        has_head: true,
        reader: |options| Box::new(trc::Decoder::new(&options.zone)),
        writer: Some(|options| Box::new(trc::Encoder::new(TrcVersion::V1_0, &options.zone))),
    },
    FormatSpec {
        format: Format::Csv(CsvDialect::PythonCan),
        names: &["csv", "csv-python-can"],
        suffixes: &["csv"],
        begins: |head| csv::is_head(head.text) || csv::is_head(head.first),
        has_head: true,
        reader: |options| Box::new(csv::Decoder::new(&options.zone)),
        writer: Some(|_| Box::new(csv::PythonCanEncoder::default())),
    },
    FormatSpec {
        format: Format::Csv(CsvDialect::Full),
        names: &["csv-full"],
        suffixes: &[],
        begins: NEVER,
        has_head: true,
        reader: |options| Box::new(csv::Decoder::new(&options.zone)),
        writer: Some(|_| Box::new(csv::FullEncoder::default())),
    },
    FormatSpec {
        format: Format::Csv(CsvDialect::Analyser),
        names: &["csv-analyser"],
        suffixes: &[],
        begins: NEVER,
        has_head: true,
        reader: |options| Box::new(csv::Decoder::new(&options.zone)),
        writer: Some(|options| Box::new(TableEncoder::new(CsvLayout(options.table), &options.zone))),
    },
    FormatSpec {
        format: Format::Csv(CsvDialect::Gvret),
        names: &["csv-gvret", "gvret"],
        suffixes: &[],
        begins: |head| gvret::is_head(head.line),
        has_head: true,
        reader: |options| Box::new(csv::Decoder::new(&options.zone)),
        writer: Some(|_| Box::new(gvret::Encoder::default())),
    },
    FormatSpec {
        format: Format::Pcapng,
        names: &["pcapng"],
        suffixes: &["pcapng", "ntar"],
        begins: |head| head.bytes.starts_with(&pcapng::SECTION_HEADER.to_le_bytes()),
        has_head: true,
        reader: |_| Box::new(pcapng::Decoder::default()),
        writer: Some(|options| Box::new(pcapng::Encoder::new(options))),
    },
    FormatSpec {
        format: Format::Pcap,
        names: &["pcap"],
        suffixes: &["pcap", "cap"],
        begins: |head| pcap::is_head(head.bytes),
        has_head: true,
        reader: |_| Box::new(pcap::Decoder::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::Dif,
        names: &["dif"],
        suffixes: &["dif"],
        begins: |head| head.text.starts_with(b"TABLE"),
        has_head: true,
        reader: |options| Box::new(dif::Decoder::new(&options.zone)),
        writer: Some(|options| Box::new(TableEncoder::new(DifLayout::new(options.table), &options.zone))),
    },
    FormatSpec {
        format: Format::Mf4,
        names: &["mf4"],
        suffixes: &["mf4", "mdf"],
        begins: |head| {
            head.bytes.starts_with(mf4::FILE_MAGIC) || head.bytes.starts_with(mf4::UNFINISHED_MAGIC)
        },
        has_head: true,
        reader: |_| Box::new(mf4::Decoder::default()),
        writer: Some(|_| Box::new(mf4::Encoder::default())),
    },
    FormatSpec {
        format: Format::CandumpScreen,
        names: &["candump-screen"],
        suffixes: &["txt", "log"],
        begins: |head| candump_screen::is_line(head.first),
        has_head: false,
        reader: |_| Box::new(Rows::<candump_screen::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::Busmaster,
        names: &["busmaster"],
        suffixes: &["log"],
        begins: |head| busmaster::is_head(head.text) || busmaster::is_line(head.line),
        has_head: true,
        reader: |_| Box::new(Rows::<busmaster::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::Crtd,
        names: &["crtd"],
        suffixes: &["crtd", "crt"],
        begins: |head| crtd::is_line(head.first),
        has_head: false,
        reader: |_| Box::new(Rows::<crtd::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::Kvaser,
        names: &["kvaser"],
        suffixes: &["txt", "log"],
        begins: |head| kvaser::is_head(head.text),
        has_head: true,
        reader: |_| Box::new(Rows::<kvaser::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::Microchip,
        names: &["microchip"],
        suffixes: &["can"],
        begins: |head| microchip::is_head(head.text),
        has_head: true,
        reader: |_| Box::new(Rows::<microchip::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::CanHacker,
        names: &["canhacker"],
        suffixes: &["trc"],
        begins: |head| canhacker::is_head(head.line),
        has_head: true,
        reader: |_| Box::new(Rows::<canhacker::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::Printer,
        names: &["printer"],
        suffixes: &["txt", "log"],
        begins: |head| printer::is_line(head.line),
        has_head: false,
        reader: |_| Box::new(Rows::<printer::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::CanKing,
        names: &["canking"],
        suffixes: &["txt", "log"],
        begins: |head| canking::is_head(head.line),
        has_head: true,
        reader: |_| Box::new(Rows::<canking::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::Sqlite,
        names: &["sqlite"],
        suffixes: &["db", "sqlite", "sqlite3"],
        begins: |head| head.bytes.starts_with(b"SQLite format 3\0"),
        has_head: true,
        reader: |_| sqlite_reader(),
        writer: None,
    },
    FormatSpec {
        format: Format::CanEdgeCsv,
        names: &["canedge"],
        suffixes: &["csv"],
        begins: |head| canedge::is_head(head.line),
        has_head: true,
        reader: |_| Box::new(Rows::<canedge::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::BatteryEmulator,
        names: &["battery-emulator"],
        suffixes: &["txt", "log"],
        begins: |head| battery_emulator::is_line(head.first),
        has_head: false,
        reader: |_| Box::new(Rows::<battery_emulator::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::Nmea2000,
        names: &["n2k"],
        suffixes: &["raw", "txt", "log"],
        begins: |head| nmea2000::is_line(head.first),
        has_head: false,
        reader: |_| Box::new(Rows::<nmea2000::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::Carbus,
        names: &["carbus"],
        suffixes: &["trc"],
        begins: |head| carbus::is_head(head.text),
        has_head: true,
        reader: |_| Box::new(Rows::<carbus::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::Table,
        names: &["table"],
        suffixes: &["csv", "tsv", "txt"],
        begins: |head| table::is_first(head.first) && !is_of_another(head),
        has_head: false,
        reader: |options| Box::new(Rows::of(table::Decoder::new(options.columns.clone()))),
        writer: None,
    },
];

/// Whether a file begins like one of a format other than a table of any columns.
fn is_of_another(head: &Head<'_>) -> bool {
    FORMATS.iter().filter(|spec| spec.format != Format::Table).any(|spec| (spec.begins)(head))
}

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
    /// Nor does its content, which looks like something else.
    #[error("{file} is no trace that is read here: it looks like {looks_like}")]
    NoTrace {
        /// The file's name, as given.
        file: String,
        /// What it looks like.
        looks_like: &'static str,
    },
}

/// A format that can be read but not written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0} is a format that is only read; those that are written are {written}", written = Format::written_names())]
pub struct NotWritten(pub Format);

impl FormatSpec {
    /// The row of a format.
    pub(crate) fn of(format: Format) -> &'static Self {
        // Each has one, which a test sees to.
        FORMATS.iter().find(|spec| spec.format == format).unwrap_or(&FORMATS[0])
    }
}

impl Format {
    /// Every format.
    pub fn all() -> impl Iterator<Item = Self> {
        FORMATS.iter().map(|spec| spec.format)
    }

    /// Whether files of the format can be written, not only read.
    pub fn is_written(self) -> bool {
        FormatSpec::of(self).writer.is_some()
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
        FORMATS.iter().map(|spec| spec.names[0]).collect::<Vec<_>>().join(", ")
    }

    /// By a path's suffix; `.gz`, `.zst`, `.xz`, `.lz4` and `.bz2` are skipped.
    pub fn of_path(path: &Path) -> Result<Self, UnknownFormat> {
        Self::all()
            .find(|format| format.has_suffix_of(path))
            .ok_or_else(|| UnknownFormat::Suffix(path.display().to_string()))
    }

    /// What the names of its files usually end with, without the dot. Versions and dialects share their format's.
    pub fn suffix(self) -> &'static str {
        let kinds = Self::all().filter(|format| format.is_kind_of(self));
        let mut suffixes =
            std::iter::once(self).chain(kinds).flat_map(|format| FormatSpec::of(format).suffixes);
        suffixes.next().copied().unwrap_or("txt")
    }

    /// Whether a file of the format may have this name.
    pub(crate) fn has_suffix_of(self, path: &Path) -> bool {
        let name = path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        let (bare, _) = Compression::split(&name);
        let suffixes = FormatSpec::of(self).suffixes;
        bare.rsplit_once('.').is_some_and(|(_, suffix)| suffixes.contains(&suffix))
    }

    /// Whether both are read by the same reader: the content shows which version or dialect it is.
    pub fn is_kind_of(self, other: Self) -> bool {
        std::mem::discriminant(&self) == std::mem::discriminant(&other)
    }

    /// By a file's first bytes.
    pub fn of_content(head: &[u8]) -> Option<Self> {
        let head = Head::of(head);
        FORMATS.iter().find(|spec| (spec.begins)(&head)).map(|spec| spec.format)
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(FormatSpec::of(*self).names[0])
    }
}

impl FromStr for Format {
    type Err = UnknownFormat;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let lower = text.to_ascii_lowercase();
        let spec = FORMATS.iter().find(|spec| spec.names.contains(&lower.as_str()));
        spec.map(|spec| spec.format).ok_or_else(|| UnknownFormat::Name(text.to_owned()))
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
            (utf8("123#DEADBEEF\n18DAF110#\n"), Format::Candump),
            (utf8("cansend vcan0 1D0#000000000000000A\n"), Format::Candump),
            (utf8("candump can0\n  can0  080   [0] \n"), Format::CandumpScreen),
            (utf8("pi@car:~$ candump any\n  can0  080   [0] \n"), Format::CandumpScreen),
            (
                utf8("interface = can0, family = 29, type = 3, proto = 1\n<0x18eeff01> [1] 05\n"),
                Format::CandumpScreen,
            ),
            (utf8("0128 [2] 0b 61\n"), Format::CandumpScreen),
            (utf8("***BUSMASTER Ver 2.4.0***\n"), Format::Busmaster),
            (utf8("\r\n***HEX***\n***RELATIVE MODE***\n"), Format::Busmaster),
            (utf8("22:20:14:992 Rx 0 0000021A s 2 FE 36\n"), Format::Busmaster),
            (utf8("00:29:58.617 R 0DFF180D A2 8C\n"), Format::Nmea2000),
            (utf8("2011-11-24-22:42:04.388,2,127250,36,255,2,ff,10\n"), Format::Nmea2000),
            (utf8("A000159.990 CCFF7 0FF63 3B9F\n"), Format::Nmea2000),
            (utf8("@ TEXT @ 3 @ 64 @ 0 @ 10094 @ 20672 @ 00:00:20.672 @\r"), Format::Carbus),
            (utf8("# a fixture\n1320745424.002 1R11 402 FA 01\n"), Format::Crtd),
            (utf8("1320745424.000 CXX OVMS converted log\n"), Format::Crtd),
            (utf8("123.431 2R11 27E 00\n"), Format::Crtd),
            (utf8("                              Kvaser Memorator Log\n"), Format::Kvaser),
            (utf8("Chn Identifier Flg   DLC  D0...1...2...3\n"), Format::CanKing),
            (utf8("SQLite format 3\0"), Format::Sqlite),
            (utf8("(51.26) RX0 17FC007B [8] 01 02 03 04 05 06 07 08\n"), Format::BatteryEmulator),
            (
                utf8("TimestampEpoch;BusChannel;ID;IDE;DLC;DataLength;Dir;EDL;BRS;DataBytes\n"),
                Format::CanEdgeCsv,
            ),
            (utf8("//-----\nMicrochip Technology Inc.\n"), Format::Microchip),
            (utf8("Time   ID     DLC Data                    Comment\n"), Format::CanHacker),
            (utf8("Timestamp: 1410714882.000000    ID:      123    S Rx"), Format::Printer),
            (utf8("Timestamp: 1479121434.850202        ID: 0350    000    DLC: 8    05 28"), Format::Printer),
            (utf8("timestamp,arbitration_id,data_field,attack\n1.0,0C1,00,0\n"), Format::Table),
            (utf8("time,addr,bus,data\n"), Format::Table),
            (utf8("Index;ID;Data\n"), Format::Table),
            (utf8("1478198376.389427,0316,2,05,21,R\n"), Format::Table),
            (utf8("1483093132.049669        0380    000    2    30 bb\n"), Format::Table),
            (utf8("0.001 0x100 204E00000000\n"), Format::Table),
            (utf8("11T082554602;1;cf00203;cd402800043828ff\n"), Format::Table),
        ] {
            assert_eq!(Format::of_content(&head), Some(format), "{}", String::from_utf8_lossy(&head));
            let begins = FORMATS.iter().filter(|spec| (spec.begins)(&Head::of(&head)));
            assert_eq!(begins.count(), 1, "{}", String::from_utf8_lossy(&head));
        }
        for head in ["", "rubbish", "   0.015991 1 123 Rx d 1 0A", "[8]", "{}"] {
            assert_eq!(Format::of_content(head.as_bytes()), None, "{head}");
        }
    }

    #[test]
    fn each_format_has_a_row_and_names_of_its_own() {
        for (at, spec) in FORMATS.iter().enumerate() {
            assert_eq!(spec.format.to_string().parse(), Ok(spec.format));
            for other in &FORMATS[at + 1..] {
                assert_ne!(spec.format, other.format);
                assert!(spec.names.iter().all(|name| !other.names.contains(name)), "{}", spec.format);
            }
        }
        let dialects = [CsvDialect::PythonCan, CsvDialect::Full, CsvDialect::Analyser, CsvDialect::Gvret]
            .map(Format::Csv);
        let versions = [
            TrcVersion::V2_1,
            TrcVersion::V2_0,
            TrcVersion::V1_3,
            TrcVersion::V1_2,
            TrcVersion::V1_1,
            TrcVersion::V1_0,
        ]
        .map(Format::Trc);
        for format in dialects.into_iter().chain(versions) {
            assert_eq!(FormatSpec::of(format).format, format);
        }
    }

    #[test]
    fn a_format_that_is_only_read_is_not_written_and_nothing_is_created() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.log.bz2");
        let error = crate::create_writer(&path, &crate::WriteOptions::default()).err().unwrap().to_string();
        assert!(error.contains("only read") && error.contains(".xz") && !path.exists(), "{error}");
        for format in Format::all().filter(|format| !format.is_written()) {
            let path = dir.path().join("a");
            let options = crate::WriteOptions { format: Some(format), ..Default::default() };
            let error = crate::create_writer(&path, &options).err().unwrap().to_string();
            assert!(error.contains("only read") && error.contains("mf4"), "{error}");
            assert!(!path.exists());
        }
    }
}
