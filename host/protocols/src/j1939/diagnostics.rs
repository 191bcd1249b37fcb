//! Diagnostic messages other than lists of trouble codes (SAE J1939-73): readiness (DM5, DM21, DM26), calibrations (DM19), monitor
//! performance (DM20), supported parameters (DM24).
//!
//! Layouts as in the Equipment and Tool Institute's program j1939-84, whose tests have the messages of this file's tests.

use super::{names, parameters};
use crate::Field;

const DM5: u32 = 0xFECE;
const DM19: u32 = 0xD300;
const DM20: u32 = 0xC200;
const DM21: u32 = 0xC100;
const DM24: u32 = 0xFDB6;
const DM26: u32 = 0xFDB8;

/// The bytes of a calibration in DM19: verification number and identification.
const CALIBRATION_BYTES: usize = 20;
/// The bytes of a ratio in DM20: SPN, numerator, denominator.
const RATIO_BYTES: usize = 7;

/// Adds a message's fields; false if it is none of these, or does not have their length.
pub fn fields(pgn: u32, data: &[u8], fields: &mut Vec<Field>) -> bool {
    match (pgn, data) {
        (DM5, [active, before, compliance, monitors @ ..]) if monitors.len() == 5 => {
            fields.push(byte("active_trouble_codes", *active));
            fields.push(byte("previously_active_trouble_codes", *before));
            let compliance = byte("obd_compliance", *compliance).meaning(names::obd_compliance(*compliance));
            fields.push(compliance);
            monitored(monitors, fields);
        }
        (DM26, [low, high, warm_ups, monitors @ ..]) if monitors.len() == 5 => {
            fields.push(word("time_since_engine_start", [*low, *high], "s"));
            fields.push(byte("warm_ups_since_cleared", *warm_ups));
            monitored(monitors, fields);
        }
        (DM21, &[a, b, c, d, e, f, g, h]) => {
            fields.push(word("distance_with_mil_on", [a, b], "km"));
            fields.push(word("distance_since_cleared", [c, d], "km"));
            fields.push(word("time_with_mil_on", [e, f], "min"));
            fields.push(word("time_since_cleared", [g, h], "min"));
        }
        (DM19, data) if !data.is_empty() && data.len().is_multiple_of(CALIBRATION_BYTES) => {
            for calibration in data.chunks_exact(CALIBRATION_BYTES) {
                let (number, text) = calibration.split_at(4);
                let number = number.iter().rev().fold(0_u32, |number, byte| number << 8 | u32::from(*byte));
                fields.push(Field::text("calibration", printable(text)));
                fields.push(Field::hex("verification_number", number, 8));
            }
        }
        (DM20, &[a, b, c, d, ref ratios @ ..])
            if !ratios.is_empty() && ratios.len().is_multiple_of(RATIO_BYTES) =>
        {
            fields.push(word("ignition_cycles", [a, b], ""));
            fields.push(word("monitoring_conditions_encountered", [c, d], ""));
            for ratio in ratios.chunks_exact(RATIO_BYTES) {
                fields.push(suspect(ratio));
                fields.push(Field::number("numerator", u16::from_le_bytes([ratio[3], ratio[4]])));
                fields.push(Field::number("denominator", u16::from_le_bytes([ratio[5], ratio[6]])));
            }
        }
        (DM24, data) if !data.is_empty() && data.len().is_multiple_of(4) => {
            for parameter in data.chunks_exact(4) {
                // A set bit means that there is no support.
                let missing = parameter[2] & 7;
                let kinds = ["expanded freeze frame", "data stream", "scaled test results"];
                let supported = kinds.into_iter().enumerate().filter(|(bit, _)| missing >> bit & 1 == 0);
                let supported: Vec<_> = supported.map(|(_, kind)| kind).collect();
                fields.push(suspect(parameter));
                fields.push(Field::text("supported_in", supported.join(", ")));
                fields.push(Field::number("length", parameter[3]).unit("bytes"));
            }
        }
        _ => return false,
    }
    true
}

/// The suspect parameter number at the beginning of these bytes: 19 bits.
fn suspect(bytes: &[u8]) -> Field {
    let spn = u32::from(bytes[0]) | u32::from(bytes[1]) << 8 | u32::from(bytes[2] >> 5) << 16;
    Field::number("spn", spn).meaning(parameters::name(spn))
}

/// From FB on, a byte is no value (SAE J1939-71).
fn byte(name: &'static str, value: u8) -> Field {
    if value > 0xFA { Field::missing(name) } else { Field::number(name, value) }
}

/// From FB00 on, two bytes are no value (SAE J1939-71).
fn word(name: &'static str, bytes: [u8; 2], unit: &'static str) -> Field {
    let value = u16::from_le_bytes(bytes);
    if value > 0xFAFF { Field::missing(name) } else { Field::number(name, value).unit(unit) }
}

