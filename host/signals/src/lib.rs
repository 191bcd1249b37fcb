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
mod clean;
pub mod condition;
mod container;
pub mod dbc;
mod dbc_parse;
mod dbc_text;
mod decoder;
pub mod encode;
mod fault;
pub mod file;
mod j1939;
pub mod kcd;
mod layout;
mod model;
mod number;
mod picture;
mod plan;
mod reading;
mod scale;
pub mod search;
mod select;
pub mod sym;
pub mod trigger;
mod validate;
mod xml;

use std::path::Path;

pub use container::{ContainedPdu, Container, ContainerHeader, InPdu, NotDecoded, Part};
pub use decoder::{Decoder, MessageRef, Override, Source};
pub use encode::{EncodeError, Encoded};
pub use fault::{DatabaseError, Fault, FaultKind};
pub use j1939::Indicator;
pub use layout::ByteOrder;
pub use model::{
    Alarm, Alarms, Colour, Database, Digital, Message, Multiplexed, Signal, ValueKind, ValueTable,
};
pub use number::Number;
pub use plan::{MessageRows, SignalRows, SignalValue};
pub use reading::Reading;
pub use select::{Selection, SelectionError, Suggestion};

/// Reads a database, by its suffix: `.dbc`, `.kcd`, `.sym`, `.arxml`, or `.toml` for cantap's own signal file. For a KCD or ARXML
/// file with several buses, `FILE#BUS` selects one; without it, all are read as one.
///
/// Faults that leave a database usable are in [`Database::warnings`].
pub fn load(path: &Path) -> Result<Database, DatabaseError> {
    let file = path.display().to_string();
    let (path, bus) = with_bus(path);
    let suffix = path.extension().and_then(|suffix| suffix.to_str()).unwrap_or_default().to_ascii_lowercase();
    let read = || std::fs::read(path).map_err(|source| DatabaseError::Read { file: file.clone(), source });
    match suffix.as_str() {
        "arxml" => arxml::parse_bus(&file, &read()?, bus),
        "kcd" => kcd::parse_bus(&file, &read()?, bus),
        "dbc" | "sym" | "toml" if bus.is_some() => {
            Err(xml::faulty(&file, format!("a .{suffix} file is of one bus; leave out what follows the #")))
        }
        "dbc" => dbc::parse(&file, &read()?),
        "sym" => sym::parse(&file, &read()?),
        "toml" => file::parse(&file, &read()?),
        _ => Err(DatabaseError::UnknownKind { file }),
    }
}

/// Splits a file's path from the bus after it. `#` may also be part of an existing file's name.
fn with_bus(path: &Path) -> (&Path, Option<&str>) {
    let parts = path.to_str().filter(|_| !path.exists()).and_then(|text| text.rsplit_once('#'));
    match parts {
        Some((file, bus)) if !file.is_empty() && !bus.is_empty() => (Path::new(file), Some(bus)),
        _ => (path, None),
    }
}
