//! NMEA 2000: J1939 with fast packets, according to CANboat's database of parameter groups.
//!
//! The database is parsed when the first assembler is made: this takes some ten milliseconds, and a few
//! megabytes that stay allocated.

mod database;
mod encode;
mod encode_error;
mod fields;
#[cfg(test)]
mod tests;
mod values;

pub use encode::{EncodedGroup, encode};
pub use encode_error::EncodeError;

use std::borrow::Cow;

use crate::Field;
use database::Database;

/// Whether NMEA 2000 sends the group by fast packet.
pub fn is_fast(pgn: u32) -> bool {
    // Lower numbers are groups of J1939 and single frames.
    if pgn < 0x1_0000 {
        return false;
    }
    match Database::get().groups(pgn).first().or_else(|| Database::get().fallback(pgn)) {
        Some(group) => group.kind == "Fast",
        None => false,
    }
}

/// The group's name, if it has its own, and its values.
pub(crate) fn describe(pgn: u32, data: &[u8], fields: &mut Vec<Field>) -> Option<Cow<'static, str>> {
    let group = fields::group(pgn, data)?;
    fields::read(group, data, fields);
    // The name of a range says less than its number.
    (!group.fallback).then_some(Cow::Borrowed(group.description.as_str()))
}

/// The name of a group with a unique number.
pub(crate) fn name(pgn: u32) -> Option<&'static str> {
    let mut own = Database::get().groups(pgn).iter().filter(|group| !group.fallback);
    own.next().filter(|_| own.next().is_none()).map(|group| group.description.as_str())
}

/// Whether a group with this number is NMEA 2000's on a bus that has both.
pub fn is_own(pgn: u32) -> bool {
    (0x1_F000..0x2_0000).contains(&pgn) || is_fast(pgn)
}

/// Whether the database has the group.
pub(crate) fn has(pgn: u32) -> bool {
    Database::get().groups(pgn).iter().any(|group| !group.fallback)
}

/// Whether only NMEA 2000 defines the group.
pub(crate) fn is_known(pgn: u32) -> bool {
    // The second page, excluding proprietary groups.
    (0x1_F000..0x1_FF00).contains(&pgn) && has(pgn)
}
