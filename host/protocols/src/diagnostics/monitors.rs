//! OBD-II's monitors: which are complete (parameters 01 and 41), and their test results (service 06).

use super::values::supported;
use crate::Field;

/// How to interpret a test's values: `raw * scale + offset` (SAE J1979-DA, unit and scaling identifiers).
struct Scaling {
    id: u8,
    unit: &'static str,
    scale: f64,
    offset: f64,
}

const fn scaling(id: u8, unit: &'static str, scale: f64) -> Scaling {
    Scaling { id, unit, scale, offset: 0.0 }
}

/// From 80 on, values are signed.
const SCALINGS: [Scaling; 100] = [
    scaling(0x01, "", 1.0),
    scaling(0x02, "", 0.1),
    scaling(0x03, "", 0.01),
    scaling(0x04, "", 0.001),
    scaling(0x05, "", 0.000_030_5),
    scaling(0x06, "", 0.000_305),
    scaling(0x07, "rpm", 0.25),
    scaling(0x08, "km/h", 0.01),
    scaling(0x09, "km/h", 1.0),
    scaling(0x0A, "mV", 0.122),
    scaling(0x0B, "V", 0.001),
    scaling(0x0C, "V", 0.01),
    scaling(0x0D, "mA", 0.003_906_25),
    scaling(0x0E, "A", 0.001),
    scaling(0x0F, "A", 0.01),
    scaling(0x10, "ms", 1.0),
    scaling(0x11, "ms", 100.0),
    scaling(0x12, "s", 1.0),
    scaling(0x13, "mOhm", 1.0),
    scaling(0x14, "Ohm", 1.0),
    scaling(0x15, "kOhm", 1.0),
    Scaling { id: 0x16, unit: "°C", scale: 0.1, offset: -40.0 },
    scaling(0x17, "kPa", 0.01),
    scaling(0x18, "kPa", 0.0117),
    scaling(0x19, "kPa", 0.079),
    scaling(0x1A, "kPa", 1.0),
    scaling(0x1B, "kPa", 10.0),
    scaling(0x1C, "°", 0.01),
    scaling(0x1D, "°", 0.5),
    scaling(0x1E, "", 0.000_030_5),
    scaling(0x1F, "", 0.05),
    scaling(0x20, "", 0.003_906_25),
    scaling(0x21, "mHz", 1.0),
    scaling(0x22, "Hz", 1.0),
    scaling(0x23, "kHz", 1.0),
    scaling(0x24, "", 1.0),
    scaling(0x25, "km", 1.0),
    scaling(0x26, "mV/ms", 0.1),
    scaling(0x27, "g/s", 0.01),
    scaling(0x28, "g/s", 1.0),
    scaling(0x29, "Pa/s", 0.25),
    scaling(0x2A, "kg/h", 0.001),
    scaling(0x2B, "", 1.0),
    scaling(0x2C, "g", 0.01),
    scaling(0x2D, "mg", 0.01),
    scaling(0x2E, "", 1.0),
    scaling(0x2F, "%", 0.01),
    scaling(0x30, "%", 0.001_526),
    scaling(0x31, "L", 0.001),
    scaling(0x32, "inch", 0.000_030_5),
    scaling(0x33, "", 0.000_244_14),
    scaling(0x34, "min", 1.0),
    scaling(0x35, "ms", 10.0),
    scaling(0x36, "g", 0.01),
    scaling(0x37, "g", 0.1),
    scaling(0x38, "g", 1.0),
    Scaling { id: 0x39, unit: "%", scale: 0.01, offset: -327.68 },
    scaling(0x3A, "g", 0.001),
    scaling(0x3B, "g", 0.0001),
    scaling(0x3C, "µs", 0.1),
    scaling(0x3D, "mA", 0.01),
    scaling(0x3E, "mm²", 0.000_061_035_16),
    scaling(0x3F, "L", 0.01),
    scaling(0x40, "ppm", 1.0),
    scaling(0x41, "µA", 0.01),
    scaling(0x42, "kJ", 0.1),
    scaling(0x43, "g/kWh", 0.000_244_14),
    scaling(0x81, "", 1.0),
    scaling(0x82, "", 0.1),
    scaling(0x83, "", 0.01),
    scaling(0x84, "", 0.001),
    scaling(0x85, "", 0.000_030_5),
    scaling(0x86, "", 0.000_305),
    scaling(0x87, "ppm", 1.0),
    scaling(0x8A, "mV", 0.122),
    scaling(0x8B, "V", 0.001),
    scaling(0x8C, "V", 0.01),
    scaling(0x8D, "mA", 0.003_906_25),
    scaling(0x8E, "A", 0.001),
    scaling(0x8F, "µs", 1.0),
    scaling(0x90, "ms", 1.0),
    scaling(0x91, "ms", 100.0),
    scaling(0x92, "Nm", 0.1),
    scaling(0x96, "°C", 0.1),
    scaling(0x97, "°C", 0.01),
    scaling(0x98, "mg", 1.0),
    scaling(0x99, "kPa", 0.1),
    scaling(0x9C, "°", 0.01),
    scaling(0x9D, "°", 0.5),
    scaling(0xA8, "g/s", 1.0),
    scaling(0xA9, "Pa/s", 0.25),
    scaling(0xAD, "mg", 0.01),
    scaling(0xAE, "mg", 0.1),
    scaling(0xAF, "%", 0.01),
    scaling(0xB0, "%", 0.003_052),
    scaling(0xB1, "mV/s", 2.0),
    scaling(0xFB, "kPa", 10.0),
    scaling(0xFC, "kPa", 0.01),
    scaling(0xFD, "kPa", 0.001),
    scaling(0xFE, "Pa", 0.25),
];

