//! From the number in the ECU's memory to the value that it stands for, and back (COMPU_METHOD).

use cantap_trace::formula::Formula;

/// How a number becomes a value.
#[derive(Clone, Debug, PartialEq)]
pub enum Conversion {
    /// The number itself.
    Identical,
    /// A factor and an offset: value = factor × number + offset.
    Linear {
        /// The factor.
        factor: f64,
        /// The offset.
        offset: f64,
    },
    /// The number as a fraction of the value p: (a p² + b p + c) / (d p² + e p + f), in this order.
    Rational([f64; 6]),
    /// Points of a curve, by number.
    Points {
        /// Number and value, in order of the numbers.
        points: Vec<(f64, f64)>,
        /// Between two points is a straight line; otherwise nothing.
        is_interpolated: bool,
        /// The value of all other numbers.
        default: Option<f64>,
    },
    /// A text for each of these ranges, both ends included.
    Texts(Texts),
    /// By a formula, and back by another, if there is one.
    Formula(Formula, Option<Formula>),
    /// In a way that is not evaluated.
    Unknown,
}

/// Texts for numbers.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Texts {
    /// From, to, text.
    pub ranges: Vec<(f64, f64, String)>,
    /// The text of all other numbers.
    pub default: Option<String>,
}

/// What a number stands for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Meaning<'a> {
    /// A value.
    Value(f64),
    /// A text.
    Text(&'a str),
    /// The number stands for nothing that the description says.
    Nothing,
}

impl Texts {
    /// The text for a number.
    pub fn get(&self, number: f64) -> Option<&str> {
        let found = self.ranges.iter().find(|(from, to, _)| *from <= number && number <= *to);
        found.map(|(_, _, text)| text.as_str()).or(self.default.as_deref())
    }

    /// The only number that has a text, compared regardless of case.
    pub fn number_of(&self, text: &str) -> Option<f64> {
        let mut found = self.ranges.iter().filter(|(_, _, known)| known.eq_ignore_ascii_case(text));
        let (from, to, _) = found.next()?;
        (from >= to && found.next().is_none()).then_some(*from)
    }
}

impl Conversion {
    /// What a number stands for.
    pub fn meaning(&self, number: f64) -> Meaning<'_> {
        let value = match self {
            Self::Identical => Some(number),
            Self::Linear { factor, offset } => Some(factor * number + offset),
            Self::Rational(coefficients) => inverse(coefficients, number),
            Self::Points { points, is_interpolated, default } => {
                point_at(points, *is_interpolated, number).or(*default)
            }
            Self::Formula(formula, _) => Some(formula.value(number)),
            Self::Texts(texts) => return texts.get(number).map_or(Meaning::Nothing, Meaning::Text),
            Self::Unknown => None,
        };
        value.filter(|value| value.is_finite()).map_or(Meaning::Nothing, Meaning::Value)
    }

    /// The number for a value; `None` if there is none, or several.
    pub fn number(&self, value: f64) -> Option<f64> {
        let number = match self {
            Self::Identical => value,
            Self::Linear { factor, offset } => (value - offset) / factor,
            Self::Rational([a, b, c, d, e, f]) => {
                (a * value * value + b * value + c) / (d * value * value + e * value + f)
            }
            Self::Points { points, is_interpolated, .. } => {
                let mut swapped: Vec<_> = points.iter().map(|(number, value)| (*value, *number)).collect();
                swapped.sort_by(|one, other| one.0.total_cmp(&other.0));
                // Only a curve that rises or falls all along has one number for a value.
                let is_monotonic = points.windows(2).all(|two| two[0].1 < two[1].1)
                    || points.windows(2).all(|two| two[0].1 > two[1].1);
                let (first, last) = (swapped.first()?.0, swapped.last()?.0);
                if !is_monotonic || !(first..=last).contains(&value) {
                    return None;
                }
                point_at(&swapped, *is_interpolated, value)?
            }
            Self::Formula(_, inverse) => inverse.as_ref()?.value(value),
            Self::Texts(_) | Self::Unknown => return None,
        };
        number.is_finite().then_some(number)
    }
}

