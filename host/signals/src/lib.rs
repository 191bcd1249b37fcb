#![doc = include_str!("../README.md")]
//!
//! A [`Database`] describes messages and their signals. A [`Decoder`] holds one or several databases, compiled so that decoding
//! takes a shift and a mask per signal. [`mod@encode`] goes the other way, [`condition`] decides whether something is true of a
//! record, [`search`] and [`trigger`] select records by conditions.
//!
//! Getting records and displaying values is left to other crates.

#![forbid(unsafe_code)]

pub mod arxml;
mod buses;
pub mod condition;
mod container;
pub mod dbc;
mod dbc_parse;
mod dbc_text;
pub mod dbf;
mod decoder;
pub mod encode;
mod fault;
pub mod file;
mod file_kind;
mod j1939;
pub mod kcd;
mod layout;
mod model;
pub mod named;
mod number;
mod packed;
mod picture;
mod plan;
mod reading;
mod scale;
pub mod search;
mod select;
mod sheet;
pub mod sym;
pub mod text_places;
pub mod trigger;
mod unflagged;
mod validate;
mod xml;
pub mod zip;

use std::path::Path;

use file_kind::FileKind;

pub use container::{ContainedPdu, Container, ContainerHeader, InPdu, NotDecoded, Part};
pub use decoder::{Decoder, MessageRef, Override, Source};
pub use encode::{EncodeError, Encoded};
pub use fault::{DatabaseError, Fault, FaultKind};
pub use j1939::Indicator;
pub use layout::ByteOrder;
pub use model::{
    Alarm, Alarms, Colour, Database, Digital, Message, Multiplexed, Signal, ValueKind, ValueTable,
};
pub use number::{Number, shortest_of_f32};
pub use plan::{MessageRows, SignalRows, SignalValue};
pub use reading::Reading;
pub use select::{Selection, SelectionError, Suggestion};
pub use sheet::rows_of_text;

/// What the names of databases end with, the usual ones first.
pub const SUFFIXES: [&str; 8] = ["dbc", "kcd", "sym", "arxml", "dbf", "toml", "xlsx", "csv"];

/// Whether a file is a database if its name ends as it does: tables and TOML may be anything else as well.
pub fn is_database_name(path: &Path) -> bool {
    FileKind::of("", path).is_ok_and(FileKind::is_sure)
}

/// Reads a database, by its suffix: `.dbc`, `.kcd`, `.sym`, `.arxml`, `.dbf`, a table of signals in `.xlsx`, `.csv` or `.tsv`, or
/// `.toml` for cantap's own signal file. For a KCD or ARXML
/// file with several buses, `FILE#BUS` selects one; without it, all are read as one.
///
/// A file may be compressed with gzip (`car.dbc.gz`), or in a ZIP archive: `cars.zip`, if it has no other database, or `cars.zip/inside/car.dbc`.
///
/// Faults that leave a database usable are in [`Database::warnings`].
pub fn load(path: &Path) -> Result<Database, DatabaseError> {
    let file = path.display().to_string();
    let (path, bus) = with_bus(path);
    let (inner, bytes) = packed::read(path)?;
    let file = match bus {
        _ if inner == path => file,
        Some(bus) => format!("{}#{bus}", inner.display()),
        None => inner.display().to_string(),
    };
    let path = inner.as_path();
    let kind = FileKind::of(&file, path)?;
    if bus.is_none() || kind.has_buses() {
        return kind.parse(&file, &bytes, bus);
    }
    let suffix = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    Err(xml::faulty(&file, format!("a .{suffix} file is of one bus; leave out what follows the #")))
}

/// Reads the content of a database file of this name, by its suffix, as [`load`] does: for files that are not in the file system. All
/// buses of the file are read.
pub fn parse(name: &str, bytes: &[u8]) -> Result<Database, DatabaseError> {
    let (name, bytes) = packed::unpack(name, bytes, None)?;
    FileKind::of(&name, Path::new(&name))?.parse(&name, &bytes, None)
}

/// Splits a file's path from the bus after it. `#` may also be part of an existing file's name.
fn with_bus(path: &Path) -> (&Path, Option<&str>) {
    let parts = path.to_str().filter(|_| !path.exists()).and_then(|text| text.rsplit_once('#'));
    match parts {
        Some((file, bus)) if !file.is_empty() && !bus.is_empty() => (Path::new(file), Some(bus)),
        _ => (path, None),
    }
}
