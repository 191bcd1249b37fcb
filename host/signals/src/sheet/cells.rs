//! What a cell of a table of signals says.

use std::ops::RangeInclusive;

use super::super::layout::ByteOrder;
use super::super::model::ValueKind;
use super::super::xml::MOST_TEXTS;

/// An identifier as written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Id {
    pub raw: u32,
    /// What the cell says of its length.
    pub extended: Option<bool>,
    /// Whether it says itself whether it is hexadecimal.
    pub is_marked: bool,
}

/// `0x123`, `123h`, canmatrix's `18FEF1FExh`, or digits; a workbook may write a whole number with a fraction.
pub(super) fn id(cell: &str, is_hex: bool) -> Option<Id> {
    let lower = cell.trim().to_ascii_lowercase();
    let (digits, extended) = match lower.strip_suffix("xh") {
        Some(digits) => (format!("0x{digits}"), Some(true)),
        None => (lower.strip_suffix('h').map_or(lower.clone(), |digits| format!("0x{digits}")), None),
    };
    let (digits, extended) = match (digits.strip_suffix('x'), extended) {
        (Some(digits), None) => (digits.to_owned(), Some(true)),
        (_, extended) => (digits, extended),
    };
    let (digits, is_marked) = match digits.strip_prefix("0x") {
        Some(digits) => (digits, true),
        None => (digits.strip_suffix(".0").unwrap_or(&digits), false),
    };
    let radix = if is_hex || is_marked { 16 } else { 10 };
    let raw = u32::from_str_radix(digits, radix).ok()?;
    Some(Id { raw, extended, is_marked })
}

/// Whether a format is that of 29 bits.
pub(super) fn extended(cell: &str) -> Option<bool> {
    let lower = cell.trim().to_ascii_lowercase();
    let has = |words: &[&str]| words.iter().any(|word| lower.contains(word));
    if has(&["ext", "29"]) || matches!(lower.as_str(), "1" | "true" | "yes" | "y" | "x") {
        Some(true)
    } else if has(&["std", "standard", "11"]) || matches!(lower.as_str(), "0" | "false" | "no" | "n" | "s") {
        Some(false)
    } else {
        None
    }
}

/// `0.1`, `0,1`, `1/256`, `1e-3`, `0x1F`, also with a unit or a mark behind it.
pub(super) fn number(cell: &str) -> Option<f64> {
    let cell = cell.trim().trim_start_matches('=');
    if let Some(digits) = cell.strip_prefix("0x").or_else(|| cell.strip_prefix("0X")) {
        return u64::from_str_radix(digits, 16).ok().map(|value| value as f64);
    }
    let plain =
        |text: &str| text.trim().replace(',', ".").parse::<f64>().ok().filter(|value| value.is_finite());
    if let Some(value) = plain(cell) {
        return Some(value);
    }
    let (top, bottom) = cell.split_once('/')?;
    let (top, bottom) = (plain(top)?, plain(bottom)?);
    (bottom != 0.0).then(|| top / bottom)
}

/// The order, and which bit a start bit of Motorola is if it says so: whether the lowest.
pub(super) fn order(cell: &str) -> Option<(ByteOrder, Option<bool>)> {
    let lower = cell.trim().to_ascii_lowercase();
    let is = |words: &[&str]| words.iter().any(|word| lower == *word);
    if lower.contains("intel") || lower.contains("little") || is(&["i", "1", "le", "lsb first", "lsb", "1.0"])
    {
        Some((ByteOrder::Little, None))
    } else if lower.contains("motorola")
        || lower.contains("big")
        || is(&["m", "0", "be", "msb first", "msb", "0.0"])
    {
        let lowest = match (lower.contains("lsb"), lower.contains("msb")) {
            (true, _) => Some(true),
            (_, true) if lower.contains("motorola") => Some(false),
            _ => None,
        };
        Some((ByteOrder::Big, lowest))
    } else {
        None
    }
}

/// How so many bits are to be interpreted.
pub(super) fn kind(cell: &str, bits: u16) -> Option<ValueKind> {
    let lower = cell.trim().to_ascii_lowercase();
    let has = |words: &[&str]| words.iter().any(|word| lower.contains(word));
    let is = |words: &[&str]| words.iter().any(|word| lower == *word);
    if has(&["float", "single", "double", "ieee", "real"]) {
        Some(if bits > 32 { ValueKind::Double } else { ValueKind::Single })
    } else if has(&["unsigned", "uint", "bool", "enum", "bitfield"])
        || is(&["u", "+", "0", "false", "no", "n", "0.0", "byte", "word"])
    {
        Some(ValueKind::Unsigned)
    } else if has(&["signed", "sint", "int"]) || is(&["s", "-", "1", "true", "yes", "y", "1.0"]) {
        Some(ValueKind::Signed)
    } else {
        None
    }
}

/// `0..6553.5`.
pub(super) fn range(cell: &str) -> Option<(f64, f64)> {
    let (low, high) = cell.split_once("..").or_else(|| cell.split_once('~'))?;
    Some((number(low)?, number(high)?))
}

/// canmatrix's `0.1  km/h`, `0.1 -`, `km/h`.
pub(super) fn factor_and_unit(cell: &str) -> (f64, String) {
    let (first, rest) = cell.split_once(' ').unwrap_or((cell, ""));
    match number(first) {
        Some(factor) if cell.contains(' ') => {
            let unit = rest.trim();
            (factor, if unit == "-" { String::new() } else { unit.to_owned() })
        }
        _ => (1.0, cell.trim().to_owned()),
    }
}

