//! Values in the groups that most vehicles send, and the names of suspect parameters (SPN), without a database. The table, with its
//! sources, is `data/j1939-parameters.csv`.

use std::sync::LazyLock;

use rustc_hash::FxHashMap;

use crate::Field;
use crate::table::{Scale, lines};

const FILE: &str = include_str!("../../data/j1939-parameters.csv");

/// The length of all these groups, in bytes.
const GROUP_BYTES: usize = 8;

/// A parameter at its place in a group.
#[derive(Debug)]
pub struct Parameter {
    pub pgn: u32,
    /// From the lowest bit of the first byte.
    pub bit: u32,
    pub bits: u32,
    /// `None` where it is not known.
    spn: Option<u32>,
    pub name: &'static str,
    pub unit: &'static str,
    scale: Scale,
    offset: f64,
    /// The names of its states, by number.
    states: Vec<(u32, &'static str)>,
}

/// The parameters in the order of the table, and where each group's begin and end in it.
struct Parameters {
    all: Vec<Parameter>,
    groups: FxHashMap<u32, (usize, usize)>,
    names: FxHashMap<u32, &'static str>,
}

static PARAMETERS: LazyLock<Parameters> = LazyLock::new(|| {
    // What cannot be read is left out, of which the table has nothing: a test reads every line.
    let all: Vec<Parameter> = lines(FILE).filter_map(Parameter::read).collect();
    let mut groups = FxHashMap::default();
    for (at, parameter) in all.iter().enumerate() {
        groups.entry(parameter.pgn).or_insert((at, at)).1 = at + 1;
    }
    let names = all.iter().filter_map(|parameter| Some((parameter.spn?, parameter.name))).collect();
    Parameters { all, groups, names }
});

impl Parameter {
    pub fn read(line: &'static str) -> Option<Self> {
        let columns: Vec<&'static str> = line.split(',').collect();
        let &[pgn, bit, bits, spn, name, unit, factor, offset, states] = &columns[..] else { return None };
        Some(Self {
            pgn: u32::from_str_radix(pgn, 16).ok()?,
            bit: bit.parse().ok()?,
            bits: bits.parse().ok()?,
            spn: if spn.is_empty() { None } else { Some(spn.parse().ok()?) },
            name,
            unit,
            scale: Scale::read(factor)?,
            offset: offset.parse().ok()?,
            states: match states {
                "switch" => states_of("off|on"),
                "fault" => states_of("normal|fault|not trusted"),
                "limit" => states_of("normal|too high|too low"),
                "late" => states_of("normal|timed out|not trusted"),
                states => states_of(states),
            },
        })
    }

    /// The field of these bits.
    pub fn field(&self, raw: u64, absence: Option<Absence>) -> Field {
        match absence {
            Some(Absence::NotAvailable) => Field::missing(self.name),
            Some(Absence::Error) => Field::missing(self.name).meaning(Some("error")),
            Some(Absence::Reserved) => Field::missing(self.name).meaning(Some("reserved")),
            None if !self.states.is_empty() => Field::number(self.name, raw as i64).meaning(self.state(raw)),
            // States by number.
            None if self.bits < 8 => Field::number(self.name, raw as i64),
            None => Field::real(self.name, self.scale.of(raw as f64) + self.offset, self.unit),
        }
    }

    /// The name of a state.
    pub fn state(&self, raw: u64) -> Option<&'static str> {
        self.states.iter().find(|(number, _)| u64::from(*number) == raw).map(|(_, name)| *name)
    }

    /// What the bits say in place of a value (SAE J1939-71, ranges of transmitted values).
    fn indicator(&self, raw: u64) -> Option<Absence> {
        let all = (1 << self.bits) - 1;
        match self.bits {
            0..8 if raw == all => Some(Absence::NotAvailable),
            2 | 4 if raw == all - 1 => Some(Absence::Error),
            0..8 => None,
            _ => match raw >> (self.bits - 8) {
                0xFF => Some(Absence::NotAvailable),
                0xFE => Some(Absence::Error),
                0xFB..=0xFD => Some(Absence::Reserved),
                _ => None,
            },
        }
    }
}

/// Why there is no value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Absence {
    NotAvailable,
    Error,
    Reserved,
}

/// States by number: `0=off|2=on`, or their names alone from 0 on, where one without a name is empty.
fn states_of(text: &'static str) -> Vec<(u32, &'static str)> {
    let states = text.split('|').zip(0..).map(|(state, place)| match state.split_once('=') {
        Some((number, name)) => (number.parse().unwrap_or(u32::MAX), name),
        None => (place, state),
    });
    states.filter(|(_, name)| !name.is_empty()).collect()
}

/// Adds the values of a group; false if the table does not have it, or it is not as long as it should be.
pub fn fields(pgn: u32, data: &[u8], fields: &mut Vec<Field>) -> bool {
    let Ok(data) = <[u8; GROUP_BYTES]>::try_from(data) else { return false };
    let Some(&(first, end)) = PARAMETERS.groups.get(&pgn) else { return false };
    let data = u64::from_le_bytes(data);
    fields.extend(PARAMETERS.all[first..end].iter().map(|parameter| {
        let raw = data >> parameter.bit & ((1 << parameter.bits) - 1);
        parameter.field(raw, parameter.indicator(raw))
    }));
    true
}

