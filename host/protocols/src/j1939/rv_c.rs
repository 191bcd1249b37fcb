//! RV-C's groups: names, and what they contain. The tables, with their sources, are `data/rv-c.csv` and `data/rv-c-parameters.csv`.

use std::sync::LazyLock;

use rustc_hash::FxHashMap;

use super::parameters::{Absence, Parameter};
use crate::Field;
use crate::table::{Table, lines};

const FILE: &str = include_str!("../../data/rv-c.csv");
static GROUPS: Table = Table::new(FILE, "group");

const PARAMETERS_FILE: &str = include_str!("../../data/rv-c-parameters.csv");

/// By group.
static PARAMETERS: LazyLock<FxHashMap<u32, Vec<Parameter>>> = LazyLock::new(|| {
    let mut groups: FxHashMap<u32, Vec<Parameter>> = FxHashMap::default();
    // What cannot be read is left out, of which the table has nothing: a test reads every line.
    for parameter in lines(PARAMETERS_FILE).filter_map(Parameter::read) {
        groups.entry(parameter.pgn).or_default().push(parameter);
    }
    groups
});

/// A group's name.
pub fn name(pgn: u32) -> Option<&'static str> {
    GROUPS.get(pgn)
}

/// Adds the values of a group; false if the table does not have it.
pub fn fields(pgn: u32, data: &[u8], fields: &mut Vec<Field>) -> bool {
    let (Some(parameters), Ok(data)) = (PARAMETERS.get(&pgn), <[u8; 8]>::try_from(data)) else {
        return false;
    };
    let data = u64::from_le_bytes(data);
    fields.extend(parameters.iter().map(|parameter| {
        let all = u64::MAX >> (64 - parameter.bits);
        let raw = data >> parameter.bit & all;
        // The highest numbers: no data, and out of range (RV-C, 3.2.3).
        let absence = match parameter.bits {
            _ if parameter.state(raw).is_some() => None,
            _ if raw == all => Some(Absence::NotAvailable),
            2 | 8.. if raw == all - 1 => Some(Absence::Error),
            _ => None,
        };
        parameter.field(raw, absence)
    }));
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table;

    #[test]
    fn every_group_has_a_name() {
        table::check(FILE, &[&GROUPS]);
        assert_eq!(name(0x1_FFB7), Some("TANK_STATUS"));
        let mut taken: FxHashMap<u32, u64> = FxHashMap::default();
        for line in lines(PARAMETERS_FILE) {
            let parameter = Parameter::read(line).unwrap_or_else(|| panic!("{line}"));
            assert!(
                name(parameter.pgn).is_some() && parameter.bits <= 32 && parameter.bit + parameter.bits <= 64,
                "{line}"
            );
            let bits = ((1_u64 << parameter.bits) - 1) << parameter.bit;
            let taken = taken.entry(parameter.pgn).or_default();
            assert_eq!(*taken & bits, 0, "{line}");
            *taken |= bits;
        }
        assert_eq!(taken.len(), 115);
    }

    /// By hand from the scalings of the source: 50 mV, 1 mA from −2000 kA, 1/32 °C from −273 °C, half a per cent.
    #[test]
    fn groups_are_shown_as_values() {
        let shown = |pgn, data: [u8; 8]| {
            let mut all = Vec::new();
            assert!(fields(pgn, &data, &mut all));
            all.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
        };
        assert_eq!(
            shown(0x1_FFFD, [1, 120, 0x0B, 1, 0x84, 0x7E, 0x35, 0x77]),
            "instance 1 (main house battery bank), device_priority 120 (battery soc device), dc_voltage 13.35 V, dc_current -5.5 A"
        );
        assert_eq!(
            shown(0x1_FFFC, [1, 100, 0x20, 0x25, 150, 0xFF, 0xFF, 0xFF]),
            "instance 1 (main house battery bank), device_priority 100 (inverter charger), source_temperature 24 °C, state_of_charge 75 %, \
             time_remaining not available"
        );
    }
}
