#![doc = include_str!("../README.md")]
//!
//! A [`Database`] describes messages and their signals. A [`Decoder`] holds one or several databases, compiled so that decoding
//! is a shift and a mask per signal. [`mod@encode`] goes the other way, [`condition`] asks whether something holds for a record,
//! [`search`] and [`trigger`] choose records by conditions.
//!
//! Where records come from and how values are shown is for others.

#![forbid(unsafe_code)]

pub mod arxml;
mod clean;
pub mod condition;
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
mod scale;
pub mod search;
mod select;
pub mod sym;
pub mod trigger;
mod validate;
mod xml;

use std::path::Path;

pub use decoder::{Decoder, MessageRef, Override, Source};
pub use encode::{EncodeError, Encoded};
pub use fault::{DatabaseError, Fault, FaultKind};
pub use j1939::Indicator;
pub use layout::ByteOrder;
pub use model::{
    Alarm, Alarms, Colour, Database, Digital, Message, Multiplexed, Signal, ValueKind, ValueTable,
};
pub use number::Number;
pub use plan::SignalValue;
pub use select::{Selection, SelectionError, Suggestion};

/// Reads a database, by its suffix: `.dbc`, `.kcd`, `.sym`, `.arxml`, or `.toml` for cantap's own signal file.
///
/// Faults that leave a database usable are in [`Database::warnings`].
pub fn load(path: &Path) -> Result<Database, DatabaseError> {
    let file = path.display().to_string();
    let suffix = path.extension().and_then(|suffix| suffix.to_str()).unwrap_or_default();
    let parse: fn(&str, &[u8]) -> Result<Database, DatabaseError> = match suffix.to_ascii_lowercase().as_str()
    {
        "dbc" => dbc::parse,
        "arxml" => arxml::parse,
        "kcd" => kcd::parse,
        "sym" => sym::parse,
        "toml" => file::parse,
        _ => return Err(DatabaseError::UnknownKind { file }),
    };
    match std::fs::read(path) {
        Ok(bytes) => parse(&file, &bytes),
        Err(source) => Err(DatabaseError::Read { file, source }),
    }
}
