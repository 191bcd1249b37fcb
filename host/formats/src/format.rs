//! The formats by name, by suffix and by their first bytes.

use std::fmt;
use std::path::Path;
use std::str::FromStr;

use super::csv::CsvDialect;
use super::trc::TrcVersion;
use super::{blf, pcapng};

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
    /// The earlier CANanalyser's table in the format of old spreadsheets.
    Dif,
}

/// Names, suffixes and a description of each format. The first name is the one shown; the first
/// format with a suffix is the one that the suffix picks.
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
    (Format::Pcapng, &["pcapng"], &["pcapng", "ntar"]),
    (Format::Dif, &["dif"], &["dif"]),
];

/// No such format.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum UnknownFormat {
    /// Not a format's name.
    #[error("'{0}' is no trace format; the formats are {known}", known = Format::names())]
    Name(String),
    /// A file's suffix says nothing.
    #[error("the name '{0}' does not tell the format")]
    Suffix(String),
}

impl Format {
    /// Every format.
    pub fn all() -> impl Iterator<Item = Self> {
        FORMATS.iter().map(|(format, ..)| *format)
    }

    /// The names of all formats, for messages.
    pub fn names() -> String {
        FORMATS.iter().map(|(_, names, _)| names[0]).collect::<Vec<_>>().join(", ")
    }

    /// By a path's suffix; `.gz` and `.zst` are looked through.
    pub fn of_path(path: &Path) -> Result<Self, UnknownFormat> {
        let name = path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        let bare = name.strip_suffix(".gz").or_else(|| name.strip_suffix(".zst")).unwrap_or(&name);
        bare.rsplit_once('.')
            .and_then(|(_, suffix)| FORMATS.iter().find(|(_, _, suffixes)| suffixes.contains(&suffix)))
            .map(|(format, ..)| *format)
            .ok_or_else(|| UnknownFormat::Suffix(path.display().to_string()))
    }

    /// By a file's first bytes.
    pub fn of_content(head: &[u8]) -> Option<Self> {
        let text = head.trim_ascii_start();
        if head.starts_with(blf::FILE_MAGIC) {
            Some(Self::Blf)
        } else if head.starts_with(&pcapng::SECTION_HEADER.to_le_bytes()) {
            Some(Self::Pcapng)
        } else if text.starts_with(b"timestamp,") || text.starts_with(b"time,") || text.starts_with(b"Index")
        {
            Some(Self::Csv(CsvDialect::PythonCan))
        } else if text.starts_with(b"TABLE") {
            Some(Self::Dif)
        } else if text.starts_with(b"(") {
            Some(Self::Candump)
        } else if text.starts_with(b"date ") {
            Some(Self::Asc)
        } else if text.starts_with(b";$FILEVERSION") || text.starts_with(b";####") {
            Some(Self::Trc(TrcVersion::V2_1))
        } else {
            None
        }
    }
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
