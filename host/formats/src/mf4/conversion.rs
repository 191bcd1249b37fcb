//! Conversions: what the raw value of a channel stands for (ASAM MDF 4.2, conversion block). All types but text to text, which no part of
//! a bus event can need.

use cantap_trace::formula::{Dialect, Formula};

use super::super::issue::Fault;
use super::super::whole::Whole;
use super::blocks::{Block, u16_at, u64_at};
use super::value::Value;

/// How deeply a conversion may refer to others.
const MAX_DEPTH: u32 = 8;

/// After type, precision, flags, numbers of links and values, and range come the values.
const VALUES_AT: usize = 24;

/// Links before those to texts and other conversions.
const COMMON_LINKS: usize = 4;

/// What raw values stand for.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Conversion {
    /// Themselves.
    None,
    Linear {
        offset: f64,
        factor: f64,
    },
    /// (a x² + b x + c) / (d x² + e x + f).
    Rational([f64; 6]),
    Formula(Box<Formula>),
    /// Pairs of a number and its meaning, in ascending order; between them, the nearest or what lies on a line.
    Table {
        pairs: Vec<(f64, f64)>,
        interpolates: bool,
    },
    /// From, to, and what is between.
    Ranges {
        ranges: Vec<(f64, f64, f64)>,
        otherwise: f64,
    },
    /// From, to, and what is between.
    Texts {
        ranges: Vec<(f64, f64, Outcome)>,
        otherwise: Outcome,
    },
    /// What texts stand for.
    Numbers {
        texts: Vec<(String, f64)>,
        otherwise: f64,
    },
    /// Bits, and what they stand for.
    Bits(Vec<(u64, Outcome)>),
}

/// What a table has for a number.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Outcome {
    Nothing,
    Text(String),
    Conversion(Box<Conversion>),
}

impl Conversion {
    /// That of a channel.
    pub(super) fn of(file: &mut Whole, channel: &Block) -> Result<Self, Fault> {
        Self::at(file, channel.link(4), 0)
    }

    fn at(file: &mut Whole, link: u64, depth: u32) -> Result<Self, Fault> {
        if link == 0 {
            return Ok(Self::None);
        }
        let block = file.block(link, *b"##CC")?;
        let count = usize::from(u16_at(&block.data, 6));
        let there = block.data.len().saturating_sub(VALUES_AT) / 8;
        let values: Vec<_> =
            (0..count.min(there)).map(|at| u64_at(&block.data, VALUES_AT + 8 * at)).collect();
        let refs = block.links.get(COMMON_LINKS..).unwrap_or_default();
        let number = |at: usize| values.get(at).map(|bits| f64::from_bits(*bits));
        let kind = block.data.first().copied().unwrap_or(0);
        let short = || Fault::malformed(format!("the values of a conversion at {link:#x}"), b"fewer");
        let numbers = || values.iter().map(|bits| f64::from_bits(*bits)).collect::<Vec<_>>();
        Ok(match kind {
            0 => Self::None,
            1 => Self::Linear { offset: number(0).ok_or_else(short)?, factor: number(1).ok_or_else(short)? },
            2 => Self::Rational(numbers().first_chunk().copied().ok_or_else(short)?),
            3 => {
                let text = file.text(refs.first().copied().unwrap_or(0))?;
                let formula = Formula::read(&text, Dialect::Mdf)
                    .ok_or_else(|| Fault::malformed("a formula", text.as_bytes()))?;
                Self::Formula(Box::new(formula))
            }
            4 | 5 => {
                let pairs: Vec<_> = numbers().chunks_exact(2).map(|pair| (pair[0], pair[1])).collect();
                Self::Table { pairs, interpolates: kind == 4 }
            }
            6 => {
                let (rows, rest) = (numbers(), values.len() % 3);
                let otherwise = if rest == 1 { number(values.len() - 1) } else { None };
                let ranges = rows.chunks_exact(3).map(|row| (row[0], row[1], row[2])).collect();
                Self::Ranges { ranges, otherwise: otherwise.unwrap_or(f64::NAN) }
            }
            7 | 8 => {
                let rows = numbers();
                let rows: Vec<_> = match kind {
                    7 => rows.iter().map(|key| (*key, *key)).collect(),
                    _ => rows.chunks_exact(2).map(|row| (row[0], row[1])).collect(),
                };
                let mut ranges = Vec::with_capacity(rows.len());
                for ((from, to), link) in rows.iter().zip(refs) {
                    ranges.push((*from, *to, Outcome::at(file, *link, depth)?));
                }
                let otherwise = refs.get(rows.len()).copied().unwrap_or(0);
                Self::Texts { ranges, otherwise: Outcome::at(file, otherwise, depth)? }
            }
            9 => {
                let mut texts = Vec::with_capacity(refs.len());
                for (link, value) in refs.iter().zip(numbers()) {
                    texts.push((file.text(*link)?, value));
                }
                Self::Numbers { texts, otherwise: number(refs.len()).unwrap_or(f64::NAN) }
            }
            11 => {
                let mut bits = Vec::with_capacity(refs.len());
                for (link, mask) in refs.iter().zip(&values) {
                    bits.push((*mask, Outcome::at(file, *link, depth)?));
                }
                Self::Bits(bits)
            }
            10 => return Err(Fault::Unsupported("a conversion of texts to texts".into())),
            _ => {
                let found = format!("type {kind}");
                return Err(Fault::malformed(
                    format!("a conversion of a known type at {link:#x}"),
                    found.as_bytes(),
                ));
            }
        })
    }