/// The name of a suspect parameter number.
pub fn name(spn: u32) -> Option<&'static str> {
    PARAMETERS.names.get(&spn).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(pgn: u32, data: [u8; 8]) -> String {
        let mut all = Vec::new();
        assert!(fields(pgn, &data, &mut all));
        all.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
    }

    #[test]
    fn every_line_is_read_and_no_two_parameters_of_a_group_share_a_bit() {
        let mut taken: FxHashMap<u32, u64> = FxHashMap::default();
        let mut before = 0;
        for line in lines(FILE) {
            let parameter = Parameter::read(line).unwrap_or_else(|| panic!("{line}"));
            assert!(matches!(parameter.bits, 1..8 | 8 | 16 | 32), "{line}");
            let (Scale::Times(scale) | Scale::Over(scale)) = parameter.scale;
            assert!(parameter.bit + parameter.bits <= 64 && scale > 0.0, "{line}");
            assert!(parameter.states.len() < 1 << parameter.bits, "{line}");
            // The lines of a group follow each other.
            assert!(parameter.pgn == before || !taken.contains_key(&parameter.pgn), "{line}");
            before = parameter.pgn;
            let bits = ((1_u64 << parameter.bits) - 1) << parameter.bit;
            let taken = taken.entry(parameter.pgn).or_default();
            assert_eq!(*taken & bits, 0, "{line}");
            *taken |= bits;
            if let Some(spn) = parameter.spn {
                assert_eq!(name(spn), Some(parameter.name), "two names: {line}");
            }
        }
        assert!(taken.len() > 35);
    }

    /// Values by hand from the published scalings: 0.125 rpm, 1 % from −125 %, 1/256 km/h, 1 °C from −40 °C, 1/32 °C from −273 °C.
    #[test]
    fn groups_are_shown_as_values() {
        assert_eq!(
            shown(0xF004, [0x01, 0x7D, 0xA0, 0x68, 0x13, 0xFF, 0xF0, 0xFF]),
            "engine_torque_mode 1, demanded_engine_torque 0 %, actual_engine_torque 35 %, engine_speed 621 rpm, \
             engine_starter_mode 0, engine_demand_torque not available"
        );
        assert!(shown(0xFEF1, [0xF7, 0x80, 0x50, 0x10, 0, 0, 0, 0]).starts_with(
            "two_speed_axle not available, parking_brake 1 (on), cruise_pause not available, wheel_based_speed 80.5 km/h, \
             cruise_active 0 (off), cruise_enable 0 (off), brake_switch 1 (on)"
        ));
        assert!(
            shown(0xFEEE, [130, 0xFE, 0x00, 0x2D, 0xFF, 0xFF, 0xFC, 0])
                .starts_with("engine_coolant_temperature 90 °C, fuel_temperature not available (error)")
        );
        assert!(
            shown(0xFEEE, [130, 60, 0x00, 0x2D, 0xFF, 0xFF, 0xFC, 0])
                .contains("engine_oil_temperature 87 °C")
        );
    }

    /// By hand from the scalings of AgIsoStack++: 0.001 m/s and m, 1/4 per km from −8032; of ISO 11783-7: 0.4 %, 10 N from −320 kN, 1/8 rpm.
    #[test]
    fn a_tractor_and_its_implement_say_how_fast_and_where() {
        assert_eq!(
            shown(0xFE48, [0xB8, 0x0B, 0x40, 0x42, 0x0F, 0x00, 0xFF, 0xD5]),
            "wheel_based_machine_speed 3 m/s, wheel_based_machine_distance 1000 m, tractor_power_time not available, \
             wheel_based_direction 1 (forward), key_switch 1 (not off), implement_operations 1 (start), operator_direction not available"
        );
        assert_eq!(
            shown(0xFE45, [125, 0x7F, 0x7D, 0x64, 0x7D, 0xFF, 0xFF, 0xFF]),
            "rear_hitch_position 50 %, rear_hitch_limit not available, rear_hitch_in_work 1 (yes), rear_lower_link_force 0 %, \
             rear_hitch_draft 1000 N"
        );
        assert!(
            shown(0xFE43, [0xE0, 0x10, 0xE0, 0x10, 0x53, 0xFF, 0xFF, 0xFF])
                .starts_with("rear_pto_speed 540 rpm")
        );
        assert!(
            shown(0xAD00, [0x90, 0x7D, 0xFD, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF])
                .starts_with("commanded_curvature 4 1/km")
        );
        assert!(shown(0xFE13, [225, 125, 0xF1, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF]).starts_with(
            "extend_flow 100 %, retract_flow 0 %, valve_state 1 (extend), fail_safe not available"
        ));
    }

    #[test]
    fn a_group_of_another_length_and_one_that_is_not_in_the_table_stay_bytes() {
        assert!(!fields(0xF004, &[0; 7], &mut Vec::new()));
        assert!(!fields(0xFF00, &[0; 8], &mut Vec::new()));
    }

    #[test]
    fn suspect_parameters_have_names() {
        assert_eq!(name(100), Some("engine_oil_pressure"));
        assert_eq!(name(7969), None);
    }
}
