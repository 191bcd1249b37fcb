//! How busy a bus is between two frames: the work load of the earlier CANanalyser.

/// The work load of one channel, as the earlier analyser defined it: frame time plus intermission, over the
/// time between two arrivals.
#[derive(Clone, Debug)]
pub struct WorkLoad {
    bitrate_bps: u32,
    previous_ns: Option<i64>,
    instant_pct: Option<f64>,
    instant_max_pct: Option<f64>,
    bits: f64,
    span_ns: u64,
}

impl WorkLoad {
    /// Nothing has been seen yet. `bitrate_bps` must not be zero; zero is treated as 1.
    pub fn new(bitrate_bps: u32) -> Self {
        Self {
            bitrate_bps: bitrate_bps.max(1),
            previous_ns: None,
            instant_pct: None,
            instant_max_pct: None,
            bits: 0.0,
            span_ns: 0,
        }
    }

    /// Takes a frame that ended at `end_ns` and lasted this many bit times, including intermission: bits at the nominal rate, and the
    /// equivalent number of nominal bits for an FD frame's data phase.
    #[inline]
    pub fn frame(&mut self, end_ns: i64, bit_times: f64) {
        if let Some(previous) = self.previous_ns.replace(end_ns)
            && let Ok(interval) = u64::try_from(end_ns.saturating_sub(previous))
        {
            // If stamps are coarse, frames share one: together they took the interval before or after them.
            self.bits += bit_times;
            if interval == 0 {
                return;
            }
            let instant = self.share(bit_times, interval);
            self.instant_pct = Some(instant);
            self.instant_max_pct = Some(self.instant_max_pct.map_or(instant, |max| max.max(instant)));
            // A file may contain any times.
            self.span_ns = self.span_ns.saturating_add(interval);
        }
    }

    /// Frames are missing here: the interval that spans them is meaningless and left out.
    pub fn gap(&mut self) {
        self.previous_ns = None;
        self.instant_pct = None;
    }

    /// Load of the last frame over its interval, in per cent; `None` before the second frame and after a gap.
    /// Never above 100: a late stamp makes the next interval too short.
    pub fn instant_pct(&self) -> Option<f64> {
        self.instant_pct
    }

    /// The largest [`Self::instant_pct`] so far.
    pub fn instant_max_pct(&self) -> Option<f64> {
        self.instant_max_pct
    }

    /// Load over all intervals, in per cent; `None` before the second frame.
    pub fn mean_pct(&self) -> Option<f64> {
        (self.span_ns > 0).then(|| self.share(self.bits, self.span_ns))
    }

    fn share(&self, bits: f64, span_ns: u64) -> f64 {
        let share = bits * 1e11 / (f64::from(self.bitrate_bps) * span_ns as f64);
        share.min(100.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn back_to_back_frames_measured_a_timer_tick_apart_give_the_golden_work_load() {
        let mut load = WorkLoad::new(1_000_000);
        for n in 0..10 {
            load.frame(n * 58_125, 58.0);
        }
        let golden = 100.0 * 58.0 / 58.125;
        assert!((load.instant_pct().unwrap() - golden).abs() < 1e-9);
        assert!((load.mean_pct().unwrap() - golden).abs() < 1e-9);
        assert_eq!(format!("{:.3}", load.mean_pct().unwrap()), "99.785");
    }

    #[test]
    fn bursts_of_five_every_1919_us_give_the_golden_mean() {
        let mut load = WorkLoad::new(1_000_000);
        for burst in 0..2000 {
            for frame in 0..5 {
                load.frame(burst * 1_919_600 + frame * 58_000, 58.0);
            }
        }
        // The first frame has no interval before it, so the mean converges from above.
        assert_eq!(format!("{:.1}", load.mean_pct().unwrap()), "15.1");
        assert!((load.instant_pct().unwrap() - 100.0).abs() < 1e-9);
    }

    #[test]
    fn the_work_load_never_passes_100_and_leaves_gaps_out() {
        let mut load = WorkLoad::new(1_000_000);
        load.frame(0, 58.0);
        assert_eq!(load.instant_pct(), None);
        load.frame(40_000, 58.0);
        assert_eq!(load.instant_pct(), Some(100.0));
        load.gap();
        load.frame(10_000_000, 58.0);
        assert_eq!(load.instant_pct(), None);
        load.frame(10_116_000, 58.0);
        assert_eq!(load.instant_pct(), Some(50.0));
        // A stamp that does not advance gives no interval.
        load.frame(10_116_000, 58.0);
        assert_eq!(load.instant_pct(), Some(50.0));
    }

    #[test]
    fn coarse_stamps_change_the_mean_work_load_by_no_more_than_its_ends() {
        let mut load = WorkLoad::new(1_000_000);
        for n in 0..17_241 {
            // Back to back for a second, stamped every millisecond.
            load.frame((n * 58_000) / 1_000_000 * 1_000_000, 58.0);
        }
        assert!((load.mean_pct().unwrap() - 100.0).abs() < 0.2, "{:?}", load.mean_pct());
    }
}
