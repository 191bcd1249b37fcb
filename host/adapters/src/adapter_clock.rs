//! Places an adapter's own stamps in this computer's time.
//!
//! A frame never arrives before it was stamped, and now and then it arrives almost at once: the adapter's clock is moved along the
//! earliest arrivals. The move is slow after the first second, so that the time between two frames stays the adapter's to within
//! [`MAX_SLEW_PPM`], which is what its crystal may be off by anyway. A clock that is off by more than any crystal, such as one whose prescaler is that of
//! another board, is found out, and not believed any more.

use std::time::{Duration, Instant};

use cantap_wire::record::Stamp;

use crate::driver::{At, Oddities};

/// The fastest correction after the first second.
const MAX_SLEW_PPM: i128 = 500;
/// How long the correction is free.
const SETTLING_NS: i128 = 1_000_000_000;
/// The shortest delay is looked for over this time.
const WINDOW_NS: i128 = 2_000_000_000;
/// A stamp that contradicts its arrival by more than this belongs to a clock that was set, or started again.
const MAX_DISAGREEMENT_NS: i128 = 1_000_000_000;
/// A stamp that is later than its arrival by this much is proof enough to move the clock at once.
const MAX_LEAD_NS: i128 = 20_000_000;
/// If even the shortest delay grows by this much in each of two windows, 1 %, the clock is slow, or what waits in the adapter grows without an end.
const MAX_GROWTH_NS: i128 = WINDOW_NS / 100;
const GROWING_WINDOWS: u32 = 2;
/// Of fewer stamps in a window the shortest delay says little: all of them may have been late.
const MIN_STAMPS: u32 = 100;
/// Stamps that have not grown for this long stand still, or go back: frames of one bus cannot.
const STANDS_STILL_NS: i128 = 20_000_000;

/// The clock of one adapter.
pub(crate) struct AdapterClock {
    unit_ns: i128,
    /// Units after which stamps start again.
    period: i128,
    started: Instant,
    state: Option<State>,
    /// The shortest delay in the window before, and in how many windows in a row it has grown too much.
    least_before_ns: Option<i128>,
    growing: u32,
}

#[derive(Clone, Copy)]
struct State {
    /// Adapter time of the first stamp and of the last, unwrapped, in nanoseconds.
    first_ns: i128,
    last_ns: i128,
    /// Added to adapter time, this gives this computer's.
    offset_ns: i128,
    /// The shortest delay since `window_ns`.
    least_ns: i128,
    window_ns: i128,
    /// Stamps since then.
    stamps: u32,
    /// When the last stamp arrived that was later than those before.
    grew_ns: i128,
}

impl AdapterClock {
    /// A clock with stamps in units of `unit_ns` that start again after `period` units.
    pub fn new(unit_ns: u32, period: u64) -> Self {
        Self {
            unit_ns: unit_ns.into(),
            period: period.into(),
            started: Instant::now(),
            state: None,
            least_before_ns: None,
            growing: 0,
        }
    }

    /// A clock to whose arrivals belong some from before now.
    #[cfg(test)]
    pub fn starting(self, started: Instant) -> Self {
        Self { started, ..self }
    }

