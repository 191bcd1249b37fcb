//! Parameter groups, failure modes and the parts of a NAME. The tables, with their sources, are in `data/j1939.csv`.

use super::header::Header;
use crate::table::Table;

const FILE: &str = include_str!("../../data/j1939.csv");

static GROUPS: Table = Table::new(FILE, "group");
static CHARGING: Table = Table::new(FILE, "charging");
static FAILURE_MODES: Table = Table::new(FILE, "failure_mode");
static INDUSTRY_GROUPS: Table = Table::new(FILE, "industry_group");
static FUNCTIONS: Table = Table::new(FILE, "function");
static CONTINUOUS_MONITORS: Table = Table::new(FILE, "continuous_monitor");
static MONITORS: Table = Table::new(FILE, "monitor");
static OBD_COMPLIANCE: Table = Table::new(FILE, "obd_compliance");

/// A parameter group's name.
pub fn group(pgn: u32) -> Option<&'static str> {
    GROUPS.get(pgn)
}

/// A charger's address in GB/T 27930.
const CHARGER_ADDRESS: u8 = 0x56;
/// The address of a vehicle's battery management there.
const BATTERY_ADDRESS: u8 = 0xF4;

/// A message's name: between a charger and a battery management, groups have other names than elsewhere.
pub fn message(header: Header) -> Option<&'static str> {
    let charging = is_charging(header).then(|| CHARGING.get(header.pgn)).flatten();
    charging.or_else(|| group(header.pgn))
}

/// Whether a message is one between a charger and a battery management.
pub fn is_charging(header: Header) -> bool {
    matches!(
        [header.source, header.destination],
        [CHARGER_ADDRESS, BATTERY_ADDRESS] | [BATTERY_ADDRESS, CHARGER_ADDRESS]
    )
}

/// A failure mode identifier (FMI).
pub fn failure_mode(fmi: u8) -> &'static str {
    FAILURE_MODES.get(fmi).unwrap_or("reserved")
}

/// The industry group in a NAME.
pub fn industry_group(group: u8) -> Option<&'static str> {
    INDUSTRY_GROUPS.get(group)
}

/// The function in a NAME, if it has the same meaning in every industry.
pub fn function(function: u8) -> Option<&'static str> {
    FUNCTIONS.get(function)
}

/// The monitors whose bits are set in DM5 and DM26: those that run all the time, and the others.
pub fn monitors(continuous: u8, others: u16) -> impl Iterator<Item = &'static str> {
    let others = (0..16_u16).filter(move |bit| others >> bit & 1 == 1);
    CONTINUOUS_MONITORS.bits(continuous).chain(others.filter_map(|bit| MONITORS.get(bit)))
}

/// With what OBD a controller complies.
pub fn obd_compliance(compliance: u8) -> Option<&'static str> {
    OBD_COMPLIANCE.get(compliance)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::check;

    #[test]
    fn every_line_of_the_file_is_in_a_table() {
        let names = [&GROUPS, &CHARGING, &FAILURE_MODES, &INDUSTRY_GROUPS, &FUNCTIONS];
        let readiness = [&CONTINUOUS_MONITORS, &MONITORS, &OBD_COMPLIANCE];
        check(FILE, &names.into_iter().chain(readiness).collect::<Vec<_>>());
        assert_eq!(group(0xF004), Some("EEC1 engine"));
        assert_eq!(group(0x1_EF00), Some("proprietary A2"));
    }
}
