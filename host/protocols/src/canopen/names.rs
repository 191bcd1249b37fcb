//! Names for CANopen's numbers. The tables, with their sources, are in `data/canopen.csv`.

use crate::table::Table;

const FILE: &str = include_str!("../../data/canopen.csv");

static COMMANDS: Table = Table::new(FILE, "command");
static STATES: Table = Table::new(FILE, "state");
static ABORTS: Table = Table::new(FILE, "abort");
static EMERGENCIES: Table = Table::new(FILE, "emergency");
static OBJECTS: Table = Table::new(FILE, "object");
static ERROR_REGISTER: Table = Table::new(FILE, "error_register");
static BIT_RATES: Table = Table::new(FILE, "bit_rate");
static DRIVE_STATES: Table = Table::new(FILE, "drive_state");
static STATUS_BITS: Table = Table::new(FILE, "status_bit");
static DRIVE_MODES: Table = Table::new(FILE, "drive_mode");
static DRIVE_OBJECTS: Table = Table::new(FILE, "drive_object");
static DRIVE_EMERGENCIES: Table = Table::new(FILE, "drive_emergency");

/// Network management commands.
pub fn command(command: u8) -> Option<&'static str> {
    COMMANDS.get(command)
}

/// States of a node, without the toggle bit of guarding.
pub fn state(state: u8) -> Option<&'static str> {
    STATES.get(state)
}

/// Why an SDO transfer was aborted.
pub fn abort(code: u32) -> &'static str {
    ABORTS.get(code).unwrap_or("unknown code")
}

/// Emergency error codes, as specifically as they are known.
pub fn emergency(code: u16) -> &'static str {
    EMERGENCIES.get(code).unwrap_or("reserved")
}

/// Objects of the communication profile.
pub fn object(index: u16) -> Option<&'static str> {
    OBJECTS.get(index)
}

/// The bits of the error register, with commas; `None` if there is none.
pub fn error_register(register: u8) -> Option<String> {
    Some(ERROR_REGISTER.bits(register).collect::<Vec<_>>().join(", ")).filter(|text| !text.is_empty())
}

/// A bit rate by its index in CiA's table.
pub fn bit_rate(index: u8) -> Option<&'static str> {
    BIT_RATES.get(index)
}

/// States of a drive, by their place in the list of them.
pub fn drive_state(place: u8) -> &'static str {
    DRIVE_STATES.get(place).unwrap_or_default()
}

/// Bits of a drive's statusword that are no state, and the same in each mode.
pub fn status_bit(bit: u8) -> Option<&'static str> {
    STATUS_BITS.get(bit)
}

/// Modes of operation of a drive.
pub fn drive_mode(mode: u8) -> Option<&'static str> {
    DRIVE_MODES.get(mode)
}

/// Objects of the drive profile.
pub fn drive_object(index: u16) -> Option<&'static str> {
    DRIVE_OBJECTS.get(index)
}

/// Error codes that only drives have.
pub fn drive_emergency(code: u16) -> Option<&'static str> {
    DRIVE_EMERGENCIES.get(code)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::check;

    #[test]
    fn every_line_of_the_file_is_in_a_table() {
        let general = [&COMMANDS, &STATES, &ABORTS, &EMERGENCIES, &OBJECTS, &ERROR_REGISTER, &BIT_RATES];
        let drives = [&DRIVE_STATES, &STATUS_BITS, &DRIVE_MODES, &DRIVE_OBJECTS, &DRIVE_EMERGENCIES];
        check(FILE, &[&general[..], &drives[..]].concat());
        assert_eq!((emergency(0x8110), emergency(0x8111)), ("CAN overrun, objects lost", "communication"));
    }
}
