//! What the values of OBD-II's parameters stand for, where they are not numbers. The tables are in `data/diagnostics.csv`.

use super::names::FILE;
use crate::table::Table;

static FUEL_SYSTEM: Table = Table::new(FILE, "fuel_system");
static SECONDARY_AIR: Table = Table::new(FILE, "secondary_air");
static STANDARD: Table = Table::new(FILE, "obd_standard");
static FUEL: Table = Table::new(FILE, "fuel");
static EMISSION_REQUIREMENTS: Table = Table::new(FILE, "emission_requirements");

#[cfg(test)]
pub static TABLES: [&Table; 5] = [&FUEL_SYSTEM, &SECONDARY_AIR, &STANDARD, &FUEL, &EMISSION_REQUIREMENTS];

/// What a value of the parameter stands for.
pub fn of(pid: u8, raw: u64) -> Option<&'static str> {
    let raw = u8::try_from(raw).ok()?;
    match pid {
        0x03 => FUEL_SYSTEM.get(raw),
        0x12 => SECONDARY_AIR.get(raw),
        0x1C => STANDARD.get(raw),
        0x51 => FUEL.get(raw),
        0x5F => EMISSION_REQUIREMENTS.get(raw),
        _ => None,
    }
}
