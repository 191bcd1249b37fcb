//! Plays a trace back: its records are handed out when they are due, at any speed.
//!
//! It has no clock and never waits: the caller passes the time, and gets the records that are due by then, or
//! how long to sleep. So the same engine drives the live view and tests.

use std::time::Duration;

use crate::TraceRecord;

/// The delay factors that [`Playback::faster`] and [`Playback::slower`] step through: real time is 1, more
/// is slow motion.
const FACTORS: [f64; 16] =
    [0.0, 0.001, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 1000.0];

/// The slowest speed that can be set.
const MOST_FACTOR: f64 = 1e6;

/// When gaps are skipped, a longer pause in the trace is shortened to this length.
const SKIPPED_TO: Duration = Duration::from_secs(1);

/// What to do now.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Due {
    /// This record is due.
    Record(TraceRecord),
    /// Nothing is due for this long.
    Wait(Duration),
    /// Paused: nothing is due before [`Playback::resume`], [`Playback::step`] or the like.
    Paused,
    /// The trace has ended and does not loop.
    Ended,
}

/// Plays a trace. `open` opens it, again for each round of the loop.
pub struct Playback<O, I> {
    open: O,
    records: I,
    next: Option<TraceRecord>,
    /// The time in the trace that [`Self::anchor_at`] corresponds to.
    anchor_trace_ns: i64,
    /// The caller's time that [`Self::anchor_trace_ns`] corresponds to.
    anchor_at: Duration,
    factor: f64,
    paused: bool,
    /// Number of records to hand out although paused.
    steps: u64,
    looped: bool,
    skips_gaps: bool,
    /// Number of rounds played to the end.
    rounds: u64,
    last_ns: Option<i64>,
}

