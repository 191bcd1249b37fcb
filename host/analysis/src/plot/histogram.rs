//! Counts intervals by length, with bounded memory and without knowing the range in advance.

use std::collections::BTreeMap;

/// Maximum number of bins; if more are needed, they become twice as wide.
const MOST_BINS: usize = 2048;

/// The minimum width of a bar: most traces have whole microseconds.
const NARROWEST_NS: i64 = 1000;

/// Fraction of all intervals that the bars show; those farther out are only counted.
const SHOWN_SHARE: f64 = 0.998;

/// Counts of intervals by length. Bins start one nanosecond wide and widen as the range requires.
#[derive(Clone, Debug)]
pub struct Histogram {
    bin_ns: i64,
    counts: BTreeMap<i64, u64>,
    total: u64,
}

/// A bar of a histogram.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bar {
    /// Where it begins, in the unit of the axis.
    pub from: f64,
    /// Where it ends.
    pub to: f64,
    /// The count.
    pub count: u64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self { bin_ns: 1, counts: BTreeMap::new(), total: 0 }
    }
}

impl Histogram {
    /// Counts an interval of this many nanoseconds.
    pub fn add(&mut self, interval_ns: i64) {
        *self.counts.entry(interval_ns.div_euclid(self.bin_ns)).or_default() += 1;
        self.total += 1;
        while self.counts.len() > MOST_BINS {
            self.bin_ns *= 2;
            let mut wider = BTreeMap::new();
            for (bin, count) in &self.counts {
                *wider.entry(bin.div_euclid(2)).or_default() += count;
            }
            self.counts = wider;
        }
    }

    /// How many intervals were counted.
    pub fn total(&self) -> u64 {
        self.total
    }

    /// At most `most` bars of equal width, in milliseconds, and how many intervals lie outside them: with
    /// many intervals, the farthest 0.2 %.
    pub fn bars(&self, most: usize) -> (Vec<Bar>, u64) {
        let Some((first, last)) = self.shown_bins() else {
            return (Vec::new(), 0);
        };
        // Whole multiples of a bin, so that no bar covers more bins than its neighbour.
        let per_bar = ((last - first) / most.max(1) as i64 + 1).max(NARROWEST_NS / self.bin_ns).max(1);
        let bar_count = (last - first) / per_bar + 1;
        let mut counts = vec![0; bar_count as usize];
        for (bin, count) in self.counts.range(first..=last) {
            counts[((bin - first) / per_bar) as usize] += count;
        }
        let shown: u64 = counts.iter().sum();
        let ms = |bin: i64| (bin * self.bin_ns) as f64 / 1e6;
        let bars = counts.into_iter().zip(0..).map(|(count, bar)| Bar {
            from: ms(first + bar * per_bar),
            to: ms(first + (bar + 1) * per_bar),
            count,
        });
        (bars.collect(), self.total - shown)
    }

    /// First and last bin to show.
    fn shown_bins(&self) -> Option<(i64, i64)> {
        let outside = ((1.0 - SHOWN_SHARE) / 2.0 * self.total as f64) as u64;
        let beyond = |mut bins: Box<dyn Iterator<Item = (&i64, &u64)> + '_>| {
            let mut seen = 0;
            bins.find(|(_, count)| {
                seen += **count;
                seen > outside
            })
            .map(|(bin, _)| *bin)
        };
        Some((beyond(Box::new(self.counts.iter()))?, beyond(Box::new(self.counts.iter().rev()))?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_interval_is_in_a_bar_or_counted_outside() {
        let mut histogram = Histogram::default();
        for n in 0..100_000i64 {
            histogram.add(10_000_000 + n * 7919 % 200_000);
        }
        histogram.add(5_000_000_000);
        let (bars, outside) = histogram.bars(60);
        assert!(bars.len() <= 60 && bars.len() > 30, "{}", bars.len());
        assert_eq!(bars.iter().map(|bar| bar.count).sum::<u64>() + outside, histogram.total());
        assert!(outside <= 201 && bars.iter().all(|bar| bar.to < 10.3), "{outside} outside");
    }

    #[test]
    fn equal_intervals_are_one_bar() {
        let mut histogram = Histogram::default();
        (0..50).for_each(|_| histogram.add(58_000));
        let (bars, outside) = histogram.bars(40);
        assert_eq!((bars.len(), bars[0].count, outside), (1, 50, 0));
        assert!(bars[0].from <= 0.058 && bars[0].to > 0.058);
    }

    #[test]
    fn no_interval_is_no_bar() {
        assert_eq!(Histogram::default().bars(40), (Vec::new(), 0));
    }

    #[test]
    fn wild_intervals_stay_bounded() {
        let mut histogram = Histogram::default();
        for n in 0..10_000i64 {
            histogram.add(n.wrapping_mul(0x5DEE_CE66_D1CE_4E5B) >> 1);
        }
        assert!(histogram.counts.len() <= MOST_BINS);
        let (bars, outside) = histogram.bars(40);
        assert_eq!(bars.iter().map(|bar| bar.count).sum::<u64>() + outside, 10_000);
    }
}
