//! What is known of each format, in one table: its names, its files' suffixes and beginnings, its reader and its writer. Help, completion,
//! recognition and dispatch follow from it.

#[cfg(test)]
mod tests;

use super::analyser::{CsvLayout, TableEncoder};
use super::codec::{Decode, Encode};
use super::csv::CsvDialect;
use super::dif::{self, DifLayout};
use super::format::Format;
use super::read_options::ReadOptions;
use super::ros::bag::Bag;
use super::ros::container::{self, Container};
use super::ros::echo;
use super::ros::mcap::Mcap;
use super::row_format::Rows;
use super::trc::TrcVersion;
use super::writer::WriteOptions;
use super::{
    actisense, asc, battery_emulator, blf, busmaster, candump, candump_screen, canedge, canhacker, canking,
    canserver, carbus, crtd, csv, esphome, gvret, json, kvaser, labelled, mf4, microchip, nmea2000, pcap,
    pcapng, printer, rlog, saleae, sigrok, slcan, table, trace_window, trc, usbcan,
};

/// One format.
pub(crate) struct FormatSpec {
    pub format: Format,
    /// Its names. The first is the one shown.
    pub names: &'static [&'static str],
    /// What the names of its files may end with. A suffix selects the first format that has it.
    pub suffixes: &'static [&'static str],
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
        let is_comment =
            |line: &[u8]| line.starts_with(b"#") || line == b"--" || candump_screen::is_command(line);
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

#[cfg(feature = "parquet")]
fn parquet_reader(options: &ReadOptions) -> Box<dyn Decode> {
    Box::new(super::parquet::Decoder::new(options.columns.clone()))
}