impl<O, I, E> Playback<O, I>
where
    O: FnMut() -> Result<I, E>,
    I: Iterator<Item = TraceRecord>,
{
    /// Opens the trace and plays it in real time from `now` on. Times are the caller's, from any clock that
    /// goes forward.
    pub fn new(mut open: O, now: Duration) -> Result<Self, E> {
        let mut records = open()?;
        let next = records.next();
        Ok(Self {
            open,
            records,
            anchor_trace_ns: next.map_or(0, |record| record.time_ns),
            next,
            anchor_at: now,
            factor: 1.0,
            paused: false,
            steps: 0,
            looped: false,
            skips_gaps: false,
            rounds: 0,
            last_ns: None,
        })
    }

    /// What is due at `now`. Called repeatedly, it hands out every record once and in order.
    pub fn poll(&mut self, now: Duration) -> Result<Due, E> {
        let Some(record) = self.next else {
            if !self.looped || self.last_ns.is_none() {
                return Ok(Due::Ended);
            }
            self.start_over(now)?;
            return Ok(self.poll_next(now));
        };
        if self.steps > 0 {
            self.steps -= 1;
            self.take(record);
            // Whatever follows is due as if this one had been on time.
            self.anchor(record.time_ns, now);
            return Ok(Due::Record(record));
        }
        Ok(self.poll_next(now))
    }

    fn poll_next(&mut self, now: Duration) -> Due {
        let Some(record) = self.next else {
            return Due::Ended;
        };
        if self.paused {
            return Due::Paused;
        }
        // The trace must not stall where its clock was set back or ahead.
        let ahead = record.time_ns.saturating_sub(self.last_ns.unwrap_or(self.anchor_trace_ns));
        if ahead < 0 || (self.skips_gaps && ahead > SKIPPED_TO.as_nanos() as i64) {
            let wait = if ahead < 0 { 0 } else { SKIPPED_TO.as_nanos() as i64 };
            let position = self.position_ns(now).max(self.last_ns.unwrap_or(i64::MIN));
            let played_since = position.saturating_sub(self.last_ns.unwrap_or(position)).clamp(0, wait);
            self.anchor(record.time_ns.saturating_sub(wait - played_since), now);
            self.last_ns = Some(self.anchor_trace_ns);
        }
        let due = self.due_at(record.time_ns);
        if due <= now {
            self.take(record);
            return Due::Record(record);
        }
        Due::Wait(due.saturating_sub(now))
    }

    fn take(&mut self, record: TraceRecord) {
        self.last_ns = Some(record.time_ns);
        self.next = self.records.next();
        if self.next.is_none() {
            self.rounds += 1;
        }
    }

    /// When a record with this trace time is due.
    fn due_at(&self, trace_ns: i64) -> Duration {
        let ahead = trace_ns.saturating_sub(self.anchor_trace_ns).max(0) as f64;
        // A trace of centuries in slow motion exceeds a Duration.
        let ahead = Duration::try_from_secs_f64(ahead * self.factor / 1e9).unwrap_or(Duration::MAX);
        self.anchor_at.saturating_add(ahead)
    }

    fn anchor(&mut self, trace_ns: i64, now: Duration) {
        self.anchor_trace_ns = trace_ns;
        self.anchor_at = now;
    }

    /// The trace's time at `now`, in nanoseconds as in [`TraceRecord::time_ns`]; never later than the next
    /// record to be handed out.
    pub fn position_ns(&self, now: Duration) -> i64 {
        let limit =
            self.next.map_or(self.last_ns, |record| Some(record.time_ns)).unwrap_or(self.anchor_trace_ns);
        if self.paused {
            return self.anchor_trace_ns.min(limit);
        }
        if self.factor == 0.0 {
            return self.last_ns.unwrap_or(self.anchor_trace_ns);
        }
        let played = now.saturating_sub(self.anchor_at).as_nanos() as f64 / self.factor;
        self.anchor_trace_ns.saturating_add(played as i64).min(limit)
    }

    /// Starts the trace again, as at the end in a loop.
    pub fn start_over(&mut self, now: Duration) -> Result<(), E> {
        self.records = (self.open)()?;
        self.next = self.records.next();
        self.last_ns = None;
        self.anchor(self.next.map_or(0, |record| record.time_ns), now);
        Ok(())
    }

    /// The delay factor: 1 is real time, 2 takes twice as long, 0 is as fast as possible.
    pub fn factor(&self) -> f64 {
        self.factor
    }

    /// Sets the delay factor from `now` on; it is limited to between 0 and a million. NaN changes nothing.
    pub fn set_factor(&mut self, factor: f64, now: Duration) {
        if !factor.is_nan() {
            let position = self.position_ns(now);
            self.factor = factor.clamp(0.0, MOST_FACTOR);
            self.anchor(position, now);
        }
    }

    /// One step faster.
    pub fn faster(&mut self, now: Duration) {
        let factor = FACTORS.into_iter().rev().find(|factor| *factor < self.factor).unwrap_or(0.0);
        self.set_factor(factor, now);
    }

    /// One step slower.
    pub fn slower(&mut self, now: Duration) {
        let factor = FACTORS.into_iter().find(|factor| *factor > self.factor).unwrap_or(self.factor);
        self.set_factor(factor, now);
    }

    /// Whether it is paused.
    pub fn is_paused(&self) -> bool {
        self.paused
    }

    /// Stops the trace's time.
    pub fn pause(&mut self, now: Duration) {
        if !self.paused {
            let position = self.position_ns(now);
            self.anchor(position, now);
            self.paused = true;
        }
    }

    /// Lets the trace's time continue from where it stopped.
    pub fn resume(&mut self, now: Duration) {
        if self.paused {
            self.anchor(self.anchor_trace_ns, now);
            self.paused = false;
            self.steps = 0;
        }
    }

    /// Pauses and hands out the next record immediately.
    pub fn step(&mut self, now: Duration) {
        self.pause(now);
        self.steps += 1;
    }

    /// For skipping to another place: hands out the next record immediately if it is older than a time, whatever the speed.
    /// `None` once that time is reached; what follows is due as if it had been reached by playing.
    pub fn forward_to(&mut self, time_ns: i64, now: Duration) -> Option<TraceRecord> {
        if let Some(record) = self.next.filter(|record| record.time_ns < time_ns) {
            self.take(record);
            return Some(record);
        }
        let limit = self.next.map(|record| record.time_ns).or(self.last_ns);
        self.anchor(limit.map_or(time_ns, |limit_ns| limit_ns.min(time_ns)), now);
        None
    }

    /// Whether the trace starts again after its end.
    pub fn is_looped(&self) -> bool {
        self.looped
    }

    /// Sets whether the trace starts again after its end.
    pub fn set_looped(&mut self, looped: bool) {
        self.looped = looped;
    }

    /// Sets whether pauses of more than a second are shortened to a second.
    pub fn set_skips_gaps(&mut self, skips: bool) {
        self.skips_gaps = skips;
    }

    /// Number of rounds played to the end.
    pub fn rounds(&self) -> u64 {
        self.rounds
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::TraceEvent;
    use std::convert::Infallible;

    const MS: i64 = 1_000_000;

    fn at(ms: i64) -> TraceRecord {
        TraceRecord {
            time_ns: 1_000_000_000_000 + ms * MS,
            device_ns: None,
            channel: 1,
            event: TraceEvent::ErrorsSuppressed { count: 1 },
        }
    }

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    fn playing(
        times_ms: &[i64],
    ) -> Playback<
        impl FnMut() -> Result<std::vec::IntoIter<TraceRecord>, Infallible> + use<>,
        std::vec::IntoIter<TraceRecord>,
    > {
        let records: Vec<_> = times_ms.iter().copied().map(at).collect();
        Playback::new(move || Ok(records.clone().into_iter()), ms(500)).unwrap()
    }

    /// The times, in milliseconds of the trace, of the records that are due; then what to do next.
    fn due<O, I>(playback: &mut Playback<O, I>, now: u64) -> (Vec<i64>, Due)
    where
        O: FnMut() -> Result<I, Infallible>,
        I: Iterator<Item = TraceRecord>,
    {
        let mut times = Vec::new();
        loop {
            match playback.poll(ms(now)).unwrap() {
                Due::Record(record) => times.push((record.time_ns - at(0).time_ns) / MS),
                other => return (times, other),
            }
            assert!(times.len() < 1000, "it never waits");
        }
    }

    #[test]
    fn records_come_at_their_own_distances() {
        let mut playback = playing(&[0, 10, 30]);
        assert_eq!(due(&mut playback, 500), (vec![0], Due::Wait(ms(10))));
        assert_eq!(due(&mut playback, 509), (vec![], Due::Wait(ms(1))));
        assert_eq!(due(&mut playback, 530), (vec![10, 30], Due::Ended));
    }

    #[test]
    fn a_factor_above_one_is_slow_motion_and_zero_does_not_wait() {
        let mut playback = playing(&[0, 10, 30, 1000]);
        playback.set_factor(2.0, ms(500));
        assert_eq!(due(&mut playback, 519), (vec![0], Due::Wait(ms(1))));
        assert_eq!(due(&mut playback, 520), (vec![10], Due::Wait(ms(40))));
        playback.set_factor(0.0, ms(521));
        assert_eq!(due(&mut playback, 521), (vec![30, 1000], Due::Ended));
    }

    #[test]
    fn a_change_of_speed_keeps_the_place() {
        let mut playback = playing(&[0, 100]);
        assert_eq!(due(&mut playback, 550), (vec![0], Due::Wait(ms(50))));
        playback.slower(ms(550));
        assert!((playback.factor() - 2.0).abs() < 1e-12);
        assert_eq!(due(&mut playback, 550).1, Due::Wait(ms(100)));
        playback.faster(ms(600));
        playback.faster(ms(600));
        assert!((playback.factor() - 0.5).abs() < 1e-12);
        assert_eq!(due(&mut playback, 600).1, Due::Wait(Duration::from_micros(12_500)));
    }

    #[test]
    fn a_pause_stops_time_and_resuming_goes_on_there() {
        let mut playback = playing(&[0, 10, 30]);
        assert_eq!(due(&mut playback, 504).0, [0]);
        playback.pause(ms(504));
        assert_eq!(due(&mut playback, 9000), (vec![], Due::Paused));
        playback.resume(ms(9000));
        assert_eq!(due(&mut playback, 9000), (vec![], Due::Wait(ms(6))));
        assert_eq!(due(&mut playback, 9006), (vec![10], Due::Wait(ms(20))));
    }

    #[test]
    fn a_step_hands_out_one_record_and_stays_paused() {
        let mut playback = playing(&[0, 10, 30]);
        playback.step(ms(500));
        assert_eq!(due(&mut playback, 500), (vec![0], Due::Paused));
        playback.step(ms(600));
        assert_eq!(due(&mut playback, 600), (vec![10], Due::Paused));
        playback.resume(ms(700));
        assert_eq!(due(&mut playback, 700), (vec![], Due::Wait(ms(20))));
    }

    #[test]
    fn a_loop_begins_anew_and_an_empty_trace_ends() {
        let mut playback = playing(&[0, 10]);
        playback.set_looped(true);
        assert_eq!(due(&mut playback, 509).0, [0]);
        assert_eq!(due(&mut playback, 510), (vec![10, 0], Due::Wait(ms(10))));
        assert_eq!((due(&mut playback, 520).0, playback.rounds()), (vec![10, 0], 2));
        let mut empty = playing(&[]);
        empty.set_looped(true);
        assert_eq!(due(&mut empty, 500), (vec![], Due::Ended));
    }

    #[test]
    fn a_clock_that_was_set_back_does_not_stop_it() {
        let mut playback = playing(&[5000, 5010, 0, 10]);
        assert_eq!(due(&mut playback, 510), (vec![5000, 5010, 0], Due::Wait(ms(10))));
        assert_eq!(due(&mut playback, 520), (vec![10], Due::Ended));
    }

    #[test]
    fn long_gaps_are_cut_to_a_second_if_asked_for() {
        let mut playback = playing(&[0, 3_600_000]);
        playback.set_skips_gaps(true);
        assert_eq!(due(&mut playback, 500), (vec![0], Due::Wait(ms(1000))));
        assert_eq!(due(&mut playback, 1499), (vec![], Due::Wait(ms(1))));
        assert_eq!(due(&mut playback, 1500), (vec![3_600_000], Due::Ended));
    }

    #[test]
    fn another_place_is_reached_at_once_and_from_there_it_goes_on_in_time() {
        let mut playback = playing(&[0, 10, 30, 100, 200]);
        assert_eq!(due(&mut playback, 500).0, [0]);
        playback.pause(ms(500));
        let mut times = Vec::new();
        while let Some(record) = playback.forward_to(at(50).time_ns, ms(510)) {
            times.push((record.time_ns - at(0).time_ns) / MS);
        }
        assert_eq!((times, playback.position_ns(ms(510))), (vec![10, 30], at(50).time_ns));
        assert_eq!(due(&mut playback, 900), (vec![], Due::Paused));
        playback.resume(ms(1000));
        assert_eq!(due(&mut playback, 1000), (vec![], Due::Wait(ms(50))));
        assert_eq!(due(&mut playback, 1050), (vec![100], Due::Wait(ms(100))));
        // Skipping past the end leads to the end.
        while playback.forward_to(at(9999).time_ns, ms(1060)).is_some() {}
        assert_eq!(
            (playback.position_ns(ms(1060)), due(&mut playback, 1060).1),
            (at(200).time_ns, Due::Ended)
        );
    }

    #[test]
    fn the_position_is_between_the_last_record_and_the_next() {
        let mut playback = playing(&[0, 10]);
        assert_eq!(due(&mut playback, 504).0, [0]);
        assert_eq!(playback.position_ns(ms(504)), at(4).time_ns);
        assert_eq!(playback.position_ns(ms(5000)), at(10).time_ns);
    }

    #[test]
    fn what_was_switched_on_is_said() {
        let mut playback = playing(&[0, 10]);
        assert!(!playback.is_paused() && !playback.is_looped());
        playback.pause(ms(500));
        playback.set_looped(true);
        assert!(playback.is_paused() && playback.is_looped());
        playback.resume(ms(600));
        playback.set_looped(false);
        assert!(!playback.is_paused() && !playback.is_looped());
    }

    #[test]
    fn a_place_is_reached_before_its_own_record() {
        let mut playback = playing(&[0, 10, 20]);
        let mut times = Vec::new();
        while let Some(record) = playback.forward_to(at(10).time_ns, ms(500)) {
            times.push((record.time_ns - at(0).time_ns) / MS);
        }
        assert_eq!(times, [0]);
        assert_eq!(due(&mut playback, 500), (vec![10], Due::Wait(ms(10))));
    }
}
