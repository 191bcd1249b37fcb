//! DM1 and its relatives: lamps and trouble codes (SAE J1939-73).

use std::fmt::Write as _;

use super::names::failure_mode;
use super::parameters;
use crate::Field;

/// Whether the group contains lamps and codes like DM1.
pub const fn carries(pgn: u32) -> bool {
    matches!(pgn, 0xFECA | 0xFECB | 0xFECF | 0xFED4 | 0xFDB5 | 0xFD80 | 0xFD82)
}

/// Adds lamps, then codes.
pub fn fields(data: &[u8], fields: &mut Vec<Field>) {
    let &[lamps, flashing, ref codes @ ..] = data else { return };
    for (shift, name) in
        [(6, "malfunction_lamp"), (4, "red_stop_lamp"), (2, "amber_warning_lamp"), (0, "protect_lamp")]
    {
        let state = match (lamps >> shift & 3, flashing >> shift & 3) {
            (1, 0) => "on, flashing slowly",
            (1, 1) => "on, flashing fast",
            (1, _) => "on",
            (0, _) => "off",
            _ => continue,
        };
        fields.push(Field::text(name, state));
    }
    let mut text = String::new();
    let mut each = Vec::new();
    let mut count = 0;
    for code in codes.chunks_exact(4).filter(|code| **code != [0; 4] && **code != [0xFF; 4]) {
        let spn = u32::from(code[0]) | u32::from(code[1]) << 8 | u32::from(code[2] >> 5) << 16;
        let (fmi, times) = (code[2] & 31, code[3] & 0x7F);
        let parameter = parameters::name(spn);
        let (separator, mode) = (if count == 0 { "" } else { ", " }, failure_mode(fmi));
        // Writing to a String cannot fail.
        let _ = match parameter {
            Some(parameter) => write!(text, "{separator}SPN {spn} FMI {fmi} ({parameter}: {mode})"),
            None => write!(text, "{separator}SPN {spn} FMI {fmi} ({mode})"),
        };
        if times != 0x7F {
            let _ = write!(text, " {times} times");
        }
        if code[3] & 0x80 != 0 {
            // Nothing in the message distinguishes the first two of the four number formats from the third.
            let [a, b, c] = [code[0], code[1], code[2] >> 5].map(u32::from);
            let (first, second) = (a << 11 | b << 3 | c, b << 11 | a << 3 | c);
            let _ = write!(text, " in an old conversion: SPN {first} by version 1, {second} by version 2");
        }
        each.push(Field::number("spn", spn).meaning(parameter));
        each.push(Field::number("fmi", fmi));
        // Also without a value, so that the same number of each belongs to one code.
        each.push(if times == 0x7F {
            Field::missing("occurrences")
        } else {
            Field::number("occurrences", times)
        });
        count += 1;
    }
    fields.push(Field::number("trouble_codes", count));
    if count > 0 {
        fields.push(Field::text("codes", text));
        fields.append(&mut each);
    }
}
