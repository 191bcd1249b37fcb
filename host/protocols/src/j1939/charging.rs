//! Values in the messages between a charger and a vehicle's battery management (GB/T 27930). The table, with its sources, is
//! `data/gbt-27930.csv`. The voltages and temperatures of single cells (BMV, BMT) stay bytes.

use std::sync::LazyLock;

use super::header::Header;
use super::names;
use super::parameters::{Absence, Parameter};
use crate::Field;
use crate::table::lines;

const FILE: &str = include_str!("../../data/gbt-27930.csv");

// What cannot be read is left out, of which the table has nothing: a test reads every line.
static PARAMETERS: LazyLock<Vec<Parameter>> =
    LazyLock::new(|| lines(FILE).filter_map(Parameter::read).collect());

/// Adds the values of a message; false if it is no message of charging, or one without values.
pub fn fields(header: Header, data: &[u8], fields: &mut Vec<Field>) -> bool {
    if !names::is_charging(header) {
        return false;
    }
    let before = fields.len();
    let own = PARAMETERS.iter().filter(|parameter| parameter.pgn == header.pgn);
    // A message may end sooner than the standard has it, as the status of chargers does; what is there counts.
    fields.extend(own.filter_map(|parameter| field(parameter, data)));
    fields.len() > before
}

/// `None` if the message ends before it.
fn field(parameter: &Parameter, data: &[u8]) -> Option<Field> {
    let (first, end) = (parameter.bit / 8, (parameter.bit + parameter.bits).div_ceil(8));
    let bytes = data.get(first as usize..end as usize)?;
    // What need not be given is all ones.
    let is_given = bytes.iter().any(|byte| *byte != 0xFF);
    let text = match (parameter.unit, bytes) {
        ("ascii" | "version" | "date" | "clock", _) if !is_given => {
            return Some(Field::missing(parameter.name));
        }
        ("ascii", bytes) => text(bytes),
        ("version", &[minor, low, high]) => Some(format!("{}.{minor}", u16::from_le_bytes([low, high]))),
        ("date", &[day, month, low, high]) => {
            Some(format!("{}-{month:02}-{day:02}", u16::from_le_bytes([low, high])))
        }
        ("clock", bytes) => clock(bytes),
        _ => {
            let raw = bytes.iter().rev().fold(0, |raw, byte| raw << 8 | u64::from(*byte));
            let all = (1 << parameter.bits) - 1;
            let raw = raw >> (parameter.bit % 8) & all;
            let is_absent = raw == all && parameter.state(raw).is_none();
            return Some(parameter.field(raw, is_absent.then_some(Absence::NotAvailable)));
        }
    };
    Some(text.map_or_else(|| Field::bytes(parameter.name, bytes), |text| Field::text(parameter.name, text)))
}

/// ASCII up to the first zero; `None` if it is none.
fn text(bytes: &[u8]) -> Option<String> {
    let end = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
    let text = std::str::from_utf8(&bytes[..end]).ok()?;
    (end > 0 && text.bytes().all(|byte| (b' '..=b'~').contains(&byte))).then(|| text.to_owned())
}

/// Second, minute, hour, day, month, and the year from its lower half on, each as two decimal digits.
fn clock(bytes: &[u8]) -> Option<String> {
    let is_decimal = bytes.iter().all(|byte| byte >> 4 < 10 && byte & 15 < 10);
    let &[second, minute, hour, day, month, year, century] = bytes else { return None };
    is_decimal.then(|| {
        format!("{century:02X}{year:02X}-{month:02X}-{day:02X} {hour:02X}:{minute:02X}:{second:02X}")
    })
}

#[cfg(test)]
mod tests {
    use rustc_hash::FxHashSet;

    use super::*;

    fn shown(id: u32, data: &[u8]) -> String {
        let header = Header::of(cantap_trace::Id::extended(id).unwrap()).unwrap();
        let mut all = Vec::new();
        assert!(fields(header, data, &mut all));
        all.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
    }

    #[test]
    fn every_line_is_read_and_no_two_parameters_of_a_message_share_a_bit() {
        let mut taken = FxHashSet::default();
        for line in lines(FILE) {
            let parameter = Parameter::read(line).unwrap_or_else(|| panic!("{line}"));
            let is_text = matches!(parameter.unit, "ascii" | "version" | "date" | "clock");
            assert!(parameter.bits <= 32 || is_text, "{line}");
            for bit in parameter.bit..parameter.bit + parameter.bits {
                assert!(taken.insert((parameter.pgn, bit)), "{line}");
            }
        }
        assert!(taken.len() > 1000);
    }