/// The value p for which the fraction is the number. Where p² takes part, there are two, and the description does not say which is meant.
fn inverse([a, b, c, d, e, f]: &[f64; 6], number: f64) -> Option<f64> {
    if *a != 0.0 || *d != 0.0 {
        return None;
    }
    let divisor = e * number - b;
    (divisor != 0.0).then(|| (c - f * number) / divisor)
}

/// The value at a place between points; beyond them there is none.
fn point_at(points: &[(f64, f64)], is_interpolated: bool, at: f64) -> Option<f64> {
    let place = points.partition_point(|(known, _)| *known < at);
    // It is not below, so that it is the place itself if it is not above.
    if let Some((known, value)) = points.get(place)
        && *known <= at
    {
        return Some(*value);
    }
    if !is_interpolated {
        return None;
    }
    match (place.checked_sub(1).and_then(|before| points.get(before)), points.get(place)) {
        (Some((x0, y0)), Some((x1, y1))) => Some(y0 + (y1 - y0) * (at - x0) / (x1 - x0)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texts() -> Texts {
        let ranges = vec![(0.0, 0.0, "off".to_owned()), (1.0, 3.0, "on".to_owned())];
        Texts { ranges, default: Some("?".to_owned()) }
    }

    #[test]
    fn fractions_are_given_from_the_value_to_the_number() {
        // The usual way to write value = 0.25 × number − 40.
        let scaled = Conversion::Rational([0.0, 4.0, 160.0, 0.0, 0.0, 1.0]);
        assert_eq!(scaled.meaning(200.0), Meaning::Value(10.0));
        assert_eq!(scaled.number(10.0), Some(200.0));
        // A reciprocal: number = 60000 / value.
        let reciprocal = Conversion::Rational([0.0, 0.0, 60_000.0, 0.0, 1.0, 0.0]);
        assert_eq!(reciprocal.meaning(20.0), Meaning::Value(3000.0));
        assert_eq!(reciprocal.meaning(0.0), Meaning::Nothing);
        let square = Conversion::Rational([1.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
        assert_eq!((square.meaning(9.0), square.number(3.0)), (Meaning::Nothing, Some(9.0)));
    }

    #[test]
    fn linear_functions_are_given_from_the_number_to_the_value() {
        let linear = Conversion::Linear { factor: 0.25, offset: -40.0 };
        assert_eq!((linear.meaning(200.0), linear.number(10.0)), (Meaning::Value(10.0), Some(200.0)));
        assert_eq!(Conversion::Linear { factor: 0.0, offset: 1.0 }.number(1.5), None);
    }

    #[test]
    fn curves_are_straight_between_their_points() {
        let points = vec![(0.0, 0.0), (10.0, 100.0), (20.0, 120.0)];
        let curve = |is_interpolated, default| Conversion::Points {
            points: points.clone(),
            is_interpolated,
            default,
        };
        for (number, value) in [(0.0, 0.0), (5.0, 50.0), (10.0, 100.0), (15.0, 110.0), (20.0, 120.0)] {
            assert_eq!(curve(true, None).meaning(number), Meaning::Value(value));
        }
        assert_eq!(curve(true, None).meaning(20.5), Meaning::Nothing);
        assert_eq!(curve(true, Some(-1.0)).meaning(-0.5), Meaning::Value(-1.0));
        assert_eq!(curve(true, None).number(110.0), Some(15.0));
        assert_eq!(curve(true, None).number(130.0), None);
        assert_eq!(curve(false, None).meaning(5.0), Meaning::Nothing);
        assert_eq!(curve(false, Some(-1.0)).meaning(5.0), Meaning::Value(-1.0));
    }

    #[test]
    fn texts_have_ranges_and_a_default() {
        let conversion = Conversion::Texts(texts());
        for (number, text) in [(0.0, "off"), (2.0, "on"), (9.0, "?")] {
            assert_eq!(conversion.meaning(number), Meaning::Text(text));
        }
        assert_eq!((texts().number_of("OFF"), texts().number_of("on")), (Some(0.0), None));
    }
}
