//! Converts text to the bytes of values (CiA 301, table 44).

/// A text that is not a value of the type.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{text}' is not a valid {name}; write {advice}")]
pub struct BadValue {
    /// The text.
    pub text: String,
    /// The type.
    pub name: String,
    /// What would be valid.
    pub advice: &'static str,
}

/// Types by their written names.
const NAMES: [(&str, u16); 17] = [
    ("bool", 0x01),
    ("i8", 0x02),
    ("i16", 0x03),
    ("i24", 0x10),
    ("i32", 0x04),
    ("i64", 0x15),
    ("u8", 0x05),
    ("u16", 0x06),
    ("u24", 0x16),
    ("u32", 0x07),
    ("u64", 0x1B),
    ("f32", 0x08),
    ("f64", 0x11),
    ("text", 0x09),
    ("utf16", 0x0B),
    ("hex", 0x0A),
    ("domain", 0x0F),
];

/// The number of the type written as `u16`, `i8`, `f32`, `text`, `hex` and so on.
pub fn type_named(name: &str) -> Option<u16> {
    NAMES.iter().find(|(known, _)| *known == name).map(|(_, number)| *number)
}

/// The bytes of a value: integers in decimal or as 0x1F, texts as they are, anything else in hexadecimal.
pub fn encode(data_type: u16, text: &str) -> Result<Vec<u8>, BadValue> {
    let name = NAMES.iter().find(|(_, number)| *number == data_type);
    let name = name.map_or_else(|| format!("type {data_type:04X}"), |(name, _)| (*name).to_owned());
    let bad = |advice| BadValue { text: text.to_owned(), name: name.clone(), advice };
    let whole = |bytes: usize, signed: bool| {
        let number = whole(text).ok_or_else(|| bad("a whole number, as 1500 or 0x5DC"))?;
        let bits = 8 * bytes as u32;
        let (least, most) =
            if signed { (-(1_i128 << (bits - 1)), (1 << (bits - 1)) - 1) } else { (0, (1 << bits) - 1) };
        if (least..=most).contains(&number) {
            Ok(number.to_le_bytes()[..bytes].to_vec())
        } else {
            Err(bad("a number within the type's range"))
        }
    };
    match data_type {
        0x01 => match text {
            "0" | "false" => Ok(vec![0]),
            "1" | "true" => Ok(vec![1]),
            _ => Err(bad("0 or 1")),
        },
        0x02 => whole(1, true),
        0x03 => whole(2, true),
        0x10 => whole(3, true),
        0x04 => whole(4, true),
        0x12 => whole(5, true),
        0x13 => whole(6, true),
        0x14 => whole(7, true),
        0x15 => whole(8, true),
        0x05 => whole(1, false),
        0x06 => whole(2, false),
        0x16 => whole(3, false),
        0x07 => whole(4, false),
        0x18 => whole(5, false),
        0x19 => whole(6, false),
        0x1A => whole(7, false),
        0x1B => whole(8, false),
        0x08 => {
            text.parse::<f32>().map(|value| value.to_le_bytes().to_vec()).map_err(|_| bad("a number, as 1.5"))
        }
        0x11 => {
            text.parse::<f64>().map(|value| value.to_le_bytes().to_vec()).map_err(|_| bad("a number, as 1.5"))
        }
        0x09 => Ok(text.as_bytes().to_vec()),
        0x0B => Ok(text.encode_utf16().flat_map(u16::to_le_bytes).collect()),
        _ => bytes(text).ok_or_else(|| bad("bytes in hexadecimal, two digits each, as 0A1B")),
    }
}

fn whole(text: &str) -> Option<i128> {
    let (sign, digits) = text.strip_prefix('-').map_or((1, text), |digits| (-1, digits));
    let number = match digits.strip_prefix("0x").or_else(|| digits.strip_prefix("0X")) {
        Some(digits) => u64::from_str_radix(digits, 16).ok()?,
        None => digits.parse().ok()?,
    };
    Some(sign * i128::from(number))
}

fn bytes(text: &str) -> Option<Vec<u8>> {
    let digits: String = text.chars().filter(|letter| !letter.is_whitespace()).collect();
    let is_right = digits.is_ascii() && digits.len().is_multiple_of(2);
    let pairs = (0..digits.len()).step_by(2);
    is_right.then(|| pairs.map(|at| u8::from_str_radix(digits.get(at..at + 2)?, 16).ok()).collect())?
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::canopen::types::value;
    use crate::{Field, Value};

    /// What is written reads back as the same type.
    #[test]
    fn every_type_comes_back() {
        for (name, text, shown) in [
            ("bool", "1", Value::Number(1)),
            ("i8", "-128", Value::Number(-128)),
            ("i16", "-2", Value::Number(-2)),
            ("i24", "-8388608", Value::Number(-8_388_608)),
            ("i32", "2147483647", Value::Number(2_147_483_647)),
            ("i64", "-9", Value::Number(-9)),
            ("u8", "0xFF", Value::Number(255)),
            ("u16", "1500", Value::Number(1500)),
            ("u24", "16777215", Value::Number(16_777_215)),
            ("u32", "4294967295", Value::Number(4_294_967_295)),
            ("u64", "0xFFFFFFFFFFFFFFFF", Value::Hex(u64::MAX, 16)),
            ("f32", "1.5", Value::Real(1.5)),
            ("f64", "-0.25", Value::Real(-0.25)),
            ("text", "drive 1", Value::Text("drive 1".into())),
            ("utf16", "grün", Value::Text("grün".into())),
            ("hex", "0A 1B", Value::Bytes(vec![0x0A, 0x1B].into())),
        ] {
            let number = type_named(name).unwrap();
            let bytes = encode(number, text).unwrap();
            assert_eq!(value(Some(number), &bytes), shown, "{name} {}", Field::bytes("", &bytes).name);
        }
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        for (name, text) in [
            ("u8", "256"),
            ("u8", "-1"),
            ("i8", "128"),
            ("u16", "x"),
            ("f32", "much"),
            ("bool", "2"),
            ("hex", "0A1"),
        ] {
            assert!(encode(type_named(name).unwrap(), text).is_err(), "{name} {text}");
        }
        assert_eq!(
            encode(0x05, "256").unwrap_err().to_string(),
            "'256' is not a valid u8; write a number within the type's range"
        );
        assert_eq!(type_named("byte"), None);
    }
}