    /// From a recorded charge (sut4nd0/gbt27930-2015), whose values that program shows so, too.
    #[test]
    fn a_charge_is_shown_as_values() {
        assert_eq!(shown(0x1826_F456, &[1, 1, 0]), "protocol_version \"1.1\"");
        assert_eq!(shown(0x1827_56F4, &[0xA5, 0x10]), "highest_total_voltage 426.1 V");
        assert_eq!(
            shown(0x1801_F456, &[0xAA, 1, 1, 1, 1, 0x31, 0x32, 0x33]),
            "recognition 170 (vehicle recognised), charger_number 16843009, region \"123\""
        );
        assert_eq!(
            shown(0x1C06_56F4, &[0x72, 1, 0xDA, 5, 0x2A, 2, 0xA5, 0x10, 0x73, 8, 3, 0xC6, 0x0E]),
            "highest_cell_voltage 3.7 V, highest_charging_current -250.2 A, total_energy 55.4 kWh, highest_total_voltage 426.1 V, \
             highest_temperature 65 °C, state_of_charge 77.6 %, battery_voltage 378.2 V"
        );
        assert_eq!(
            shown(0x1808_F456, &[0x1C, 0x25, 0x7C, 1, 0xDC, 5, 0xA0, 0x0F]),
            "highest_output_voltage 950 V, lowest_output_voltage 38 V, highest_output_current -250 A, lowest_output_current 0 A"
        );
        assert_eq!(shown(0x1009_56F4, &[0xAA]), "battery_ready 170 (ready)");
        assert_eq!(
            shown(0x1810_56F4, &[0xA5, 0x10, 0xD8, 0x0E, 2]),
            "demanded_voltage 426.1 V, demanded_current -20 A, charging_mode 2 (constant current)"
        );
        assert_eq!(
            shown(0x1C11_56F4, &[0xC5, 0x0E, 0xA0, 0x0F, 0x4C, 0x61, 0x4D, 0, 0]),
            "charging_voltage 378.1 V, charging_current 0 A, highest_cell_voltage_now 3.32 V, highest_cell_group 6, state_of_charge 77 %, \
             remaining_time 0 min"
        );
        // Without its last byte, as this charger sends it.
        assert_eq!(
            shown(0x1812_F456, &[0x24, 0x0B, 0xA0, 0x0F, 0, 0, 0xFD]),
            "output_voltage 285.2 V, output_current 0 A, charging_time 0 min, charging_permitted 1 (permitted)"
        );
        assert_eq!(
            shown(0x1813_56F4, &[0x1E, 0x36, 6, 0x35, 0x0F, 0, 0x10]),
            "highest_cell_number 31, highest_battery_temperature 4 °C, highest_temperature_number 7, lowest_battery_temperature 3 °C, \
             lowest_temperature_number 16, cell_voltage_state 0 (normal), charge_state 0 (normal), charging_overcurrent 0 (normal), \
             battery_overtemperature 0 (normal), insulation 0 (normal), connector 0 (normal), charging_permitted 1 (permitted)"
        );
        assert!(
            shown(0x1019_56F4, &[0x40, 0, 0, 0])
                .contains("cell_voltage_reached 0 (no), charger_stopped 1 (yes)")
        );
        assert!(
            shown(0x101A_F456, &[4, 0, 0xF0, 0xF0])
                .starts_with("condition_reached 0 (no), stopped_by_hand 1 (yes)")
        );
        assert_eq!(
            shown(0x181D_F456, &[0, 0, 1, 0, 1, 1, 1, 1]),
            "charging_time 0 min, output_energy 0.1 kWh, charger_number 16843009"
        );
        assert!(
            shown(0x081E_56F4, &[0xF0, 0xF1, 0xF0, 0xFC])
                .contains("clock_and_output_timeout 1 (timed out), charger_ready_timeout 0")
        );
    }

    #[test]
    fn what_is_not_given_is_not_available_and_a_clock_is_a_time() {
        assert_eq!(shown(0x1807_F456, &[0xFF; 7]), "clock not available");
        assert_eq!(
            shown(0x1807_F456, &[0x41, 0x08, 0x22, 0x25, 0x12, 0x23, 0x20]),
            "clock \"2023-12-25 22:08:41\""
        );
        let mut recognition = [0xFF; 49];
        recognition[..8].copy_from_slice(&[1, 1, 0, 3, 0xF0, 5, 0x40, 0x0E]);
        recognition[24..41].copy_from_slice(b"WVWZZZ1KZAW000001");
        recognition[41..46].copy_from_slice(&[1, 4, 5, 0xE7, 7]);
        assert_eq!(
            shown(0x1C02_56F4, &recognition),
            "protocol_version \"1.1\", battery_type 3 (lithium iron phosphate), rated_capacity 152 Ah, rated_voltage 364.8 V, \
             battery_manufacturer not available, battery_serial not available, battery_year not available, battery_month not available, \
             battery_day not available, charges not available, battery_ownership not available, vin \"WVWZZZ1KZAW000001\", \
             software_serial 1, software_date \"2023-05-04\""
        );
        // Elsewhere these numbers are other groups.
        let header = Header::of(cantap_trace::Id::extended(0x1810_0300).unwrap()).unwrap();
        assert!(!fields(header, &[0; 8], &mut Vec::new()));
    }
}
