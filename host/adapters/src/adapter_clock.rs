//! Places an adapter's own stamps in this computer's time.
//!
//! A frame never arrives before it was stamped, and now and then it arrives almost at once: the adapter's clock is moved along the
//! earliest arrivals. The move is slow after the first second, so that the time between two frames stays the adapter's to within
//! [`MAX_SLEW_PPM`], which is what its crystal may be off by anyway.

use std::time::{Duration, Instant};

use cantap_wire::record::Stamp;

use crate::driver::At;

/// The fastest correction after the first second.
const MAX_SLEW_PPM: i128 = 500;
/// How long the correction is free.
const SETTLING_NS: i128 = 1_000_000_000;
/// The shortest delay is looked for over this time.
const WINDOW_NS: i128 = 2_000_000_000;
/// A stamp that contradicts its arrival by more than this belongs to a clock that was set, or started again.
const MAX_DISAGREEMENT_NS: i128 = 1_000_000_000;

/// The clock of one adapter.
pub(crate) struct AdapterClock {
    unit_ns: i128,
    /// Units after which stamps start again.
    period: i128,
    started: Instant,
    state: Option<State>,
}

#[derive(Clone, Copy)]
#[expect(clippy::struct_field_names, reason = "the unit is part of each name")]
struct State {
    /// Adapter time of the first stamp and of the last, unwrapped, in nanoseconds.
    first_ns: i128,
    last_ns: i128,
    /// Added to adapter time, this gives this computer's.
    offset_ns: i128,
    /// The shortest delay since `window_ns`.
    least_ns: i128,
    window_ns: i128,
}

impl AdapterClock {
    /// A clock with stamps in units of `unit_ns` that start again after `period` units.
    pub fn new(unit_ns: u32, period: u64) -> Self {
        Self { unit_ns: unit_ns.into(), period: period.into(), started: Instant::now(), state: None }
    }

    /// A clock to whose arrivals belong some from before now.
    #[cfg(test)]
    pub fn starting(self, started: Instant) -> Self {
        Self { started, ..self }
    }

    /// When a frame was stamped that arrived at `arrival`: never later than that. A stamp that cannot be believed is replaced by the arrival.
    pub fn place(&mut self, stamp: u64, arrival: Instant) -> At {
        let arrival_ns = arrival.saturating_duration_since(self.started).as_nanos() as i128;
        let raw_ns = i128::from(stamp) * self.unit_ns;
        let period_ns = self.period * self.unit_ns;
        let state = self.state.get_or_insert(State {
            first_ns: raw_ns,
            last_ns: raw_ns,
            offset_ns: arrival_ns - raw_ns,
            least_ns: i128::MAX,
            window_ns: raw_ns,
        });
        // Of all the times that the stamp can mean, the nearest to the arrival: nothing is assumed about how long it was silent.
        let expected_ns = arrival_ns - state.offset_ns;
        let rounds = (expected_ns - raw_ns + period_ns / 2).div_euclid(period_ns);
        let stamp_ns = raw_ns + rounds * period_ns;
        let delay_ns = expected_ns - stamp_ns;
        if delay_ns.abs() > MAX_DISAGREEMENT_NS {
            *state = State {
                first_ns: stamp_ns,
                last_ns: stamp_ns,
                offset_ns: arrival_ns - stamp_ns,
                least_ns: i128::MAX,
                window_ns: stamp_ns,
            };
            return At::arrival(arrival);
        }
        let settling = stamp_ns - state.first_ns < SETTLING_NS;
        let slew_ns =
            |passed_ns: i128| if settling { i128::MAX } else { passed_ns.max(0) * MAX_SLEW_PPM / 1_000_000 };
        state.least_ns = state.least_ns.min(delay_ns);
        if delay_ns < 0 {
            // It arrived before it was stamped: the clock is placed too late.
            let moved_ns = (-delay_ns).min(slew_ns(stamp_ns - state.last_ns));
            state.offset_ns -= moved_ns;
        } else if stamp_ns - state.window_ns >= WINDOW_NS {
            // Even the fastest took this long: the clock is placed too early.
            state.offset_ns += state.least_ns.clamp(0, WINDOW_NS * MAX_SLEW_PPM / 1_000_000);
            (state.least_ns, state.window_ns) = (i128::MAX, stamp_ns);
        }
        state.last_ns = state.last_ns.max(stamp_ns);
        let at_ns = (stamp_ns + state.offset_ns).clamp(0, arrival_ns);
        let instant = self.started + Duration::from_nanos(u64::try_from(at_ns).unwrap_or(0));
        At { instant, stamp: Stamp::Exact }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intervals_are_the_adapter_s_over_a_wrap_and_after_silence() {
        // Milliseconds that start again after a minute.
        let mut clock = AdapterClock::new(1_000_000, 60_000);
        let start = clock.started;
        let ms = Duration::from_millis;
        let first = clock.place(59_990, start + ms(105)).instant;
        let second = clock.place(10, start + ms(129)).instant;
        assert_eq!(second - first, ms(20));
        // Three and a half minutes of silence.
        let third = clock.place(30_010, start + ms(125) + ms(210_000)).instant;
        assert_eq!(third - first, ms(210_020));
    }

    #[test]
    fn the_earliest_arrival_places_the_clock_and_no_stamp_is_later_than_its_arrival() {
        let mut clock = AdapterClock::new(1_000, 1 << 32);
        let start = clock.started;
        let us = Duration::from_micros;
        // The first frame was 5 ms late, the next arrives at once.
        clock.place(1_000, start + us(10_000));
        assert_eq!(clock.place(2_000, start + us(6_000)).instant, start + us(6_000));
        assert_eq!(clock.place(3_000, start + us(9_500)).instant, start + us(7_000));
    }

    #[test]
    fn an_adapter_that_started_again_is_believed_anew() {
        let mut clock = AdapterClock::new(1_000, 1 << 32);
        let start = clock.started + Duration::from_secs(1);
        clock.place(500_000_000, start);
        let again = start + Duration::from_secs(10);
        assert_eq!(clock.place(20, again), At::arrival(again));
        assert_eq!(
            clock.place(1_020, again + Duration::from_millis(1)).instant,
            again + Duration::from_millis(1)
        );
    }
}