/// What a signal has to do with a multiplexer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Mux {
    /// It is the one.
    Switch,
    /// It is there for these values.
    For(Vec<RangeInclusive<u64>>),
}

/// `M`, `m3`, `3`, `0x1F`.
pub(super) fn mux(cell: &str) -> Option<Mux> {
    let cell = cell.trim();
    let lower = cell.to_ascii_lowercase();
    if cell == "M"
        || lower.starts_with("multiplex")
        || matches!(lower.as_str(), "mux" | "switch" | "selector")
    {
        return Some(Mux::Switch);
    }
    let value = number(lower.strip_prefix('m').unwrap_or(&lower))
        .filter(|value| *value >= 0.0 && value.fract() == 0.0)?;
    Some(Mux::For(vec![value as u64..=value as u64]))
}

/// A description, and the multiplexing that canmatrix writes before it: `Mode Signal: …`, `Mode 3:…`.
pub(super) fn mode(cell: &str) -> (String, Option<Mux>) {
    if let Some((mode, text)) = cell.strip_prefix("Mode ").and_then(|rest| rest.split_once(':')) {
        let mux = if mode == "Signal" { Some(Mux::Switch) } else { mux(mode) };
        if mux.is_some() {
            return (text.trim().to_owned(), mux);
        }
    }
    (cell.to_owned(), None)
}

/// Values with their texts, `0: Off, 1: On`, `0x0=Off;0x1=On`, one on each line; ranges (`0x2~0x5: Reserved`) too.
pub(super) fn values(cell: &str) -> Vec<(i64, String)> {
    let mut found: Vec<(i64, String)> = Vec::new();
    for line in cell.split(['\n', ';', '；']) {
        // A comma may be in a text: it ends one only if another value follows.
        let mut parts: Vec<String> = Vec::new();
        for part in line.split([',', '，']) {
            match parts.last_mut() {
                Some(last) if entry(part).is_none() => {
                    last.push(',');
                    last.push_str(part);
                }
                _ => parts.push(part.to_owned()),
            }
        }
        for (range, text) in parts.iter().filter_map(|part| entry(part)) {
            let room = MOST_TEXTS - found.len() as i64;
            found.extend(range.take(usize::try_from(room).unwrap_or(0)).map(|value| (value, text.clone())));
        }
    }
    found
}

/// `0x1: On`.
fn entry(part: &str) -> Option<(RangeInclusive<i64>, String)> {
    let part = part.trim();
    let at = part.find([':', '=', '：'])?;
    let (value, text) = part.split_at(at);
    let text = text.trim_start_matches([':', '=', '：']).trim().trim_matches('"');
    let whole = |text: &str| {
        number(text).filter(|value| value.fract() == 0.0 && value.abs() < 9e15).map(|value| value as i64)
    };
    let value = value.trim();
    let range = match value.split_once(['~', '～']).or_else(|| value.split_once("..")) {
        Some((low, high)) => whole(low)?..=whole(high)?,
        None => whole(value)?..=whole(value)?,
    };
    (!text.is_empty()).then(|| (range, text.to_owned()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_read_as_people_write_them() {
        let raw = |cell, is_hex| id(cell, is_hex).map(|id| (id.raw, id.extended, id.is_marked));
        assert_eq!(raw("0x123", false), Some((0x123, None, true)));
        assert_eq!(raw("18FEF1FExh", false), Some((0x18FE_F1FE, Some(true), true)));
        assert_eq!(raw("123h", false), Some((0x123, None, true)));
        assert_eq!(
            (raw("291.0", false), raw("123", true)),
            (Some((291, None, false)), Some((0x123, None, false)))
        );
        assert_eq!((raw("Total", true), raw("", false)), (None, None));
        assert_eq!(
            (number("0,1"), number("1/256"), number("abc"), number("1/0")),
            (Some(0.1), Some(0.003_906_25), None, None)
        );
        assert_eq!(order("Motorola LSB"), Some((ByteOrder::Big, Some(true))));
        assert_eq!(
            (order("i"), order("0"), order("?")),
            (Some((ByteOrder::Little, None)), Some((ByteOrder::Big, None)), None)
        );
        assert_eq!(kind("Unsigned", 8), Some(ValueKind::Unsigned));
        assert_eq!(
            (kind("sint16", 16), kind("float", 32)),
            (Some(ValueKind::Signed), Some(ValueKind::Single))
        );
        let text = |value, text: &str| (value, text.to_owned());
        assert_eq!(
            values("0x0:Off\n0x1: On, warm\n0x2~0x3=Reserved"),
            [text(0, "Off"), text(1, "On, warm"), text(2, "Reserved"), text(3, "Reserved")]
        );
        assert_eq!(
            values("0: Park, 1: Drive; 7: Error"),
            [text(0, "Park"), text(1, "Drive"), text(7, "Error")]
        );
        assert_eq!(values("see below"), []);
        assert_eq!(values("0..9999999: x").len() as i64, MOST_TEXTS);
        assert_eq!(factor_and_unit("0.1  km/h"), (0.1, "km/h".to_owned()));
        assert_eq!(
            (factor_and_unit("0.5 -").1, factor_and_unit("rpm")),
            (String::new(), (1.0, "rpm".to_owned()))
        );
        assert_eq!(
            (mode("Mode 3:text"), mode("Mode Signal: ")),
            (("text".to_owned(), Some(Mux::For(vec![3..=3]))), (String::new(), Some(Mux::Switch)))
        );
        assert_eq!((mux("M"), mux("m1"), mux("")), (Some(Mux::Switch), Some(Mux::For(vec![1..=1])), None));
    }
}
