//! What kind of database a file is, by its suffix.

use std::path::Path;

use super::fault::DatabaseError;
use super::model::Database;
use super::{arxml, dbc, file, kcd, sym};

/// The kinds of database files.
#[derive(Clone, Copy)]
pub(crate) enum FileKind {
    Dbc,
    Kcd,
    Sym,
    Arxml,
    Toml,
}

impl FileKind {
    pub fn of(file: &str, path: &Path) -> Result<Self, DatabaseError> {
        let suffix = path.extension().and_then(|suffix| suffix.to_str()).unwrap_or_default();
        match suffix.to_ascii_lowercase().as_str() {
            "dbc" => Ok(Self::Dbc),
            "kcd" => Ok(Self::Kcd),
            "sym" => Ok(Self::Sym),
            "arxml" => Ok(Self::Arxml),
            "toml" => Ok(Self::Toml),
            _ => Err(DatabaseError::UnknownKind { file: file.to_owned() }),
        }
    }

    pub const fn is_toml(self) -> bool {
        matches!(self, Self::Toml)
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
            Self::Arxml => arxml::parse_bus(file, bytes, bus),
            Self::Toml => file::parse(file, bytes),
        }
    }
}
