//! OBD-II's parameters (PIDs): their names, and their values with units. The table, with its sources, is `data/obd-parameters.csv`.

use std::sync::LazyLock;

use super::values::{number, supported};
use super::{dtc, meanings, monitors};
use crate::Field;
use crate::table::{Scale, lines, range};

const FILE: &str = include_str!("../../data/obd-parameters.csv");
const TRIM: f64 = 100.0 / 128.0;

/// One parameter.
#[derive(Debug)]
struct Parameter {
    name: &'static str,
    /// Of the whole parameter; `None` if it extends to the end of its response.
    bytes: Option<u8>,
    /// The values that a formula gives; the others are read by [`values`].
    values: Vec<Quantity>,
}

/// A value with a linear formula.
#[derive(Debug)]
struct Quantity {
    /// The bit of the first byte that says whether it is there; `None` if it always is.
    present: Option<u8>,
    at: usize,
    length: usize,
    name: &'static str,
    unit: &'static str,
    scale: Scale,
    offset: f64,
    is_signed: bool,
}

/// One line of the table: the range of parameters, what they are, and one of their values.
struct Line {
    first: u32,
    last: u32,
    name: &'static str,
    bytes: Option<u8>,
    value: Option<Quantity>,
}

/// By number.
static PARAMETERS: LazyLock<Vec<Option<Parameter>>> = LazyLock::new(|| {
    let mut parameters: Vec<Option<Parameter>> = (0..256).map(|_| None).collect();
    for pid in 0..=u8::MAX {
        // What cannot be read is left out, of which the table has nothing: a test reads every line.
        let own = lines(FILE).filter_map(Line::read).filter(|line| line.has(pid));
        for Line { name, bytes, value, .. } in own {
            let parameter =
                parameters[usize::from(pid)].get_or_insert(Parameter { name, bytes, values: Vec::new() });
            parameter.values.extend(value);
        }
    }
    parameters
});

impl Line {
    fn read(line: &'static str) -> Option<Self> {
        let columns: Vec<&'static str> = line.split(',').collect();
        let &[pid, bytes, parameter, present, at, length, name, unit, scale, offset, kind] = &columns[..]
        else {
            return None;
        };
        let (first, last) = range(pid)?;
        let bytes = if bytes.is_empty() { None } else { Some(bytes.parse().ok()?) };
        let value = if at.is_empty() {
            None
        } else {
            Some(Quantity {
                present: if present.is_empty() { None } else { Some(present.parse().ok()?) },
                at: at.parse().ok()?,
                length: length.parse().ok()?,
                name,
                unit,
                scale: Scale::read(scale)?,
                offset: offset.parse().ok()?,
                is_signed: match kind {
                    "signed" => true,
                    "unsigned" => false,
                    _ => return None,
                },
            })
        };
        Some(Self { first, last, name: parameter, bytes, value })
    }

    fn has(&self, pid: u8) -> bool {
        (self.first..=self.last).contains(&pid.into())
    }
}

impl Quantity {
    fn field(&self, pid: u8, bytes: &[u8]) -> Field {
        if self.present.is_some_and(|bit| bytes[0] >> bit & 1 == 0) {
            return Field::missing(self.name);
        }
        let raw = number(&bytes[self.at..self.at + self.length]);
        let value = if self.is_signed { f64::from(raw as u16 as i16) } else { raw as f64 };
        Field::real(self.name, self.scale.of(value) + self.offset, self.unit).meaning(meanings::of(pid, raw))
    }
}

fn find(pid: u8) -> Option<&'static Parameter> {
    PARAMETERS[usize::from(pid)].as_ref()
}

/// Number of data bytes of a parameter of service 01; `None` if it is unknown.
pub fn length(pid: u8) -> Option<usize> {
    if pid.is_multiple_of(0x20) { Some(4) } else { find(pid)?.bytes.map(usize::from) }
}

/// A parameter's name.
pub fn name(pid: u8) -> Option<&'static str> {
    if pid.is_multiple_of(0x20) { Some("supported") } else { Some(find(pid)?.name) }
}

/// The parameter's values, of as many bytes as [`length`] says.
pub fn values(pid: u8, bytes: &[u8], fields: &mut Vec<Field>) {
    if let Some(parameter) = find(pid).filter(|parameter| !parameter.values.is_empty()) {
        fields.extend(parameter.values.iter().map(|value| value.field(pid, bytes)));
        return;
    }
    let byte = |at: usize| f64::from(bytes[at]);
    match pid {
        _ if pid.is_multiple_of(0x20) => fields.push(Field::text("supported", supported(pid, bytes))),
        0x01 | 0x41 => {
            // Of this driving cycle, the first byte is reserved: zero there does not mean that there are no codes.
            if pid == 0x01 {
                fields.push(Field::text("mil", if bytes[0] & 0x80 == 0 { "off" } else { "on" }));
                fields.push(Field::number("trouble_codes", bytes[0] & 0x7F));
            }
            fields.push(Field::bytes("monitors", &bytes[1..]));
            let open = monitors::not_complete(bytes);
            fields.push(Field::text("not_complete", if open.is_empty() { "none".to_owned() } else { open }));
        }
        0x02 => fields.push(Field::text("freeze_frame_code", dtc::list(bytes))),
        0x03 => {
            for (name, byte) in ["fuel_system_1", "fuel_system_2"].into_iter().zip(bytes) {
                fields.push(Field::hex(name, *byte, 2).meaning(meanings::of(pid, (*byte).into())));
            }
        }
        0x14..=0x1B => {
            fields.push(Field::real("oxygen_sensor_voltage", byte(0) / 200.0, "V"));
            if bytes[1] != 0xFF {
                fields.push(Field::real("short_term_fuel_trim", byte(1) * TRIM - 100.0, "%"));
            }
        }
        _ => fields.push(Field::bytes("value", bytes)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_line_of_the_table_is_read_and_each_value_is_within_its_parameter() {
        let mut parameters: Vec<(u32, u32, &str, Option<u8>)> = Vec::new();
        for line in lines(FILE) {
            let Line { first, last, name, bytes, value } =
                Line::read(line).unwrap_or_else(|| panic!("{line}"));
            assert!(first <= last && last <= 0xFF && !name.is_empty(), "{line}");
            if let Some(value) = value {
                assert!(usize::from(bytes.unwrap_or(0)) >= value.at + value.length, "{line}");
                assert!(value.length > 0 && !value.name.is_empty(), "{line}");
                assert!(!value.is_signed || value.length == 2, "{line}");
                let (Scale::Times(scale) | Scale::Over(scale)) = value.scale;
                assert!(scale > 0.0, "{line}");
            }
            // The lines of a parameter follow each other, and agree on it; no parameter overlaps another one.
            let this = (first, last, name, bytes);
            if parameters.last() != Some(&this) {
                assert!(parameters.iter().all(|other| last < other.0 || first > other.1), "{line}");
                parameters.push(this);
            }
        }
        assert!(parameters.len() > 120);
    }
}
