//! Factor and offset as the decimal numbers in a file, so that seven times 0.1 is 0.7.

/// How raw values become physical ones.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scale {
    factor: f64,
    offset: f64,
    /// A power of ten by which both were multiplied; 1 if they are not short decimals.
    divisor: f64,
}

impl Scale {
    /// Finds integers and a power of ten that give factor and offset: 0.1 and −40 are 1 and −400 tenths. A single
    /// division then rounds once, to the float nearest to the decimal result; the error of a factor that is itself
    /// rounded would be multiplied.
    #[expect(clippy::float_cmp, reason = "the decimal must be the very same float")]
    pub fn of(factor: f64, offset: f64) -> Self {
        /// More decimals than occur in files. Powers of ten are exact up to the 22nd.
        const MOST_DECIMALS: u32 = 18;
        /// With more digits it is a truncated fraction such as 1/3, and products would lose digits.
        const LARGEST: f64 = 1e12;
        let mut divisor = 1.0;
        for _ in 0..=MOST_DECIMALS {
            let (whole_factor, whole_offset) = ((factor * divisor).round(), (offset * divisor).round());
            if whole_factor.abs() > LARGEST || whole_offset.abs() > LARGEST {
                break;
            }
            if whole_factor / divisor == factor && whole_offset / divisor == offset {
                return Self { factor: whole_factor, offset: whole_offset, divisor };
            }
            divisor *= 10.0;
        }
        Self::plain(factor, offset)
    }

    /// Only multiplies and adds: for floats, whose bits are not decimals either.
    pub fn plain(factor: f64, offset: f64) -> Self {
        Self { factor, offset, divisor: 1.0 }
    }

    /// The physical value.
    #[inline]
    #[expect(clippy::float_cmp, reason = "a power of ten is exact")]
    pub fn apply(self, unscaled: f64) -> f64 {
        let scaled = unscaled * self.factor + self.offset;
        if self.divisor == 1.0 { scaled } else { scaled / self.divisor }
    }

    /// Appends the physical value of each: [`Self::apply`] without checking the divisor each time.
    #[inline]
    #[expect(clippy::float_cmp, reason = "a power of ten is exact")]
    pub fn apply_all(self, unscaled: impl Iterator<Item = f64>, values: &mut Vec<f64>) {
        let Self { factor, offset, divisor } = self;
        if divisor == 1.0 {
            values.extend(unscaled.map(|unscaled| unscaled * factor + offset));
        } else {
            values.extend(unscaled.map(|unscaled| (unscaled * factor + offset) / divisor));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[expect(clippy::float_cmp, reason = "the very same float is the point")]
    fn decimals_come_out_as_they_would_be_written() {
        for (raw, factor, offset, expected) in [
            (7.0, 0.1, 0.0, 0.7),
            (2047.0, 0.1, 0.0, 204.7),
            (3.0, 0.1, -0.3, 0.0),
            (379_220_534.0, 1e-7, 0.0, 37.922_053_4),
            (9215.0, 0.5, 512.0, 5119.5),
            (3.0, -0.01, 40.05, 40.02),
            (1.0, 0.007_812_5, 0.0, 0.007_812_5),
        ] {
            assert_eq!(Scale::of(factor, offset).apply(raw), expected, "{raw} * {factor} + {offset}");
        }
        // Not a short decimal: computed in the plain way.
        let third = 1.0 / 3.0;
        assert_eq!(Scale::of(third, 0.0).apply(5.0), 5.0 * third);
        assert_eq!(Scale::of(1e300, 0.5).apply(2.0), 2e300);
    }
}