#[cfg(not(feature = "parquet"))]
fn parquet_reader(_: &ReadOptions) -> Box<dyn Decode> {
    Box::new(super::codec::Missing("this build reads no Parquet; build it with the feature `parquet`"))
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
        writer: Some(|options| Box::new(asc::Encoder::new(options))),
    },
    FormatSpec {
        format: Format::Blf,
        names: &["blf"],
        suffixes: &["blf"],
        begins: |head| head.bytes.starts_with(blf::FILE_MAGIC),
        has_head: true,
        reader: |options| Box::new(blf::Decoder::new(&options.zone)),
        writer: Some(|options| Box::new(blf::Encoder::new(options))),
    },
    FormatSpec {
        format: Format::Trc(TrcVersion::V2_1),
        names: &["trc", "trc2.1"],
        suffixes: &["trc"],
        begins: |head| trc::is_head(head.text, head.line),
        has_head: true,
        reader: |options| Box::new(trc::Decoder::new(&options.zone)),
        writer: Some(|options| Box::new(trc::Encoder::new(TrcVersion::V2_1, options))),
    },
    FormatSpec {
        format: Format::Trc(TrcVersion::V2_0),
        names: &["trc2.0"],
        suffixes: &[],
        begins: NEVER,
        has_head: true,
        reader: |options| Box::new(trc::Decoder::new(&options.zone)),
        writer: Some(|options| Box::new(trc::Encoder::new(TrcVersion::V2_0, options))),
    },
    FormatSpec {
        format: Format::Trc(TrcVersion::V1_3),
        names: &["trc1.3"],
        suffixes: &[],
        begins: NEVER,
        has_head: true,
        reader: |options| Box::new(trc::Decoder::new(&options.zone)),
        writer: Some(|options| Box::new(trc::Encoder::new(TrcVersion::V1_3, options))),
    },
    FormatSpec {
        format: Format::Trc(TrcVersion::V1_2),
        names: &["trc1.2"],
        suffixes: &[],
        begins: NEVER,
        has_head: true,
        reader: |options| Box::new(trc::Decoder::new(&options.zone)),
        writer: Some(|options| Box::new(trc::Encoder::new(TrcVersion::V1_2, options))),
    },
    FormatSpec {
        format: Format::Trc(TrcVersion::V1_1),
        names: &["trc1.1"],
        suffixes: &[],
        begins: NEVER,
        has_head: true,
        reader: |options| Box::new(trc::Decoder::new(&options.zone)),
        writer: Some(|options| Box::new(trc::Encoder::new(TrcVersion::V1_1, options))),
    },
    FormatSpec {
        format: Format::Trc(TrcVersion::V1_0),
        names: &["trc1.0"],
        suffixes: &[],
        begins: NEVER,
        has_head: true,
        reader: |options| Box::new(trc::Decoder::new(&options.zone)),
        writer: Some(|options| Box::new(trc::Encoder::new(TrcVersion::V1_0, options))),
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
        begins: |head| gvret::is_head(head.line) || gvret::is_row(head.line),
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
        writer: Some(|options| Box::new(mf4::Encoder::new(options))),
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
        format: Format::TraceWindow,
        names: &["trace-window"],
        suffixes: &["txt"],
        begins: |head| trace_window::is_head(head.text),
        has_head: false,
        reader: |_| Box::new(Rows::<trace_window::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::EspHome,
        names: &["esphome"],
        suffixes: &["txt", "log"],
        begins: |head| esphome::is_head(head.bytes),
        has_head: false,
        reader: |_| Box::new(Rows::<esphome::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::Sigrok,
        names: &["sigrok"],
        suffixes: &["txt"],
        begins: |head| sigrok::is_line(head.first),
        has_head: false,
        reader: |_| Box::new(Rows::<sigrok::Decoder>::default()),
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
        suffixes: &["db", "sqlite", "sqlite3", "db3"],
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
        suffixes: &["raw", "txt", "log", "nmea"],
        begins: |head| {
            nmea2000::is_line(head.first)
                || nmea2000::is_log_of_signal_k(head.text)
                || nmea2000::has_sentence(head.bytes)
        },
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
        format: Format::UsbCan,
        names: &["usbcan"],
        suffixes: &["csv", "txt"],
        begins: |head| usbcan::is_head(head.line),
        has_head: true,
        reader: |_| Box::new(Rows::<usbcan::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::Labelled,
        names: &["labelled"],
        suffixes: &["txt", "log"],
        begins: |head| {
            labelled::is_head(head.bytes) && !is_of_another(head, &[Format::Table, Format::Labelled])
        },
        has_head: false,
        reader: |_| Box::new(Rows::<labelled::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::Slcan,
        names: &["slcan"],
        suffixes: &["slcan", "txt", "log"],
        begins: |head| slcan::is_head(head.bytes),
        has_head: false,
        reader: |_| Box::new(Rows::<slcan::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::RosEcho,
        names: &["ros-echo"],
        suffixes: &["yaml", "txt", "log"],
        begins: |head| echo::is_head(head.text),
        has_head: false,
        reader: |_| Box::new(Rows::<echo::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::Table,
        names: &["table"],
        suffixes: &["csv", "tsv", "txt"],
        begins: |head| {
            (table::is_first(head.first) || table::has_names_below(head.bytes))
                && !is_of_another(head, &[Format::Table])
        },
        has_head: false,
        reader: |options| Box::new(Rows::of(table::Decoder::new(options.columns.clone()))),
        writer: None,
    },
    FormatSpec {
        format: Format::Rlog,
        names: &["rlog"],
        suffixes: &["rlog", "qlog"],
        begins: |head| rlog::is_head(head.bytes),
        has_head: true,
        reader: |_| Box::new(rlog::Decoder::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::Mcap,
        names: &["mcap"],
        suffixes: &["mcap"],
        begins: |head| head.bytes.starts_with(Mcap::MAGIC),
        has_head: true,
        reader: |_| Box::new(container::Decoder::<Mcap>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::RosBag,
        names: &["rosbag"],
        suffixes: &["bag"],
        begins: |head| head.bytes.starts_with(Bag::MAGIC),
        has_head: true,
        reader: |_| Box::new(container::Decoder::<Bag>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::Parquet,
        names: &["parquet"],
        suffixes: &["parquet"],
        begins: |head| head.bytes.starts_with(b"PAR1"),
        has_head: true,
        reader: parquet_reader,
        writer: None,
    },
    FormatSpec {
        format: Format::Json,
        names: &["json"],
        suffixes: &["json", "jsonl", "ndjson"],
        begins: |head| json::is_head(head.bytes),
        has_head: false,
        reader: |options| Box::new(json::Decoder::new(options.columns.clone())),
        writer: None,
    },
    FormatSpec {
        format: Format::Saleae,
        names: &["saleae"],
        suffixes: &["csv"],
        begins: |head| saleae::is_head(head.line),
        has_head: true,
        reader: |_| Box::new(Rows::<saleae::Decoder>::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::CanServer,
        names: &["canserver"],
        suffixes: &["cslog"],
        begins: |head| canserver::is_head(head.bytes),
        has_head: true,
        reader: |_| Box::new(canserver::Decoder::default()),
        writer: None,
    },
    FormatSpec {
        format: Format::Actisense,
        names: &["actisense", "ebl"],
        suffixes: &["ebl"],
        begins: |head| actisense::is_head(head.bytes),
        has_head: true,
        reader: |_| Box::new(actisense::Decoder::default()),
        writer: None,
    },
];

/// Whether a file begins like one of a format other than these.
fn is_of_another(head: &Head<'_>, than: &[Format]) -> bool {
    FORMATS.iter().filter(|spec| !than.contains(&spec.format)).any(|spec| (spec.begins)(head))
}

impl FormatSpec {
    /// All of them.
    pub(crate) fn all() -> impl Iterator<Item = &'static Self> {
        FORMATS.iter()
    }

    /// The first row whose files begin so.
    pub(crate) fn of_content(head: &[u8]) -> Option<&'static Self> {
        let head = Head::of(head);
        FORMATS.iter().find(|spec| (spec.begins)(&head))
    }

    /// The row of a format.
    pub(crate) fn of(format: Format) -> &'static Self {
        // Each has one, which a test sees to.
        FORMATS.iter().find(|spec| spec.format == format).unwrap_or(&FORMATS[0])
    }
}
