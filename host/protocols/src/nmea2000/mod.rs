//! NMEA 2000: J1939 with fast packets, by CANboat's database of parameter groups.
//!
//! The database is read when the first assembler is made: some ten milliseconds, and a few megabytes that stay.

mod database;
mod fields;
#[cfg(test)]
mod tests;

use std::borrow::Cow;

use crate::Field;
use database::Database;

/// Whether the group comes as a fast packet.
pub(crate) fn is_fast(pgn: u32) -> bool {
    // Below lie those of J1939, and single frames.
    if pgn < 0x1_0000 {
        return false;
    }
    match Database::get().groups(pgn).first().or_else(|| Database::get().fallback(pgn)) {
        Some(group) => group.kind == "Fast",
        None => false,
    }
}

/// The group's name, where it has one of its own, and its values.
pub(crate) fn describe(pgn: u32, data: &[u8], fields: &mut Vec<Field>) -> Option<Cow<'static, str>> {
    let group = fields::group(pgn, data)?;
    fields::read(group, data, fields);
    // A range's name says less than its number.
    (!group.fallback).then_some(Cow::Borrowed(group.description.as_str()))
}

/// The name of a group whose number is only its own.
pub(crate) fn name(pgn: u32) -> Option<&'static str> {
    let mut own = Database::get().groups(pgn).iter().filter(|group| !group.fallback);
    own.next().filter(|_| own.next().is_none()).map(|group| group.description.as_str())
}

/// Whether a bus that has both means NMEA 2000's group by this number.
pub(crate) fn is_own(pgn: u32) -> bool {
    (0x1_F000..0x2_0000).contains(&pgn) || is_fast(pgn)
}

/// Whether the group is one that only NMEA 2000 gives a meaning.
pub(crate) fn is_known(pgn: u32) -> bool {
    // The second page, but for what is the manufacturers'.
    (0x1_F000..0x1_FF00).contains(&pgn) && Database::get().groups(pgn).iter().any(|group| !group.fallback)
}
