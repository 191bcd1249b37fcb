//! Time since a trace began, whatever the recorder's clock did.

/// A clock that goes back by more than this was set; less is another order of records.
const SET_BACK_NS: i64 = 100_000_000;
/// A longer silence on all channels is an interruption of the recording, not of the bus.
const INTERRUPTED_NS: i64 = 60_000_000_000;

/// Time since the first frame.
#[derive(Clone, Copy, Debug, Default)]
pub struct Clock {
    last_ns: Option<i64>,
    elapsed_ns: u64,
}

impl Clock {
    /// The time since the first frame in nanoseconds, which never goes back, and whether the clock jumped: the time of a jump does not count.
    pub fn advance(&mut self, time_ns: i64) -> (u64, bool) {
        let Some(last_ns) = self.last_ns else {
            self.last_ns = Some(time_ns);
            return (0, false);
        };
        let passed_ns = time_ns.saturating_sub(last_ns);
        match passed_ns {
            ..=-1 if passed_ns >= -SET_BACK_NS => (self.elapsed_ns, false),
            0..=INTERRUPTED_NS => {
                self.last_ns = Some(time_ns);
                self.elapsed_ns += passed_ns.unsigned_abs();
                (self.elapsed_ns, false)
            }
            _ => {
                self.last_ns = Some(time_ns);
                (self.elapsed_ns, true)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_that_is_set_jumps_and_its_time_goes_on_from_there() {
        let mut clock = Clock::default();
        let mut at = |time_ns| clock.advance(time_ns);
        assert_eq!(at(5_000), (0, false));
        assert_eq!(at(6_000), (1_000, false));
        // Records of two channels in the wrong order.
        assert_eq!(at(5_500), (1_000, false));
        assert_eq!(at(7_000), (2_000, false));
        assert_eq!(at(1_000_000_000_000_000_000), (2_000, true));
        assert_eq!(at(1_000_000_000_000_001_000), (3_000, false));
        assert_eq!(at(i64::MIN), (3_000, true));
        assert_eq!(at(i64::MAX), (3_000, true));
    }
}
