//! Values of channels, and what those of a bus event mean.

/// The value of a channel in a record.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Value {
    Unsigned(u64),
    Signed(i64),
    Float(f64),
    Text(String),
}

/// What the number of a part of a bus event stands for: texts, which a conversion may give, are understood by it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Meaning {
    /// A number as it stands: an identifier, a length, a channel.
    Number,
    /// 0 for received, otherwise sent.
    Direction,
    /// 0 for a standard identifier, otherwise extended.
    Extended,
    /// 0 for no, otherwise yes.
    Flag,
}

impl Value {
    /// As a floating-point number; `None` for a text.
    pub(super) fn number(&self) -> Option<f64> {
        match self {
            Self::Unsigned(number) => Some(*number as f64),
            Self::Signed(number) => Some(*number as f64),
            Self::Float(number) => Some(*number),
            Self::Text(_) => None,
        }
    }

    /// As a whole number that is not negative; `None` if it is none.
    pub(super) fn whole(&self) -> Option<u64> {
        /// The first number that a `u64` cannot hold, 2^64.
        const END: f64 = 18_446_744_073_709_551_616.0;
        match self {
            Self::Unsigned(number) => Some(*number),
            Self::Signed(number) => u64::try_from(*number).ok(),
            // A conversion by a factor such as 0.1 is seldom exact.
            Self::Float(number) => {
                let whole = number.round();
                ((number - whole).abs() < 1e-6 && (0.0..END).contains(&whole)).then_some(whole as u64)
            }
            Self::Text(_) => None,
        }
    }
}

impl Meaning {
    /// The number that a value stands for; `None` if it is a text that says nothing known, or not a whole number.
    pub(super) fn of(self, value: &Value) -> Option<u64> {
        match (self, value) {
            (_, Value::Text(text)) => self.of_text(text.trim()),
            (Self::Number, value) => value.whole(),
            (_, value) => {
                value.number().filter(|number| !number.is_nan()).map(|number| u64::from(number != 0.0))
            }
        }
    }

    fn of_text(self, text: &str) -> Option<u64> {
        if !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit()) {
            return text.parse().ok();
        }
        let lower = text.to_ascii_lowercase();
        if let Some(hex) = lower.strip_prefix("0x") {
            return u64::from_str_radix(hex, 16).ok();
        }
        match self {
            // As in `CAN 2`.
            Self::Number => {
                let digits = text.len() - text.trim_end_matches(|c: char| c.is_ascii_digit()).len();
                text[text.len() - digits..].parse().ok()
            }
            Self::Direction if lower.starts_with('t') => Some(1),
            Self::Direction if lower.starts_with('r') => Some(0),
            Self::Extended if lower.starts_with('e') => Some(1),
            Self::Extended if lower.starts_with(['s', 'b']) => Some(0),
            Self::Flag => match lower.as_str() {
                "true" | "yes" | "y" | "on" | "set" | "fd" | "can fd" | "canfd" => Some(1),
                "false" | "no" | "n" | "off" | "not set" | "unset" | "" => Some(0),
                _ => None,
            },
            Self::Direction | Self::Extended => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Meaning, Value};

    #[test]
    fn texts_of_a_conversion_are_understood_and_others_are_not_guessed() {
        let of = |meaning: Meaning, text: &str| meaning.of(&Value::Text(text.into()));
        for (meaning, text, number) in [
            (Meaning::Direction, "Tx", Some(1)),
            (Meaning::Direction, "Rx", Some(0)),
            (Meaning::Direction, "?", None),
            (Meaning::Extended, "Extended", Some(1)),
            (Meaning::Extended, "standard", Some(0)),
            (Meaning::Flag, "CAN FD", Some(1)),
            (Meaning::Flag, "CAN", None),
            (Meaning::Flag, "1", Some(1)),
            (Meaning::Number, "CAN 12", Some(12)),
            (Meaning::Number, "0x7FF", Some(0x7FF)),
            (Meaning::Number, "vehicle", None),
        ] {
            assert_eq!(of(meaning, text), number, "{meaning:?} {text}");
        }
        for (value, whole) in [
            (Value::Float(3.000_000_000_1), Some(3)),
            (Value::Float(3.5), None),
            (Value::Float(-1.0), None),
            (Value::Float(f64::NAN), None),
            (Value::Float(2e19), None),
            (Value::Signed(-1), None),
        ] {
            assert_eq!(value.whole(), whole, "{value:?}");
        }
        assert_eq!(Meaning::Flag.of(&Value::Signed(-1)), Some(1));
    }
}
