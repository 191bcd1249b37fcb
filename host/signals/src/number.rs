//! A physical value without loss of precision: 64-bit counters do not fit in a float.

use std::fmt;

/// A signal's exact physical value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Number {
    /// Integer raw value with integer factor and offset. Wide enough for every product of 64-bit
    /// raw values and factors.
    Integer(i128),
    /// Everything else.
    Real(f64),
}

impl Number {
    /// The nearest float.
    pub fn as_f64(self) -> f64 {
        match self {
            Self::Integer(value) => value as f64,
            Self::Real(value) => value,
        }
    }

    /// The number for display: a float with 15 digits, which hides that 379220534 · 1e-7 is
    /// 37.922053399999996.
    #[must_use]
    pub fn for_people(self) -> Self {
        match self {
            Self::Real(value) => Self::Real(format!("{value:.14e}").parse().unwrap_or(value)),
            Self::Integer(_) => self,
        }
    }

    /// Whether JSON can represent it: neither infinite nor not-a-number.
    pub fn is_finite(self) -> bool {
        match self {
            Self::Integer(_) => true,
            Self::Real(value) => value.is_finite(),
        }
    }
}

/// The number that a float of 32 bits is written as: the double whose shortest text is also the shortest that reads back as the same
/// float, 0.1 instead of 0.10000000149011612. Integers and what is no number stay as they are.
pub fn shortest_of_f32(value: f32) -> f64 {
    if value.fract() == 0.0 && value.abs() <= 1e16 {
        return value.into();
    }
    value.to_string().parse().unwrap_or_else(|_| value.into())
}

impl fmt::Display for Number {
    /// The shortest decimal that reads back as the same value; if finite, it is also a JSON number.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Integer(value) => fmt::Display::fmt(value, f),
            Self::Real(value) => {
                // Display never uses an exponent: the extremes of a double would have 300 digits.
                let size = value.abs();
                if value.is_finite() && size != 0.0 && !(1e-7..1e17).contains(&size) {
                    fmt::LowerExp::fmt(value, f)
                } else {
                    fmt::Display::fmt(value, f)
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_print_short_and_exact() {
        for (number, text) in [
            (Number::Integer(u64::MAX.into()), "18446744073709551615"),
            (Number::Real(5119.5), "5119.5"),
            (Number::Real(88.0), "88"),
            (Number::Real(0.1 + 0.2), "0.30000000000000004"),
            (Number::Real(-1.5e300), "-1.5e300"),
            (Number::Real(4e-9), "4e-9"),
        ] {
            assert_eq!(number.to_string(), text);
        }
        assert_eq!(Number::Real(379_220_534.0 * 1e-7).for_people().to_string(), "37.9220534");
        assert_eq!(Number::Real(f64::NAN).for_people().to_string(), "NaN");
    }
}
