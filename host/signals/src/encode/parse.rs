//! Parses `Message:Signal=value,…` into names and values.

use super::error::EncodeError;

/// A value as the user gives it.
#[derive(Clone, Debug, PartialEq)]
pub enum Input {
    /// A physical value: `90`, `-1.5`, `0x1F`.
    Integer(i128),
    /// A physical value with a fraction.
    Real(f64),
    /// The bits themselves: `raw:0xFF`.
    Raw(u64),
    /// A text of the value table: `Drive`, or in quotes.
    Text(String),
}

/// Splits `Message:Signal=value,…`. A value in double quotes is a text, whatever it contains.
pub fn parse(text: &str) -> Result<(String, Vec<(String, Input)>), EncodeError> {
    let form = || EncodeError::Form { text: text.to_owned() };
    let (name, rest) = text.split_once(':').unwrap_or((text, ""));
    let name = name.trim();
    if name.is_empty() {
        return Err(form());
    }
    let mut inputs = Vec::new();
    let mut rest = rest.trim();
    while !rest.is_empty() {
        let (signal, after) = rest.split_once('=').ok_or_else(form)?;
        let after = after.trim_start();
        let (input, after) = if let Some(quoted) = after.strip_prefix('"') {
            let (value, after) = quoted.split_once('"').ok_or_else(form)?;
            (Input::Text(value.to_owned()), after.trim_start())
        } else {
            let end = after.find(',').unwrap_or(after.len());
            (input(after[..end].trim()), &after[end..])
        };
        if signal.trim().is_empty() || input == Input::Text(String::new()) {
            return Err(form());
        }
        inputs.push((signal.trim().to_owned(), input));
        rest = match after.strip_prefix(',') {
            Some(more) if !more.trim().is_empty() => more.trim(),
            None if after.is_empty() => after,
            _ => return Err(form()),
        };
    }
    Ok((name.to_owned(), inputs))
}

fn input(text: &str) -> Input {
    if let Some(raw) = text.strip_prefix("raw:")
        && let Some(raw) = integer(raw).and_then(|raw| u64::try_from(raw).ok())
    {
        return Input::Raw(raw);
    }
    match (integer(text), text.parse::<f64>()) {
        (Some(integer), _) => Input::Integer(integer),
        // Rust also accepts "inf" and "nan", which may well be texts of a value table.
        (_, Ok(real)) if text.contains(|c: char| c.is_ascii_digit()) => Input::Real(real),
        _ => Input::Text(text.to_owned()),
    }
}

fn integer(text: &str) -> Option<i128> {
    let (sign, digits) = text.strip_prefix('-').map_or((1, text), |digits| (-1, digits));
    let magnitude = match digits.strip_prefix("0x").or_else(|| digits.strip_prefix("0X")) {
        Some(hex) if !hex.starts_with('+') => u128::from_str_radix(hex, 16).ok()?,
        _ if digits.starts_with('+') => return None,
        _ => digits.parse().ok()?,
    };
    // A 64-bit value times any sensible factor; nothing below can overflow.
    i128::try_from(magnitude).ok().filter(|magnitude| *magnitude < 1 << 120).map(|magnitude| sign * magnitude)
}