/// A monitor's name, with its bank and sensor: as in BMW's OBD description for EDIABAS (its table OBDMID_NAME),
/// python-OBD and scapy.
///
/// For B0 and B1 these differ: SAE J1979 gave them to PM filters first, and later to misfires of two more cylinders.
pub fn name(mid: u8) -> Option<String> {
    let bank = |what: &str, first: u8| format!("{what}, bank {}", mid - first + 1);
    let sensor = |what: &str, first: u8| {
        format!("{what}, bank {}, sensor {}", (mid - first) / 4 + 1, (mid - first) % 4 + 1)
    };
    Some(match mid {
        _ if mid.is_multiple_of(0x20) => "supported".to_owned(),
        0x01..=0x10 => sensor("exhaust gas sensor", 0x01),
        0x11 | 0x12 => bank("exhaust gas sensor 5", 0x11),
        0x21..=0x24 => bank("catalyst", 0x21),
        0x31..=0x34 => bank("EGR", 0x31),
        0x35..=0x38 => bank("variable valve timing", 0x35),
        0x39 => "evaporative system, cap off or leak of 0.150 inches".to_owned(),
        0x3A => "evaporative system, leak of 0.090 inches".to_owned(),
        0x3B => "evaporative system, leak of 0.040 inches".to_owned(),
        0x3C => "evaporative system, leak of 0.020 inches".to_owned(),
        0x3D => "purge flow".to_owned(),
        0x41..=0x50 => sensor("exhaust gas sensor heater", 0x41),
        0x51 | 0x52 => bank("exhaust gas sensor heater 5", 0x51),
        0x61..=0x64 => bank("heated catalyst", 0x61),
        0x71..=0x74 => format!("secondary air {}", mid - 0x70),
        0x81..=0x84 => bank("fuel system", 0x81),
        0x85 | 0x86 => bank("boost pressure", 0x85),
        0x90 | 0x91 => bank("NOx adsorber", 0x90),
        0x98 | 0x99 => bank("NOx or SCR catalyst", 0x98),
        0xA1 => "misfire".to_owned(),
        0xA2..=0xAF => format!("misfire, cylinder {}", mid - 0xA1),
        0xB0 | 0xB1 => format!("misfire, cylinder {}, or {}", mid - 0xA1, bank("PM filter", 0xB0)),
        0xB2 | 0xB3 => bank("PM filter", 0xB2),
        0xE1..=0xFF => "defined by the manufacturer".to_owned(),
        _ => return None,
    })
}

/// The content of a response of service 06: supported monitors, or test results of nine bytes each.
pub fn results(bytes: &[u8], fields: &mut Vec<Field>) {
    let Some(&mid) = bytes.first() else { return };
    if mid.is_multiple_of(0x20) && bytes.len().is_multiple_of(5) {
        for part in bytes.chunks_exact(5) {
            fields.push(Field::hex("mid", part[0], 2).meaning(name(part[0])));
            fields.push(Field::text("supported", supported(part[0], &part[1..])));
        }
        return;
    }
    if !bytes.len().is_multiple_of(9) {
        fields.push(Field::hex("mid", mid, 2).meaning(name(mid)));
        fields.push(Field::bytes("value", &bytes[1..]));
        return;
    }
    for test in bytes.chunks_exact(9) {
        let word = |at: usize| u16::from_be_bytes([test[at], test[at + 1]]);
        fields.push(Field::hex("mid", test[0], 2).meaning(name(test[0])));
        fields.push(Field::hex("tid", test[1], 2));
        fields.push(Field::hex("scaling", test[2], 2));
        let known = SCALINGS.iter().find(|known| known.id == test[2]);
        let is_signed = test[2] >= 0x80;
        let number = |raw: u16| if is_signed { i64::from(raw as i16) } else { i64::from(raw) };
        let (value, least, most) = (number(word(3)), number(word(5)), number(word(7)));
        for (field, raw) in [("value", value), ("minimum", least), ("maximum", most)] {
            fields.push(known.map_or_else(
                || Field::number(field, raw),
                |known| Field::real(field, raw as f64 * known.scale + known.offset, known.unit),
            ));
        }
        let passed = (least..=most).contains(&value);
        fields.push(Field::text("result", if passed { "passed" } else { "failed" }));
    }
}

