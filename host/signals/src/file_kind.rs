//! What kind of database a file is, by its suffix.

use std::path::Path;

use super::fault::DatabaseError;
use super::model::Database;
use super::{arxml, dbc, dbf, file, kcd, sheet, sym};

/// The kinds of database files.
#[derive(Clone, Copy)]
pub(crate) enum FileKind {
    Dbc,
    Kcd,
    Sym,
    Arxml,
    /// BUSMASTER's.
    Dbf,
    Toml,
    /// A table of signals in a text.
    Text,
    /// One in a workbook, which is a ZIP archive itself.
    Workbook,
}

impl FileKind {
    pub fn of(file: &str, path: &Path) -> Result<Self, DatabaseError> {
        let suffix = path.extension().and_then(|suffix| suffix.to_str()).unwrap_or_default();
        match suffix.to_ascii_lowercase().as_str() {
            "dbc" => Ok(Self::Dbc),
            "kcd" => Ok(Self::Kcd),
            "sym" => Ok(Self::Sym),
            "arxml" => Ok(Self::Arxml),
            "dbf" => Ok(Self::Dbf),
            "toml" => Ok(Self::Toml),
            "csv" | "tsv" => Ok(Self::Text),
            "xlsx" | "xlsm" | "xls" => Ok(Self::Workbook),
            _ => Err(DatabaseError::UnknownKind { file: file.to_owned() }),
        }
    }

    /// Whether it is what files of this suffix are, so that one in an archive is taken without being named.
    pub const fn is_sure(self) -> bool {
        !matches!(self, Self::Toml | Self::Text | Self::Workbook)
    }

    pub const fn is_workbook(self) -> bool {
        matches!(self, Self::Workbook)
    }

    /// Whether a file may describe several buses.
    pub const fn has_buses(self) -> bool {
        matches!(self, Self::Kcd | Self::Arxml)
    }

    pub fn parse(self, file: &str, bytes: &[u8], bus: Option<&str>) -> Result<Database, DatabaseError> {
        match self {
            Self::Dbc => dbc::parse(file, bytes),
            Self::Kcd => kcd::parse_bus(file, bytes, bus),
            Self::Sym => sym::parse(file, bytes),
            Self::Dbf => dbf::parse(file, bytes),
            Self::Arxml => arxml::parse_bus(file, bytes, bus),
            Self::Toml => file::parse(file, bytes),
            Self::Text | Self::Workbook => sheet::parse(file, bytes),
        }
    }
}
