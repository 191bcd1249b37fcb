//! OBD-II: the content of the services of SAE J1979, with values in their units.

use super::names::FILE;
use super::parameters::{length, name, values};
use super::values::{number, supported};
use super::{dtc, monitors, names};
use crate::Field;
use crate::table::Table;

/// The content of a request after the service byte.
pub fn request(sid: u8, rest: &[u8], fields: &mut Vec<Field>) {
    match sid {
        1 | 2 => {
            let step = usize::from(sid);
            for pid in rest.chunks(step).map(|chunk| chunk[0]) {
                fields.push(Field::hex("pid", pid, 2).meaning(name(pid)));
            }
        }
        6 => {
            for mid in rest {
                fields.push(Field::hex("mid", *mid, 2).meaning(monitors::name(*mid)));
            }
        }
        8 => {
            if let Some((&tid, data)) = rest.split_first() {
                fields.push(Field::hex("tid", tid, 2).meaning(test_name(tid)));
                if !data.is_empty() {
                    fields.push(Field::bytes("parameters", data));
                }
            }
        }
        9 => {
            for pid in rest {
                fields.push(Field::hex("pid", *pid, 2).meaning(info_name(*pid)));
            }
        }
        _ if !rest.is_empty() => fields.push(Field::bytes("parameters", rest)),
        _ => {}
    }
}

static TESTS: Table = Table::new(FILE, "obd_test");
static INFORMATION: Table = Table::new(FILE, "obd_information");

#[cfg(test)]
pub static TABLES: [&Table; 2] = [&TESTS, &INFORMATION];

/// Tests and actions of service 08.
fn test_name(tid: u8) -> Option<&'static str> {
    if tid.is_multiple_of(0x20) { Some("supported") } else { TESTS.get(tid) }
}

/// Vehicle information of service 09.
pub fn info_name(pid: u8) -> Option<&'static str> {
    INFORMATION.get(pid)
}

/// The content of a response after the service byte; the request then has no fields of its own.
pub fn response(sid: u8, mut rest: &[u8], fields: &mut Vec<Field>) {
    match sid {
        1 | 2 => {
            while let Some((&pid, after)) = rest.split_first() {
                fields.push(Field::hex("pid", pid, 2).meaning(name(pid)));
                let mut after = after;
                if sid == 2
                    && let Some((&frame, behind)) = after.split_first()
                {
                    fields.push(Field::number("freeze_frame", frame));
                    after = behind;
                }
                if let Some(length) = length(pid).filter(|length| *length <= after.len()) {
                    values(pid, &after[..length], fields);
                    rest = &after[length..];
                } else {
                    fields.push(Field::bytes("value", after));
                    rest = &[];
                }
            }
        }
        3 | 7 | 0x0A => {
            if let Some((&count, codes)) = rest.split_first() {
                fields.push(Field::number("trouble_codes", count));
                fields.push(Field::text("codes", dtc::list(codes)));
            }
        }
        6 => monitors::results(rest, fields),
        8 => {
            let Some((&tid, after)) = rest.split_first() else { return };
            fields.push(Field::hex("tid", tid, 2).meaning(test_name(tid)));
            match after {
                [_, _, _, _] if tid.is_multiple_of(0x20) => {
                    fields.push(Field::text("supported", supported(tid, after)));
                }
                [] => {}
                _ => fields.push(Field::bytes("value", after)),
            }
        }
        9 => {
            let Some((&pid, after)) = rest.split_first() else { return };
            fields.push(Field::hex("pid", pid, 2).meaning(info_name(pid)));
            if pid == 0 && after.len() >= 4 {
                fields.push(Field::text("supported", supported(0, &after[after.len() - 4..])));
                return;
            }
            let Some((&count, items)) = after.split_first() else { return };
            let text = matches!(pid, 0x02 | 0x04 | 0x0A | 0x0D | 0x0F | 0x11);
            let name = match pid {
                2 => "vin",
                0x0A => "ecu_name",
                _ => "value",
            };
            // If there are several, all have the same length.
            let each = match pid {
                0x04 => 16,
                0x06 => 4,
                0x08 | 0x0B => 2,
                _ => items.len(),
            };
            if matches!(pid, 0x04 | 0x06 | 0x08 | 0x0B)
                && count > 0
                && items.len() == each * usize::from(count)
            {
                for item in items.chunks_exact(each) {
                    fields.push(match pid {
                        0x04 => Field::text("calibration", letters(item)),
                        0x06 => Field::hex("verification_number", number(item), 8),
                        _ => Field::number("count", number(item) as i64),
                    });
                }
                return;
            }
            // A VIN has 17 characters, and may be filled up with zeros in front.
            let filled = items.iter().take_while(|byte| **byte == 0).count();
            if pid == 0x02 && count > 0 && items.len() - filled > 17 {
                let (vin, after) = items[filled..].split_at(17);
                fields.push(Field::text(name, letters(vin)));
                fields.push(Field::bytes("rest", after));
            } else if text && count > 0 {
                fields.push(Field::text(name, letters(items)));
            } else {
                fields.push(Field::number("items", count));
                fields.push(Field::bytes("value", items));
            }
        }
        4 => {}
        _ => fields.push(Field::bytes("value", rest)),
    }
}