    /// Whether it is one into texts.
    pub(super) fn gives_texts(&self) -> bool {
        matches!(self, Self::Texts { .. } | Self::Bits(_))
    }

    /// What a value stands for; `None` if nothing.
    pub(super) fn apply(&self, value: Value) -> Option<Value> {
        if matches!(self, Self::None) {
            return Some(value);
        }
        if let Self::Numbers { texts, otherwise } = self {
            let Value::Text(text) = value else { return Some(value) };
            let known = texts.iter().find(|(known, _)| *known == text);
            return Some(Value::Float(known.map_or(*otherwise, |(_, number)| *number)));
        }
        if let Self::Bits(bits) = self {
            return Some(Value::Text(joined(bits, value.whole()?)));
        }
        let x = value.number()?;
        let is_whole = !matches!(value, Value::Float(_));
        Some(Value::Float(match self {
            Self::Linear { offset, factor } => offset + factor * x,
            Self::Rational([a, b, c, d, e, f]) => (a * x * x + b * x + c) / (d * x * x + e * x + f),
            Self::Formula(formula) => formula.value(x),
            Self::Table { pairs, interpolates } => looked_up(pairs, x, *interpolates)?,
            Self::Ranges { ranges, otherwise } => {
                let row = ranges.iter().find(|(from, to, _)| is_between(x, *from, *to, is_whole));
                row.map_or(*otherwise, |(.., number)| *number)
            }
            Self::Texts { ranges, otherwise } => {
                let row = ranges.iter().find(|(from, to, _)| is_between(x, *from, *to, is_whole));
                return row.map_or(otherwise, |(.., outcome)| outcome).apply(value);
            }
            Self::None | Self::Numbers { .. } | Self::Bits(_) => return None,
        }))
    }
}

impl Outcome {
    fn at(file: &mut Whole, link: u64, depth: u32) -> Result<Self, Fault> {
        if link == 0 || depth >= MAX_DEPTH {
            return Ok(Self::Nothing);
        }
        Ok(match &file.head(link)?.name {
            b"##CC" => Self::Conversion(Box::new(Conversion::at(file, link, depth + 1)?)),
            _ => Self::Text(file.text(link)?),
        })
    }

    fn apply(&self, value: Value) -> Option<Value> {
        match self {
            Self::Nothing => None,
            Self::Text(text) => Some(Value::Text(text.clone())),
            Self::Conversion(conversion) => conversion.apply(value),
        }
    }
}

/// Of a floating-point number, the end of a range is outside it.
fn is_between(x: f64, from: f64, to: f64, is_whole: bool) -> bool {
    if from < to && !is_whole { (from..to).contains(&x) } else { (from..=to).contains(&x) }
}