    /// When a frame was stamped that arrived at `arrival`: never later than that. A stamp that cannot be believed is replaced by the arrival, and counted.
    pub fn place(&mut self, stamp: u64, arrival: Instant, oddities: &mut Oddities) -> At {
        if self.growing >= GROWING_WINDOWS {
            oddities.count("stamps of a clock that is off by a hundredth or more");
            return At::arrival(arrival);
        }
        let arrival_ns = arrival.saturating_duration_since(self.started).as_nanos() as i128;
        let raw_ns = i128::from(stamp) * self.unit_ns;
        let period_ns = self.period * self.unit_ns;
        let state = self.state.get_or_insert(State {
            first_ns: raw_ns,
            last_ns: raw_ns,
            offset_ns: arrival_ns - raw_ns,
            least_ns: i128::MAX,
            window_ns: raw_ns,
            stamps: 0,
            grew_ns: arrival_ns,
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
                stamps: 0,
                grew_ns: arrival_ns,
            };
            oddities.count("stamps that contradict their arrival by more than a second");
            return At::arrival(arrival);
        }
        if stamp_ns > state.last_ns {
            state.grew_ns = arrival_ns;
        } else if arrival_ns - state.grew_ns > STANDS_STILL_NS.max(2 * self.unit_ns) {
            oddities.count("stamps that stand still or go back");
            return At::arrival(arrival);
        }
        let settling = stamp_ns - state.first_ns < SETTLING_NS;
        let slew_ns =
            |passed_ns: i128| if settling { i128::MAX } else { passed_ns.max(0) * MAX_SLEW_PPM / 1_000_000 };
        state.least_ns = state.least_ns.min(delay_ns);
        state.stamps = state.stamps.saturating_add(1);
        if delay_ns < 0 {
            // It arrived before it was stamped: the clock is placed too late.
            let slew_ns = if -delay_ns > MAX_LEAD_NS { i128::MAX } else { slew_ns(stamp_ns - state.last_ns) };
            state.offset_ns -= (-delay_ns).min(slew_ns);
        } else if stamp_ns - state.window_ns >= WINDOW_NS {
            // Even the fastest took this long: the clock is placed too early.
            let moved_ns = state.least_ns.clamp(0, WINDOW_NS * MAX_SLEW_PPM / 1_000_000);
            let grows = self.least_before_ns.is_some_and(|before| state.least_ns - before > MAX_GROWTH_NS)
                && state.stamps >= MIN_STAMPS;
            self.growing = if grows { self.growing + 1 } else { 0 };
            self.least_before_ns = Some(state.least_ns);
            state.offset_ns += moved_ns;
            (state.least_ns, state.window_ns, state.stamps) = (i128::MAX, stamp_ns, 0);
        }
        state.last_ns = state.last_ns.max(stamp_ns);
        let at_ns = (stamp_ns + state.offset_ns).max(0);
        if at_ns > arrival_ns {
            return At::arrival(arrival);
        }
        let instant = self.started + Duration::from_nanos(u64::try_from(at_ns).unwrap_or(0));
        At { instant, stamp: Stamp::Exact }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(clock: &mut AdapterClock, stamp: u64, arrival: Instant) -> At {
        clock.place(stamp, arrival, &mut Oddities::default())
    }

    #[test]
    fn intervals_are_the_adapter_s_over_a_wrap_and_after_silence() {
        // Milliseconds that start again after a minute.
        let mut clock = AdapterClock::new(1_000_000, 60_000);
        let start = clock.started;
        let ms = Duration::from_millis;
        let first = place(&mut clock, 59_990, start + ms(105)).instant;
        let second = place(&mut clock, 10, start + ms(129)).instant;
        assert_eq!(second - first, ms(20));
        // Three and a half minutes of silence.
        let third = place(&mut clock, 30_010, start + ms(125) + ms(210_000)).instant;
        assert_eq!(third - first, ms(210_020));
    }

    #[test]
    fn the_earliest_arrival_places_the_clock_and_no_stamp_is_later_than_its_arrival() {
        let mut clock = AdapterClock::new(1_000, 1 << 32);
        let start = clock.started;
        let us = Duration::from_micros;
        // The first frame was 5 ms late, the next arrives at once.
        place(&mut clock, 1_000, start + us(10_000));
        assert_eq!(place(&mut clock, 2_000, start + us(6_000)).instant, start + us(6_000));
        assert_eq!(place(&mut clock, 3_000, start + us(9_500)).instant, start + us(7_000));
    }

    #[test]
    fn an_adapter_that_started_again_is_believed_anew() {
        let mut clock = AdapterClock::new(1_000, 1 << 32);
        let start = clock.started + Duration::from_secs(1);
        place(&mut clock, 500_000_000, start);
        let again = start + Duration::from_secs(10);
        assert_eq!(place(&mut clock, 20, again), At::arrival(again));
        assert_eq!(
            place(&mut clock, 1_020, again + Duration::from_millis(1)).instant,
            again + Duration::from_millis(1)
        );
    }

    /// candleLight's board with an F407 counts 96 cycles of 84 MHz for a microsecond. One that is fast is never ahead of its arrivals by much.
    #[test]
    fn a_clock_that_is_off_by_more_than_a_crystal_is_not_believed_for_long() {
        let us = Duration::from_micros;
        let mut clock = AdapterClock::new(1_000, 1 << 32);
        let (start, mut oddities) = (clock.started, Oddities::default());
        let mut worst = Duration::ZERO;
        for number in 0..40_000 {
            let arrival = start + us(number * 1_000);
            let at = clock.place(number * 875, arrival, &mut oddities);
            worst = worst.max(arrival - at.instant);
            assert!(number < 8_000 || at == At::arrival(arrival), "{number}");
        }
        assert!(worst < Duration::from_secs(1), "{worst:?}");
        assert!(oddities.summary().1.contains("off by a hundredth"), "{}", oddities.summary().1);
        let mut fast = AdapterClock::new(1_000, 1 << 32);
        let (start, mut oddities) = (fast.started, Oddities::default());
        for number in 0..40_000 {
            let arrival = start + us(number * 1_000);
            let at = fast.place(number * 1_143, arrival, &mut oddities);
            assert!(at.instant <= arrival && arrival - at.instant < us(1), "{number}");
        }
    }

    /// An adapter behind a slow line falls behind by 800 ms within seconds and stays there: its stamps are right, and its arrivals late.
    #[test]
    fn what_waits_in_the_adapter_once_is_no_fault_of_its_clock() {
        let mut clock = AdapterClock::new(1_000, 1 << 32);
        let (start, mut oddities) = (clock.started, Oddities::default());
        for number in 0..30_000_u64 {
            let late = Duration::from_millis(number.saturating_sub(4_000).min(400) * 2);
            let stamped = start + Duration::from_millis(number);
            let at = clock.place(number * 1_000, stamped + late, &mut oddities);
            let off = at.instant.saturating_duration_since(stamped);
            assert!(at.stamp == Stamp::Exact && off < Duration::from_millis(20), "{number}: {off:?}");
        }
        assert_eq!(oddities.summary().0, 0, "{}", oddities.summary().1);
    }

    /// A clock that stands still, and one that goes back: frames keep their order and the times of their arrivals, which are marked as such.
    #[test]
    fn stamps_that_do_not_grow_are_not_believed_for_long() {
        let ms = Duration::from_millis;
        for stamp_at in [(|_| 700) as fn(u64) -> u64, |number| 100_000 - number] {
            let mut clock = AdapterClock::new(1_000, 1 << 32);
            let (start, mut oddities) = (clock.started, Oddities::default());
            for number in 0..500 {
                let arrival = start + ms(number);
                let at = clock.place(stamp_at(number), arrival, &mut oddities);
                assert!(at.instant <= arrival && arrival - at.instant <= ms(21), "{number}");
                assert!(number <= 20 || at == At::arrival(arrival), "{number}");
            }
            assert_eq!(oddities.summary(), (479, "479 stamps that stand still or go back".to_owned()));
        }
    }
}
