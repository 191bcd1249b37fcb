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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::check;

    #[test]
    fn every_line_of_the_file_is_in_a_table() {
        check(FILE, &[&COMMANDS, &STATES, &ABORTS, &EMERGENCIES, &OBJECTS, &ERROR_REGISTER, &BIT_RATES]);
        assert_eq!((emergency(0x8110), emergency(0x8111)), ("CAN overrun, objects lost", "communication"));
    }
}