/// The supported monitors that are not complete, from the four bytes of parameters 01 and 41.
pub fn not_complete(bytes: &[u8]) -> String {
    const CONTINUOUS: [&str; 3] = ["misfire", "fuel system", "components"];
    const SPARK: [&str; 8] = [
        "catalyst",
        "heated catalyst",
        "evaporative system",
        "secondary air",
        // The first until it was removed from SAE J1979, the second since.
        "A/C refrigerant or gasoline particulate filter",
        "oxygen sensor",
        "oxygen sensor heater",
        "EGR or VVT",
    ];
    const COMPRESSION: [&str; 8] = [
        "NMHC catalyst",
        "NOx aftertreatment",
        "reserved",
        "boost pressure",
        "reserved",
        "exhaust gas sensor",
        "PM filter",
        "EGR or VVT",
    ];
    let &[_, first, there, open] = bytes else { return String::new() };
    let others = if first & 8 == 0 { SPARK } else { COMPRESSION };
    let continuous =
        CONTINUOUS.iter().enumerate().filter(|(bit, _)| first >> bit & first >> (bit + 4) & 1 == 1);
    let others = others.iter().enumerate().filter(|(bit, _)| there >> bit & open >> bit & 1 == 1);
    continuous.map(|(_, name)| *name).chain(others.map(|(_, name)| *name)).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(bytes: &[u8]) -> String {
        let mut fields = Vec::new();
        results(bytes, &mut fields);
        fields.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
    }

    #[test]
    fn test_results_have_their_limits_and_whether_they_are_kept() {
        assert_eq!(
            said(&[0x01, 0x80, 0x0A, 0x0B, 0xB0, 0x0B, 0xB0, 0x0B, 0xB0]),
            "mid 0x01 (exhaust gas sensor, bank 1, sensor 1), tid 0x80, scaling 0x0A, value 365.024 mV, minimum 365.024 mV, maximum 365.024 mV, \
             result \"passed\""
        );
        assert_eq!(
            said(&[0x21, 0x01, 0x96, 0xFF, 0xF6, 0, 0, 0, 10]),
            "mid 0x21 (catalyst, bank 1), tid 0x01, scaling 0x96, value -1 °C, minimum 0 °C, maximum 1 °C, result \"failed\""
        );
        assert_eq!(said(&[0x00, 0xC0, 0, 0, 1]), "mid 0x00 (supported), supported \"01 02 20\"");
        assert_eq!(said(&[0xA1, 1, 2]), "mid 0xA1 (misfire), value 01 02");
    }

    #[test]
    fn monitors_are_named_with_their_bank_and_sensor() {
        for (mid, expected) in [
            (0x02, "exhaust gas sensor, bank 1, sensor 2"),
            (0x10, "exhaust gas sensor, bank 4, sensor 4"),
            (0x12, "exhaust gas sensor 5, bank 2"),
            (0x34, "EGR, bank 4"),
            (0x3D, "purge flow"),
            (0x46, "exhaust gas sensor heater, bank 2, sensor 2"),
            (0x74, "secondary air 4"),
            (0x86, "boost pressure, bank 2"),
            (0xA2, "misfire, cylinder 1"),
            (0xAD, "misfire, cylinder 12"),
            (0xB1, "misfire, cylinder 16, or PM filter, bank 2"),
            (0xB3, "PM filter, bank 2"),
            (0xE0, "supported"),
        ] {
            assert_eq!(name(mid).as_deref(), Some(expected), "{mid:02X}");
        }
        assert_eq!([0x13, 0x30, 0x3E, 0x87, 0xB4, 0xDF].map(name), [const { None::<String> }; 6]);
    }

    #[test]
    fn monitors_that_are_there_and_not_complete_are_named() {
        assert_eq!(
            not_complete(&[0, 0x07, 0xE5, 0xE5]),
            "catalyst, evaporative system, oxygen sensor, oxygen sensor heater, EGR or VVT"
        );
        assert_eq!(not_complete(&[0, 0x11, 0, 0xFF]), "misfire");
        assert_eq!(not_complete(&[0, 0x08, 0x40, 0x40]), "PM filter");
        assert_eq!(not_complete(&[0, 0x00, 0x10, 0x10]), "A/C refrigerant or gasoline particulate filter");
        assert_eq!(not_complete(&[0, 0x07, 0xFF, 0]), "");
    }

    #[test]
    fn each_scaling_is_there_once() {
        let mut ids: Vec<_> = SCALINGS.iter().map(|scaling| scaling.id).collect();
        ids.sort_unstable();
        ids.dedup();
        assert_eq!(ids.len(), SCALINGS.len());
    }
}
