//! The signals page: its sorting, and which signals it shows.

use std::ops::Range;

/// The columns by which the signals page can be sorted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SignalColumn {
    /// In order of appearance.
    #[default]
    Seen,
    /// Message and name.
    Name,
    /// Value, largest first.
    Value,
    /// Smallest value so far, largest first.
    Min,
    /// Largest value so far, largest first.
    Max,
    /// Last change, newest first.
    Changed,
}

impl SignalColumn {
    /// The next one.
    pub const fn next(self) -> Self {
        match self {
            Self::Seen => Self::Name,
            Self::Name => Self::Value,
            Self::Value => Self::Min,
            Self::Min => Self::Max,
            Self::Max => Self::Changed,
            Self::Changed => Self::Seen,
        }
    }
}

/// The state of the signals page.
#[derive(Clone, Debug, Default)]
pub struct SignalsPage {
    /// The column by which it is sorted.
    pub sort: SignalColumn,
    /// In reverse order.
    pub reverse: bool,
    /// Grouped by message.
    pub grouped: bool,
    /// Which signals are shown.
    pub filter: SignalFilter,
    /// The positions of the headings that sort, as last drawn.
    pub headings: Vec<(Range<u16>, SignalColumn)>,
}

impl SignalsPage {
    /// Handles a click on a heading: sorts by it, or reverses the order.
    pub fn sort_by(&mut self, column: SignalColumn) {
        if self.sort == column {
            self.reverse = !self.reverse;
        } else {
            (self.sort, self.reverse) = (column, false);
        }
    }
}

/// Which signals to show: all conditions must hold.
#[derive(Clone, Debug, Default)]
pub struct SignalFilter {
    text: String,
    conditions: Vec<Condition>,
}

/// A part of a name, in lower case, with `*` for anything; and a condition for the value.
#[derive(Clone, Debug)]
struct Condition {
    name: Vec<String>,
    value: Option<(Comparison, f64)>,
    alarm: bool,
}

#[derive(Clone, Copy, Debug)]
enum Comparison {
    Less,
    LessOrEqual,
    Equal,
    NotEqual,
    GreaterOrEqual,
    Greater,
}

impl Comparison {
    const ALL: [(&str, Self); 6] = [
        (">=", Self::GreaterOrEqual),
        ("<=", Self::LessOrEqual),
        ("==", Self::Equal),
        ("!=", Self::NotEqual),
        (">", Self::Greater),
        ("<", Self::Less),
    ];

    fn holds(self, value: f64, than: f64) -> bool {
        /// Fractions come from multiplying integers, and have a rounding error.
        const ROUNDING: f64 = 1e-9;
        let is_same = (value - than).abs() <= ROUNDING * value.abs().max(than.abs());
        match self {
            Self::Less => value < than && !is_same,
            Self::LessOrEqual => value <= than || is_same,
            Self::Equal => is_same,
            Self::NotEqual => !is_same && !value.is_nan(),
            Self::GreaterOrEqual => value >= than || is_same,
            Self::Greater => value > than && !is_same,
        }
    }
}

impl SignalFilter {
    /// `Speed > 80 and Wheel`: parts of names (`*` is anything), values, `alarm`. An empty text shows all.
    pub fn new(text: &str) -> Result<Self, String> {
        let parts = text.split(" and ").map(str::trim).filter(|part| !part.is_empty());
        let conditions = parts.map(Condition::new).collect::<Result<_, _>>()?;
        Ok(Self { text: text.trim().to_owned(), conditions })
    }

    /// The text as typed.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// Whether a signal is shown. The name is `Message.Signal`.
    pub fn accepts(&self, name: &str, value: f64, is_alarm: bool) -> bool {
        if self.conditions.is_empty() {
            return true;
        }
        let name = name.to_lowercase();
        self.conditions.iter().all(|condition| {
            condition.names(&name)
                && condition.value.is_none_or(|(comparison, than)| comparison.holds(value, than))
                && (!condition.alarm || is_alarm)
        })
    }
}

impl Condition {
    fn new(text: &str) -> Result<Self, String> {
        if text.eq_ignore_ascii_case("alarm") {
            return Ok(Self { name: Vec::new(), value: None, alarm: true });
        }
        let compared = Comparison::ALL.into_iter().find_map(|(sign, comparison)| {
            text.split_once(sign).map(|(name, value)| (name.trim(), comparison, value.trim()))
        });
        let (name, value) = match compared {
            None => (text, None),
            Some((name, comparison, value)) => {
                let number = value.parse::<f64>().ok().filter(|number| number.is_finite());
                let number = number.ok_or_else(|| {
                    format!("'{value}' is not a number; write part of a name, a condition such as Speed > 80, or alarm")
                })?;
                (name, Some((comparison, number)))
            }
        };
        let name = name.to_lowercase().split('*').map(|part| part.trim().to_owned()).collect();
        Ok(Self { name, value, alarm: false })
    }

    fn names(&self, name: &str) -> bool {
        let mut rest = name;
        self.name.iter().all(|part| match rest.split_once(part.as_str()) {
            Some((_, behind)) => {
                rest = behind;
                true
            }
            None => false,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signals_are_chosen_by_name_value_and_alarm() {
        let accepts = |text: &str| SignalFilter::new(text).unwrap().accepts("Engine.OilTemp", 90.0, true);
        for text in
            ["", "oil", "engine.oil", "eng*temp", "oil > 80", ">= 90", "alarm", "oil and > 80 and alarm"]
        {
            assert!(accepts(text), "{text}");
        }
        for text in ["water", "temp*oil", "oil > 90", "oil and < 80", "oil != 90"] {
            assert!(!accepts(text), "{text}");
        }
        assert!(!SignalFilter::new("!= 5").unwrap().accepts("A.B", f64::NAN, false));
        assert!(!SignalFilter::new("alarm").unwrap().accepts("A.B", 1.0, false));
        assert!(SignalFilter::new("Speed > fast").unwrap_err().contains("Speed > 80"));
    }
}
