//! OBD-II over UDS (SAE J1979-2): parameters, monitors and vehicle information as data identifiers F4xx, F6xx and F8xx.
//!
//! A parameter's value is the same as in service 01, by the same formula (ISO 14229-1, table C.1, has the ranges). Vehicle information is
//! told apart by its length, with and without the number of items in front: no public description says which servers leave it out. Test
//! results are shown as bytes, for the same reason.

use super::values::number;
use super::{monitors, names, obd, parameters};
use crate::Field;

/// The name of a data identifier.
pub fn data_identifier(did: u16) -> Option<&'static str> {
    let [high, low] = did.to_be_bytes();
    let own = match high {
        0xF4 => parameters::name(low),
        0xF6 => monitors::name(low),
        0xF8 => obd::info_name(low),
        _ => None,
    };
    own.or_else(|| names::data_identifier(did))
}

/// Number of bytes of a value that always has the same.
pub fn length(did: u16) -> Option<usize> {
    match did.to_be_bytes() {
        [0xF4, pid] => parameters::length(pid),
        // These four bytes say which there are.
        [0xF6 | 0xF8, low] if low.is_multiple_of(0x20) => Some(4),
        [0xF8, 0x02] => Some(VIN_BYTES),
        _ => None,
    }
}

const VIN_BYTES: usize = 17;
const CALIBRATION_BYTES: usize = 16;
const VERIFICATION_BYTES: usize = 4;

/// Adds a value's fields; false if it is none of OBD-II's, or not as long as it should be.
pub fn value(did: u16, data: &[u8], fields: &mut Vec<Field>) -> bool {
    match did.to_be_bytes() {
        [0xF4, pid] if parameters::length(pid) == Some(data.len()) => parameters::values(pid, data, fields),
        [0xF6 | 0xF8, low] if low.is_multiple_of(0x20) && data.len() == 4 => {
            fields.push(Field::text("supported", super::values::supported(low, data)));
        }
        [0xF8, 0x02] => {
            let Some(vins) = items(data, VIN_BYTES).filter(|items| items.len() == 1) else { return false };
            fields.push(Field::text("vin", obd::letters(vins[0])));
        }
        [0xF8, 0x04] => {
            let Some(items) = items(data, CALIBRATION_BYTES) else { return false };
            fields.extend(items.into_iter().map(|item| Field::text("calibration", obd::letters(item))));
        }
        [0xF8, 0x06] => {
            let Some(items) = items(data, VERIFICATION_BYTES) else { return false };
            let number = |item: &[u8]| Field::hex("verification_number", number(item), 8);
            fields.extend(items.into_iter().map(number));
        }
        [0xF8, 0x0A] if data.len() >= 20 => fields.push(Field::text("ecu_name", obd::letters(data))),
        _ => return false,
    }
    true
}

/// The items of a list, each of so many bytes, with or without their number in front.
fn items(data: &[u8], each: usize) -> Option<Vec<&[u8]>> {
    let list = match data.len() % each {
        0 => data,
        1 if usize::from(data[0]) == data.len() / each => &data[1..],
        _ => return None,
    };
    (!list.is_empty()).then(|| list.chunks_exact(each).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(did: u16, data: &[u8]) -> String {
        let mut fields = Vec::new();
        let is_known = value(did, data, &mut fields);
        let shown = fields.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
        if is_known { shown } else { format!("unknown {shown}") }
    }

    #[test]
    fn identifiers_have_the_values_of_their_parameters() {
        for (did, data, expected) in [
            (0xF40C, &[0x1A, 0xF8][..], "engine_speed 1726 rpm"),
            (0xF405, &[0x7B], "coolant_temperature 83 °C"),
            (0xF466, &[1, 1, 0, 2, 0], "air_flow_a 8 g/s, air_flow_b not available"),
            (0xF400, &[0x80, 0, 0, 1], "supported \"01 20\""),
            (0xF600, &[0xC0, 0, 0, 0], "supported \"01 02\""),
            (0xF802, b"WVWZZZ1KZAW000001", "vin \"WVWZZZ1KZAW000001\""),
            (0xF802, b"\x01WVWZZZ1KZAW000001", "vin \"WVWZZZ1KZAW000001\""),
            (0xF804, b"JMB*36761500\0\0\0\0", "calibration \"JMB*36761500\""),
            (
                0xF804,
                b"\x02JMB*36761500\0\0\0\0JMB*36761501\0\0\0\0",
                "calibration \"JMB*36761500\", calibration \"JMB*36761501\"",
            ),
            (0xF806, &[1, 0x17, 0x91, 0xBC, 0x82], "verification_number 0x1791BC82"),
            (0xF80A, b"ECM\0-EngineControl\0\0", "ecu_name \"ECM-EngineControl\""),
            // Not as long as the parameter, or of nobody's.
            (0xF40C, &[0x1A], "unknown "),
            (0xF802, b"WVWZZZ1KZAW00000", "unknown "),
            (0xF806, &[2, 0x17, 0x91, 0xBC, 0x82], "unknown "),
            (0xF190, b"WVWZZZ1KZAW000001", "unknown "),
        ] {
            assert_eq!(shown(did, data), expected, "{did:04X}");
        }
        let names = [0xF40C, 0xF4EF, 0xF621, 0xF802, 0xF190, 0x1234].map(data_identifier);
        let expected =
            [Some("engine_speed"), Some("OBD PID"), Some("catalyst, bank 1"), Some("VIN"), Some("VIN"), None];
        assert_eq!(names, expected);
    }
}
