//! How a group tells the times of its records.

use std::sync::Arc;

use super::super::issue::Fault;
use super::super::whole::Whole;
use super::channel::Channel;
use super::conversion::Conversion;
use super::field::{Field, Place};
use super::value::Value;

/// How a group tells the time of its records.
#[derive(Clone, Debug)]
pub(super) struct Clock {
    /// If `None`, the number of the record.
    field: Option<Field>,
    offset_s: f64,
    factor_s: f64,
    /// A counter of whole nanoseconds, or of a multiple, is exact; a floating-point number would not be.
    step_ns: Option<i64>,
    /// To seconds, if that is no line.
    curve: Option<Arc<Conversion>>,
}

const NS_PER_S: f64 = 1e9;

const MASTER: u8 = 2;
const VIRTUAL_MASTER: u8 = 3;
/// What a master channel counts.
const TIME: u8 = 1;

/// Whether a channel has the times of its group's records.
pub(super) fn is_master(channel: &Channel) -> bool {
    matches!(channel.kind(), MASTER | VIRTUAL_MASTER)
        && matches!(channel.block.data.get(1), Some(&(TIME | 0)))
}

impl Clock {
    /// The clock of a group, from its time channel; `None` if it has none.
    pub(super) fn of(file: &mut Whole, channels: &[Channel]) -> Result<Option<Self>, Fault> {
        let Some(master) = channels.iter().find(|channel| is_master(channel)) else { return Ok(None) };
        let field = (master.kind() != VIRTUAL_MASTER).then(|| Field::of(&master.block));
        let line = |offset_s, factor_s| Self::new(field, offset_s, factor_s);
        Ok(Some(match Conversion::of(file, &master.block)? {
            Conversion::None => line(0.0, 1.0),
            Conversion::Linear { offset, factor } => line(offset, factor),
            // Nothing but times in which a counter cannot be told from its meaning.
            other => Self { step_ns: None, curve: Some(Arc::new(other)), ..line(0.0, 1.0) },
        }))
    }

    fn new(field: Option<Field>, offset_s: f64, factor_s: f64) -> Self {
        let step_ns = (factor_s * NS_PER_S).round();
        let is_whole = step_ns >= 1.0 && (factor_s * NS_PER_S - step_ns).abs() < 1e-9 * step_ns;
        let step_ns = (is_whole && offset_s == 0.0).then_some(step_ns as i64);
        Self { field, offset_s, factor_s, step_ns, curve: None }
    }

    /// Where a counter is that needs nothing but to be multiplied, and by what; [`Self::ns`] is for the others, and for what is too large.
    pub(super) fn counter(&self, record_bytes: usize) -> Option<(Place, i64)> {
        Some((self.field.as_ref()?.counter(record_bytes)?, self.step_ns?))
    }

    /// Where a floating-point number of eight bytes is that counts; [`Self::ns_of`] says what it means.
    pub(super) fn float(&self, record_bytes: usize) -> Option<usize> {
        self.field.as_ref().filter(|_| self.curve.is_none())?.double(record_bytes)
    }

    /// Nanoseconds since the start of the measurement, from a number that is not counted exactly.
    #[inline]
    pub(super) fn ns_of(&self, raw: f64) -> Option<i64> {
        let ns = match (self.step_ns, &self.curve) {
            (Some(step_ns), _) => raw * step_ns as f64,
            (None, None) => (raw * self.factor_s + self.offset_s) * NS_PER_S,
            (None, Some(curve)) => curve.apply(Value::Float(raw))?.number()? * NS_PER_S,
        };
        (ns.abs() < 9e18).then(|| rounded(ns))
    }

    /// Nanoseconds since the start of the measurement.
    pub(super) fn ns(&self, record: &[u8], number: u64) -> Option<i64> {
        let integer = match &self.field {
            None => i64::try_from(number).ok(),
            Some(field) => field.signed(record),
        };
        if let (Some(integer), Some(step_ns)) = (integer, self.step_ns) {
            return integer.checked_mul(step_ns);
        }
        self.ns_of(integer.map(|integer| integer as f64).or_else(|| self.field?.float(record))?)
    }
}

/// As [`f64::round`], which is a call where not every processor of the kind has an instruction for it.
#[inline]
fn rounded(number: f64) -> i64 {
    let whole = number as i64;
    let rest = number - whole as f64;
    whole + i64::from(rest >= 0.5) - i64::from(rest <= -0.5)
}

#[cfg(test)]
mod tests {
    use super::rounded;
    use proptest::prelude::*;

    #[test]
    fn halves_are_rounded_away_from_zero() {
        for number in [
            0.0,
            -0.0,
            0.5,
            -0.5,
            0.499_999_999_999_999_94,
            -0.499_999_999_999_999_94,
            1.5,
            2.5,
            -2.5,
            8.9e18,
            -8.9e18,
        ] {
            assert_eq!(rounded(number), number.round() as i64, "{number}");
        }
    }

    proptest! {
        #[test]
        fn it_is_what_round_gives(number in -9e18..9e18, small in -1e6..1e6, of_halves in -1_000_000_i64..1_000_000) {
            for number in [number, small, of_halves as f64 / 2.0] {
                prop_assert_eq!(rounded(number), number.round() as i64);
            }
        }
    }
}
