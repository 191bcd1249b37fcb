//! OBD-II's monitors: which are complete (parameters 01 and 41), and their test results (service 06).

use std::sync::LazyLock;

use super::names::FILE;
use super::values::supported;
use crate::Field;
use crate::table::{Table, lines};

/// How to interpret a test's values: `raw * scale + offset`.
#[derive(Debug)]
struct Scaling {
    id: u8,
    unit: &'static str,
    scale: f64,
    offset: f64,
}

const SCALING_FILE: &str = include_str!("../../data/obd-scalings.csv");

/// By identifier.
static SCALINGS: LazyLock<Vec<Scaling>> = LazyLock::new(|| {
    let mut scalings: Vec<_> = lines(SCALING_FILE).filter_map(Scaling::read).collect();
    scalings.sort_by_key(|scaling| scaling.id);
    scalings
});

impl Scaling {
    fn read(line: &'static str) -> Option<Self> {
        let mut columns = line.split(',');
        let (id, unit, scale, offset) = (columns.next()?, columns.next()?, columns.next()?, columns.next()?);
        let id = u8::from_str_radix(id, 16).ok()?;
        let (scale, offset) = (scale.parse().ok()?, offset.parse().ok()?);
        columns.next().is_none().then_some(Self { id, unit, scale, offset })
    }

    fn find(id: u8) -> Option<&'static Self> {
        SCALINGS.binary_search_by_key(&id, |scaling| scaling.id).ok().map(|place| &SCALINGS[place])
    }
}

static MONITORS: Table = Table::new(FILE, "obd_monitor");
static CONTINUOUS: Table = Table::new(FILE, "monitor_continuous");
static SPARK: Table = Table::new(FILE, "monitor_spark");
static COMPRESSION: Table = Table::new(FILE, "monitor_compression");

#[cfg(test)]
pub static TABLES: [&Table; 4] = [&MONITORS, &CONTINUOUS, &SPARK, &COMPRESSION];

/// A monitor's name, with its bank and sensor.
pub fn name(mid: u8) -> Option<&'static str> {
    MONITORS.get(mid)
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
        let known = Scaling::find(test[2]);
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
    let &[_, first, there, open] = bytes else { return String::new() };
    let others = if first & 8 == 0 { &SPARK } else { &COMPRESSION };
    let continuous = CONTINUOUS.bits(first & first >> 4 & 7);
    continuous.chain(others.bits(there & open)).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(bytes: &[u8]) -> String {
        let mut fields = Vec::new();
        results(bytes, &mut fields);
        fields.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
    }

    #[test]
    fn test_results_have_their_limits_and_whether_they_are_kept() {
        assert_eq!(
            shown(&[0x01, 0x80, 0x0A, 0x0B, 0xB0, 0x0B, 0xB0, 0x0B, 0xB0]),
            "mid 0x01 (exhaust gas sensor, bank 1, sensor 1), tid 0x80, scaling 0x0A, value 365.024 mV, minimum 365.024 mV, maximum 365.024 mV, \
             result \"passed\""
        );
        assert_eq!(
            shown(&[0x21, 0x01, 0x96, 0xFF, 0xF6, 0, 0, 0, 10]),
            "mid 0x21 (catalyst, bank 1), tid 0x01, scaling 0x96, value -1 °C, minimum 0 °C, maximum 1 °C, result \"failed\""
        );
        assert_eq!(shown(&[0x00, 0xC0, 0, 0, 1]), "mid 0x00 (supported), supported \"01 02 20\"");
        assert_eq!(shown(&[0xA1, 1, 2]), "mid 0xA1 (misfire), value 01 02");
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
            assert_eq!(name(mid), Some(expected), "{mid:02X}");
        }
        assert_eq!([0x13, 0x30, 0x3E, 0x87, 0xB4, 0xDF].map(name), [None; 6]);
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
    fn every_line_of_the_scalings_is_read_and_none_stands_twice() {
        let mut ids: Vec<_> = SCALINGS.iter().map(|scaling| scaling.id).collect();
        ids.dedup();
        assert_eq!((ids.len(), SCALINGS.len()), (100, lines(SCALING_FILE).count()));
        assert!(SCALINGS.iter().all(|scaling| scaling.scale > 0.0));
    }
}
