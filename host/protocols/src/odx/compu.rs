//! From internal values to physical ones (COMPU-METHOD).

use super::internal::{BaseType, Internal, Name};

/// A method.
#[derive(Clone, Debug)]
pub enum Compu {
    Identical,
    /// Also the rational ones: a quotient of polynomials for each range.
    Scales(Vec<CompuScale>),
    /// Texts for ranges, and one for all others.
    Texts(Vec<CompuScale>, Option<Name>),
    /// A line through points.
    Points(Vec<(f64, f64)>),
    /// A program (COMPUCODE), or what is not understood.
    NotEvaluated(Name),
}

/// A range and its formula.
#[derive(Clone, Debug, Default)]
pub struct CompuScale {
    pub low: Option<Limit>,
    pub high: Option<Limit>,
    /// Coefficients, that of the constant first.
    pub numerator: Vec<f64>,
    pub denominator: Vec<f64>,
    pub constant: Option<Name>,
}

/// A limit of a range.
#[derive(Clone, Debug, PartialEq)]
pub struct Limit {
    pub value: Option<BoundValue>,
    pub kind: LimitKind,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LimitKind {
    Closed,
    Open,
    Infinite,
}

#[derive(Clone, Debug, PartialEq)]
pub enum BoundValue {
    Int(i128),
    Real(f64),
    Text(Name),
}

/// A value of the outside world.
#[derive(Clone, Debug, PartialEq)]
pub enum Physical {
    /// An integer.
    Int(i128),
    /// A number.
    Real(f64),
    /// A text.
    Text(String),
    /// Bytes.
    Bytes(Vec<u8>),
    /// An internal value and its text.
    Meaning(Internal, String),
}

impl BoundValue {
    /// A number, or else a text.
    pub fn read(text: &str) -> Self {
        let text = text.trim();
        if let Some(number) = super::xml::integer(text) {
            return Self::Int(number);
        }
        text.parse().map_or_else(|_| Self::Text(text.into()), Self::Real)
    }

    /// How a value compares with it.
    fn cmp(&self, value: &Internal) -> Option<std::cmp::Ordering> {
        match (value, self) {
            (Internal::Int(value), Self::Int(bound)) => Some(value.cmp(bound)),
            (Internal::Int(value), Self::Real(bound)) => (*value as f64).partial_cmp(bound),
            (Internal::Real(value), Self::Int(bound)) => value.partial_cmp(&(*bound as f64)),
            (Internal::Real(value), Self::Real(bound)) => value.partial_cmp(bound),
            (Internal::Text(value), Self::Text(bound)) => Some(value.as_str().cmp(bound)),
            (Internal::Text(value), Self::Int(bound)) => Some(value.as_str().cmp(&bound.to_string())),
            (Internal::Bytes(value), Self::Text(bound)) => {
                super::xml::bytes(bound).map(|bound| value.as_slice().cmp(&bound))
            }
            (Internal::Bytes(value), Self::Int(bound)) => {
                super::xml::bytes(&bound.to_string()).map(|bound| value.as_slice().cmp(&bound))
            }
            _ => None,
        }
    }
}

impl Limit {
    fn allows(&self, value: &Internal, outside: std::cmp::Ordering) -> bool {
        let Some(bound) = self.value.as_ref().filter(|_| self.kind != LimitKind::Infinite) else {
            return true;
        };
        bound.cmp(value).is_some_and(|order| {
            order != outside && (self.kind == LimitKind::Closed || order != std::cmp::Ordering::Equal)
        })
    }
}

/// Whether a value is between two limits. If only one is there, it is the only value where the range is that of a text (ISO 22901-1,
/// 7.3.6.6.1), and open to the other side where it is that of a formula.
pub fn is_between(value: &Internal, low: Option<&Limit>, high: Option<&Limit>, one_is_both: bool) -> bool {
    let (low, high) = match (low, high) {
        (Some(one), None) | (None, Some(one)) if one_is_both && one.kind != LimitKind::Infinite => {
            (Some(one), Some(one))
        }
        both => both,
    };
    low.is_none_or(|low| low.allows(value, std::cmp::Ordering::Less))
        && high.is_none_or(|high| high.allows(value, std::cmp::Ordering::Greater))
}

fn polynomial(coefficients: &[f64], x: f64) -> f64 {
    coefficients.iter().rev().fold(0.0, |sum, coefficient| sum * x + coefficient)
}

/// As an integer, if the physical type is one.
fn typed(value: f64, physical: BaseType) -> Option<Physical> {
    match physical {
        BaseType::Int | BaseType::Uint => {
            let value = value.round_ties_even();
            (value.abs() < 1e30).then_some(Physical::Int(value as i128))
        }
        _ => value.is_finite().then_some(Physical::Real(value)),
    }
}

impl Compu {
    /// The physical value; an error says why there is none.
    pub fn convert(&self, value: Internal, physical: BaseType) -> Result<Physical, String> {
        let number = |value: &Internal| match value {
            Internal::Int(value) => Ok(*value as f64),
            Internal::Real(value) => Ok(*value),
            _ => Err("a formula cannot be applied to a text or bytes".to_owned()),
        };
        let outside = || "the value is outside the ranges of its conversion".to_owned();
        match self {
            Self::Identical => Ok(match value {
                Internal::Int(value) => Physical::Int(value),
                Internal::Real(value) => Physical::Real(value),
                Internal::Text(value) => Physical::Text(value),
                Internal::Bytes(value) => Physical::Bytes(value),
            }),
            Self::Scales(scales) => {
                let x = number(&value)?;
                let applies =
                    |scale: &&CompuScale| is_between(&value, scale.low.as_ref(), scale.high.as_ref(), false);
                let scale = scales.iter().find(applies).ok_or_else(outside)?;
                let below = match &scale.denominator[..] {
                    [] => 1.0,
                    denominator => polynomial(denominator, x),
                };
                let result = match &scale.constant {
                    Some(constant) if scale.numerator.is_empty() => {
                        constant.trim().parse().map_err(|_| outside())?
                    }
                    _ => polynomial(&scale.numerator, x) / below,
                };
                typed(result, physical).ok_or_else(|| "the conversion divides by zero".to_owned())
            }
            Self::Texts(scales, default) => {
                let applies =
                    |scale: &&CompuScale| is_between(&value, scale.low.as_ref(), scale.high.as_ref(), true);
                let text = scales.iter().find(applies).and_then(|scale| scale.constant.as_ref());
                match text.or(default.as_ref()) {
                    Some(text) => Ok(Physical::Meaning(value, text.to_string())),
                    None => Err("the value has no text".to_owned()),
                }
            }
            Self::Points(points) => {
                let x = number(&value)?;
                let segment = points.windows(2).find(|two| two[0].0 <= x && x <= two[1].0);
                let (from, to) = segment.map(|two| (two[0], two[1])).ok_or_else(outside)?;
                let y = match to.0 - from.0 {
                    0.0 => from.1,
                    width => from.1 + (x - from.0) * (to.1 - from.1) / width,
                };
                // As a tool's integers are: cut off, not rounded.
                let y = if matches!(physical, BaseType::Int | BaseType::Uint) { y.trunc() } else { y };
                typed(y, physical).ok_or_else(outside)
            }
            Self::NotEvaluated(what) => Err(format!("its conversion {what} is not evaluated")),
        }
    }
}