/// The printable characters in the bytes.
pub fn letters(bytes: &[u8]) -> String {
    let shown = bytes.iter().filter(|byte| byte.is_ascii_graphic() || **byte == b' ');
    let shown: String = shown.map(|byte| char::from(*byte)).collect();
    shown.trim().to_owned()
}

/// The service's name for display: `current data`.
pub fn title(sid: u8) -> &'static str {
    names::obd_service(sid).unwrap_or("unknown service")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(sid: u8, bytes: &[u8]) -> String {
        let mut fields = Vec::new();
        response(sid, bytes, &mut fields);
        fields.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
    }

    #[test]
    fn parameters_have_their_values_and_units() {
        for (bytes, expected) in [
            (&[0x0C, 0x1A, 0xF8][..], "pid 0x0C (engine_speed), engine_speed 1726 rpm"),
            (&[0x05, 0x7B], "pid 0x05 (coolant_temperature), coolant_temperature 83 °C"),
            (&[0x0D, 0x32], "pid 0x0D (vehicle_speed), vehicle_speed 50 km/h"),
            (&[0x11, 0xFF], "pid 0x11 (throttle_position), throttle_position 100 %"),
            (&[0x06, 0x80], "pid 0x06 (short_term_fuel_trim_bank_1), short_term_fuel_trim_bank_1 0 %"),
            (
                &[0x32, 0xFF, 0xFC],
                "pid 0x32 (evaporative_system_pressure), evaporative_system_pressure -1 Pa",
            ),
            (&[0x00, 0x80, 0, 0, 1], "pid 0x00 (supported), supported \"01 20\""),
            (
                &[0x01, 0x82, 1, 2, 3],
                "pid 0x01 (monitor_status), mil \"on\", trouble_codes 2, monitors 01 02 03, not_complete \"heated catalyst\"",
            ),
            (
                &[0x41, 0, 1, 2, 3],
                "pid 0x41 (monitor_status_this_cycle), monitors 01 02 03, not_complete \"heated catalyst\"",
            ),
            (
                &[0x66, 1, 1, 0, 2, 0],
                "pid 0x66 (air_flow_sensors), air_flow_a 8 g/s, air_flow_b not available",
            ),
            (
                &[0xA4, 2, 0, 0x13, 0x88, 0x9E, 0, 5],
                "pid 0xA4 (transmission_gear), gear_ratio 5, pid 0x9E (exhaust_flow_rate), exhaust_flow_rate 1 kg/h",
            ),
            (
                &[0x9D, 1, 0, 2, 0],
                "pid 0x9D (fuel_rates), engine_fuel_rate 5.12 g/s, vehicle_fuel_rate 10.24 g/s",
            ),
            (&[0x83, 1, 2, 3], "pid 0x83 (nox_sensors), value 01 02 03"),
            (
                &[0x03, 2, 0],
                "pid 0x03 (fuel_system_status), fuel_system_1 0x02 (closed loop), fuel_system_2 0x00 (off or not there)",
            ),
            (&[0x10, 0x01, 0xF4], "pid 0x10 (air_flow), air_flow 5 g/s"),
            (
                &[0x12, 4],
                "pid 0x12 (secondary_air_status), secondary_air_status 4 (to the atmosphere or off)",
            ),
            (&[0x1C, 33], "pid 0x1C (obd_standard), obd_standard 33 (HD EOBD-VI: heavy duty, Euro VI)"),
            (&[0x1C, 22], "pid 0x1C (obd_standard), obd_standard 22"),
            (&[0x51, 32], "pid 0x51 (fuel_type), fuel_type 32 (heavy fuel oil)"),
            (&[0x5F, 0x11], "pid 0x5F (emission_requirements), emission_requirements 17 (Euro VI)"),
            (
                &[0x58, 0x80, 0],
                "pid 0x58 (long_term_secondary_trim_bank_2), long_term_secondary_trim_bank_2 0 %, \
                 long_term_secondary_trim_bank_4 -100 %",
            ),
            (
                &[0x98, 1, 1, 0xF4, 0, 0, 0, 0, 0, 0],
                "pid 0x98 (exhaust_gas_temperatures_5_to_8_bank_1), exhaust_gas_temperature_5 10 °C, \
                 exhaust_gas_temperature_6 not available, exhaust_gas_temperature_7 not available, \
                 exhaust_gas_temperature_8 not available",
            ),
            (&[0xA9, 1, 0, 0, 0], "pid 0xA9 (abs_disable_switch), value 01 00 00 00"),
            (&[0xF0, 1], "pid 0xF0, value 01"),
            (&[0x0C, 1], "pid 0x0C (engine_speed), value 01"),
        ] {
            assert_eq!(shown(1, bytes), expected);
        }
        assert_eq!(
            shown(1, &[0x0D, 0x10, 0x05, 0x28]),
            "pid 0x0D (vehicle_speed), vehicle_speed 16 km/h, pid 0x05 (coolant_temperature), coolant_temperature 0 °C"
        );
        assert_eq!(shown(3, &[2, 1, 0x33, 0x41, 0x55]), "trouble_codes 2, codes \"P0133, C0155\"");
        assert_eq!(
            shown(9, b"\x04\x02JMB*36761500\0\0\0\0JMB*36761501\0\0\0\0"),
            "pid 0x04 (calibration identifications), calibration \"JMB*36761500\", calibration \"JMB*36761501\""
        );
        assert_eq!(
            shown(9, &[6, 1, 0x17, 0x91, 0xBC, 0x82]),
            "pid 0x06 (calibration verification numbers), verification_number 0x1791BC82"
        );
        assert_eq!(
            shown(9, &[8, 2, 0, 5, 1, 0]),
            "pid 0x08 (in-use performance, spark ignition), count 5, count 256"
        );
        assert_eq!(shown(8, &[0, 0xC0, 0, 0, 0]), "tid 0x00 (supported), supported \"01 02\"");
        for vin in [&b"\x02\x01WVWZZZ1KZAW000001"[..], b"\x02\x01\0\0\0WVWZZZ1KZAW000001"] {
            assert_eq!(shown(9, vin), "pid 0x02 (VIN), vin \"WVWZZZ1KZAW000001\"");
        }
        // With another item behind it, which J1979 does not allow, but scapy's tests have.
        assert_eq!(
            shown(9, b"\x02\x01ABCDEFGHIJKLMNOPQ\x04\x01AB"),
            "pid 0x02 (VIN), vin \"ABCDEFGHIJKLMNOPQ\", rest 04 01 41 42"
        );
    }
}