/// The supported monitors, and those of them that are not complete.
fn monitored(bytes: &[u8], fields: &mut Vec<Field>) {
    let &[continuous, a, b, c, d] = bytes else { return };
    let (supported, open) = (u16::from_le_bytes([a, b]), u16::from_le_bytes([c, d]));
    let names = |of_continuous: u8, others: u16| {
        let list = names::monitors(of_continuous & 7, others).collect::<Vec<_>>().join(", ");
        if list.is_empty() { "none".to_owned() } else { list }
    };
    fields.push(Field::text("supported", names(continuous, supported)));
    fields.push(Field::text("not_complete", names(continuous & continuous >> 4, supported & open)));
}

/// The characters of a text that is filled up with zeros or spaces.
fn printable(bytes: &[u8]) -> String {
    let shown = bytes.iter().filter(|byte| byte.is_ascii_graphic() || **byte == b' ');
    shown.map(|byte| char::from(*byte)).collect::<String>().trim_end().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(pgn: u32, data: &[u8]) -> String {
        let mut all = Vec::new();
        let is_known = fields(pgn, data, &mut all);
        assert_eq!(is_known, !all.is_empty());
        all.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
    }

    /// The messages and values of j1939-84's own tests; the first of DM24 are a vehicle's.
    #[test]
    fn messages_are_read_as_by_j1939_84() {
        let calibrations = [
            &[0x51, 0xBA, 0xFE, 0xBD][..],
            b"ANT5ASR1  \0\0\0\0\0\0",
            &[0x96, 0xBF, 0xDC, 0x40],
            b"PBT5MPR3\0\0\0\0\0\0\0\0",
        ]
        .concat();
        for (pgn, data, expected) in [
            (
                DM19,
                &calibrations[..],
                "calibration \"ANT5ASR1\", verification_number 0xBDFEBA51, calibration \"PBT5MPR3\", \
                 verification_number 0x40DCBF96",
            ),
            (
                DM20,
                &[0xA5, 0xA5, 0x5A, 0x5A, 0xFF, 0xFF, 0xFF, 0xFF, 0xFE, 0xFF, 0xFF],
                "ignition_cycles 42405, monitoring_conditions_encountered 23130, spn 524287, numerator 65279, \
                 denominator 65535",
            ),
            (
                DM21,
                &[0x10, 0x27, 0x20, 0x4E, 0x30, 0x75, 0x40, 0x9C],
                "distance_with_mil_on 10000 km, distance_since_cleared 20000 km, time_with_mil_on 30000 min, \
                 time_since_cleared 40000 min",
            ),
            (
                DM21,
                &[0xFF, 0xFA, 0xFF, 0xFF, 0x00, 0xFE, 0, 0],
                "distance_with_mil_on 64255 km, distance_since_cleared not available, time_with_mil_on not available, \
                 time_since_cleared 0 min",
            ),
            (
                DM24,
                &[0x5C, 0x00, 0x1C, 0x01, 0x20, 0x02, 0x1C, 0x02],
                "spn 92 (engine_load), supported_in \"expanded freeze frame, data stream\", length 1 bytes, spn 544, \
                 supported_in \"expanded freeze frame, data stream\", length 2 bytes",
            ),
        ] {
            assert_eq!(shown(pgn, data), expected);
        }
    }

    /// By the bits of j1939-84's tables.
    #[test]
    fn readiness_names_the_monitors() {
        assert_eq!(
            shown(DM5, &[2, 0xFF, 0x14, 0x17, 0x01, 0x0C, 0x01, 0x04]),
            "active_trouble_codes 2, previously_active_trouble_codes not available, obd_compliance 20 (HD OBD), \
             supported \"misfire, fuel system, comprehensive component, catalyst, diesel particulate filter, NOx catalyst or adsorber\", \
             not_complete \"misfire, catalyst, diesel particulate filter\""
        );
        assert_eq!(
            shown(DM26, &[0x2C, 0x01, 3, 0, 0, 0, 0xFF, 0xFF]),
            "time_since_engine_start 300 s, warm_ups_since_cleared 3, supported \"none\", not_complete \"none\""
        );
    }

    #[test]
    fn a_message_of_another_length_is_shown_as_bytes() {
        for (pgn, length) in
            [(DM5, 7), (DM19, 21), (DM19, 0), (DM20, 4), (DM20, 10), (DM21, 9), (DM24, 5), (DM26, 3)]
        {
            assert_eq!(shown(pgn, &vec![1; length]), "", "{pgn:X} {length}");
        }
        assert_eq!(shown(0xF004, &[0; 8]), "");
    }
}