/// What a table has for a number: outside it, what its first or last row has. Between two rows the nearer one counts, the lower one in the middle.
fn looked_up(pairs: &[(f64, f64)], x: f64, interpolates: bool) -> Option<f64> {
    let behind = pairs.partition_point(|(key, _)| *key <= x);
    let (lower, upper) = match (behind.checked_sub(1).map(|at| pairs[at]), pairs.get(behind)) {
        (None, upper) => return upper.map(|(_, value)| *value).filter(|_| !x.is_nan()),
        (Some(lower), None) => return Some(lower.1),
        (Some(lower), Some(upper)) => (lower, *upper),
    };
    Some(if interpolates {
        lower.1 + (x - lower.0) / (upper.0 - lower.0) * (upper.1 - lower.1)
    } else if x - lower.0 > upper.0 - x {
        upper.1
    } else {
        lower.1
    })
}

/// The texts of all bits, as the standard joins them.
fn joined(bits: &[(u64, Outcome)], number: u64) -> String {
    let texts =
        bits.iter().filter_map(|(mask, outcome)| match outcome.apply(Value::Unsigned(number & mask))? {
            Value::Text(text) if !text.is_empty() => Some(text),
            _ => None,
        });
    texts.collect::<Vec<_>>().join("|")
}

#[cfg(test)]
mod tests {
    use super::{Conversion, Outcome, Value};

    fn of(conversion: &Conversion, x: f64) -> f64 {
        conversion.apply(Value::Float(x)).unwrap().number().unwrap()
    }

    #[test]
    fn tables_give_the_nearest_or_what_lies_between() {
        let pairs = vec![(8.0, 8.0), (9.0, 12.0), (11.0, 20.0)];
        let nearest = Conversion::Table { pairs: pairs.clone(), interpolates: false };
        let line = Conversion::Table { pairs, interpolates: true };
        for (x, near, on_line) in [
            (0.0, 8.0, 8.0),
            (8.5, 8.0, 10.0),
            (8.6, 12.0, 10.4),
            (9.0, 12.0, 12.0),
            (10.5, 20.0, 18.0),
            (99.0, 20.0, 20.0),
        ] {
            assert!((of(&nearest, x) - near).abs() < 1e-9, "{x}");
            assert!((of(&line, x) - on_line).abs() < 1e-9, "{x}");
        }
        assert_eq!(Conversion::Table { pairs: vec![], interpolates: true }.apply(Value::Float(1.0)), None);
    }

    #[test]
    fn ranges_end_inside_whole_numbers_and_before_others() {
        let ranges = Conversion::Ranges { ranges: vec![(0.0, 3.0, 7.0), (3.0, 5.0, 9.0)], otherwise: -1.0 };
        assert_eq!((of(&ranges, 2.9), of(&ranges, 3.0), of(&ranges, 5.0)), (7.0, 9.0, -1.0));
        assert_eq!(ranges.apply(Value::Unsigned(5)), Some(Value::Float(9.0)));
        let deeper = Conversion::Linear { offset: 1.0, factor: 10.0 };
        let texts = Conversion::Texts {
            ranges: vec![
                (1.0, 1.0, Outcome::Text("Tx".into())),
                (2.0, 2.0, Outcome::Conversion(Box::new(deeper))),
            ],
            otherwise: Outcome::Nothing,
        };
        assert_eq!(texts.apply(Value::Unsigned(1)), Some(Value::Text("Tx".into())));
        assert_eq!(texts.apply(Value::Unsigned(2)), Some(Value::Float(21.0)));
        assert_eq!(texts.apply(Value::Unsigned(3)), None);
    }

    #[test]
    fn texts_and_bits_and_fractions_have_their_own_forms() {
        let numbers = Conversion::Numbers { texts: vec![("Tx".into(), 1.0)], otherwise: 0.0 };
        assert_eq!(numbers.apply(Value::Text("Tx".into())), Some(Value::Float(1.0)));
        assert_eq!(numbers.apply(Value::Text("Rx".into())), Some(Value::Float(0.0)));
        let fraction = Conversion::Rational([0.0, 2.0, 1.0, 0.0, 0.0, 4.0]);
        assert!((of(&fraction, 3.0) - 1.75).abs() < 1e-12);
        let flag = |text: &str| {
            let ranges = vec![(0.0, 0.0, Outcome::Nothing)];
            Outcome::Conversion(Box::new(Conversion::Texts { ranges, otherwise: Outcome::Text(text.into()) }))
        };
        let bits = Conversion::Bits(vec![(1, flag("BRS")), (2, flag("ESI")), (4, flag("EDL"))]);
        assert_eq!(bits.apply(Value::Unsigned(5)), Some(Value::Text("BRS|EDL".into())));
    }
}
