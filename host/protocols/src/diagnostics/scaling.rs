//! ReadScalingDataByIdentifier: how the data of an identifier are to be read. The fields are those
//! of the Python package py-uds, with which a test compares them.

use super::cursor::Cursor;
use super::names::FILE;
use crate::Field;
use crate::table::Table;

/// The content of a positive response after the identifier: bytes of type and length, some with an extension.
pub fn response(cursor: &mut Cursor<'_, '_>) -> Option<()> {
    while cursor.left() > 0 {
        let byte = cursor.take(1)?[0];
        let (kind, length) = (byte >> 4, byte & 15);
        let Some(name) = KINDS.get(kind) else {
            cursor.push(Field::hex("scaling", byte, 2));
            return None;
        };
        // Units and formulas say how to read the data described before them, and are no data.
        let words = if kind < FORMULA { format!("{name}, {length} bytes") } else { name.to_owned() };
        cursor.push(Field::hex("scaling", byte, 2).meaning(Some(words)));
        match kind {
            BITS_WITHOUT_MASK => cursor.hex("mask", usize::from(length)).map(drop)?,
            FORMULA => {
                let formula = cursor.byte("formula", |formula| FORMULAS.get(formula))?;
                let constants = FORMULAS.get(formula)?.matches('C').count();
                for _ in 0..constants {
                    let constant = cursor.take(2)?;
                    // Four bits are the exponent, twelve the mantissa, both signed.
                    let raw = i16::from_be_bytes([constant[0], constant[1]]);
                    let (exponent, mantissa) = (raw >> 12, raw << 4 >> 4);
                    let value = f64::from(mantissa) * 10_f64.powi(exponent.into());
                    cursor.push(Field::real("constant", value, ""));
                }
            }
            UNIT => cursor.byte("unit", |unit| UNITS.get(unit)).map(drop)?,
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

static KINDS: Table = Table::new(FILE, "scaling_type");
static FORMULAS: Table = Table::new(FILE, "formula");
static UNITS: Table = Table::new(FILE, "unit");

#[cfg(test)]
pub static TABLES: [&Table; 3] = [&KINDS, &FORMULAS, &UNITS];
