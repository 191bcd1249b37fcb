//! ReadScalingDataByIdentifier: how the data of an identifier are to be read. The fields are those
//! of the Python package py-uds, with which a test compares them.

use super::cursor::Cursor;
use crate::Field;

/// The content of a positive response after the identifier: bytes of type and length, some with an extension.
pub fn response(cursor: &mut Cursor<'_, '_>) -> Option<()> {
    while cursor.left() > 0 {
        let byte = cursor.take(1)?[0];
        let (kind, length) = (byte >> 4, byte & 15);
        let Some(name) = KINDS.get(usize::from(kind)) else {
            cursor.push(Field::hex("scaling", byte, 2));
            return None;
        };
        // Units and formulas say how to read the data described before them, and are no data.
        let words = if kind < FORMULA { format!("{name}, {length} bytes") } else { (*name).to_owned() };
        cursor.push(Field::hex("scaling", byte, 2).meaning(Some(words)));
        match kind {
            BITS_WITHOUT_MASK => cursor.hex("mask", usize::from(length)).map(drop)?,
            FORMULA => {
                let formula =
                    cursor.byte("formula", |formula| FORMULAS.get(usize::from(formula)).copied())?;
                let constants = FORMULAS.get(usize::from(formula))?.matches('C').count();
                for _ in 0..constants {
                    let constant = cursor.take(2)?;
                    // Four bits are the exponent, twelve the mantissa, both signed.
                    let raw = i16::from_be_bytes([constant[0], constant[1]]);
                    let (exponent, mantissa) = (raw >> 12, raw << 4 >> 4);
                    let value = f64::from(mantissa) * 10_f64.powi(exponent.into());
                    cursor.push(Field::real("constant", value, ""));
                }
            }
            UNIT => cursor.byte("unit", unit).map(drop)?,
            STATE => cursor.hex("state_and_connection", 1).map(drop)?,
            _ => {}
        }
    }
    Some(())
}

const BITS_WITHOUT_MASK: u8 = 2;
const FORMULA: u8 = 9;
const UNIT: u8 = 10;
const STATE: u8 = 11;

/// By the high four bits.
const KINDS: [&str; 12] = [
    "unsigned",
    "signed",
    "bits without mask",
    "bits with mask",
    "binary coded decimal",
    "states",
    "ASCII",
    "floating point",
    "packet",
    "formula",
    "unit or format",
    "state and connection",
];

/// By the formula's number.
const FORMULAS: [&str; 10] = [
    "C0 x + C1",
    "C0 (x + C1)",
    "C0 / (x + C1) + C2",
    "x / C0 + C1",
    "(x + C0) / C1",
    "(x + C0) / C1 + C2",
    "C0 x",
    "x / C0",
    "x + C0",
    "x C0 / C1",
];

/// Units and prefixes.
fn unit(byte: u8) -> Option<&'static str> {
    const UNITS: [&str; 63] = [
        "none",
        "m",
        "ft",
        "in",
        "yd",
        "mi",
        "g",
        "t",
        "s",
        "min",
        "h",
        "d",
        "year",
        "A",
        "V",
        "C",
        "Ω",
        "F",
        "H",
        "S",
        "Wb",
        "T",
        "K",
        "°C",
        "°F",
        "cd",
        "rad",
        "°",
        "Hz",
        "J",
        "N",
        "kp",
        "lbf",
        "W",
        "hp (metric)",
        "hp",
        "Pa",
        "bar",
        "atm",
        "psi",
        "Bq",
        "lm",
        "lx",
        "l",
        "gal (British)",
        "gal (US)",
        "in³",
        "m/s",
        "km/h",
        "mph",
        "rps",
        "rpm",
        "counts",
        "%",
        "mg/stroke",
        "m/s²",
        "Nm",
        "l/min",
        "W/m²",
        "bar/s",
        "rad/s",
        "rad/s²",
        "kg/m²",
    ];
    const PREFIXES: [&str; 16] = [
        "exa", "peta", "tera", "giga", "mega", "kilo", "hecto", "deca", "deci", "centi", "milli", "micro",
        "nano", "pico", "femto", "atto",
    ];
    UNITS.get(usize::from(byte)).or_else(|| PREFIXES.get(usize::from(byte).checked_sub(0x40)?)).copied()
}
