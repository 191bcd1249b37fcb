//! Which records a client receives, and what it counts.

use std::fmt::Write;
use std::time::{Duration, Instant};

use cantap::{Direction, TraceEvent, TraceRecord};

use super::messages::{put_error, put_frame};
use super::subscriptions::Subscriptions;
use crate::own_frames::OwnFrames;
use crate::text::now_ns;

/// What a client receives, by its mode.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Hears {
    /// BCM mode, in which every bus is opened.
    #[default]
    Subscribed,
    /// Raw mode.
    All,
    /// Control mode.
    Nothing,
}

/// What a client receives.
#[derive(Default)]
pub struct Hearing {
    pub hears: Hears,
    /// Nothing before this time.
    from: Option<Instant>,
    pub subscriptions: Subscriptions,
    /// What it has sent: a client does not receive its own frames.
    pub own: OwnFrames,
    /// It was off the bus for a moment.
    pub has_gap: bool,
    /// It has said what it wants since it opened its bus. Before that, it compares what it reads with an answer that it waits for.
    pub has_chosen: bool,
    statistics: Statistics,
}

#[derive(Default)]
struct Statistics {
    every: Duration,
    told_at: Option<Instant>,
    received_bytes: u64,
    received: u64,
    sent_bytes: u64,
    sent: u64,
}

impl Hearing {
    /// Changes the mode. This ends the subscriptions of BCM mode.
    pub fn begin(&mut self, hears: Hears, from: Instant) {
        self.hears = hears;
        self.from = Some(from);
        self.has_chosen = true;
        self.subscriptions.clear();
    }

    /// Nothing more is told until the client has the answer to a change of mode.
    pub fn hold(&mut self) {
        self.has_chosen = false;
        self.hears = Hears::Subscribed;
        self.subscriptions.clear();
    }

    /// Sends statistics at this interval from now on; never if it is zero.
    pub fn statistics_every(&mut self, every: Duration) {
        self.statistics.every = every;
        self.statistics.told_at = Some(Instant::now());
    }

    /// For how long nothing may be passed on.
    pub fn wait(&self) -> Option<Duration> {
        let wait = self.from?.saturating_duration_since(Instant::now());
        (!wait.is_zero()).then_some(wait)
    }

    /// Takes records, and adds what the client receives.
    pub fn take(&mut self, records: &[TraceRecord], out: &mut String) {
        for record in records {
            if self.tells_errors() && std::mem::take(&mut self.has_gap) {
                put_error(out, record.time_ns, &TraceEvent::GAP);
            }
            self.take_one(record, out);
        }
        // On a bus that has fallen silent, no record gives the time.
        if self.hears == Hears::Subscribed {
            self.put_ripe(now_ns(), out);
        }
        self.put_statistics(out);
    }

    fn take_one(&mut self, record: &TraceRecord, out: &mut String) {
        let time_ns = record.time_ns;
        self.put_ripe(time_ns, out);
        match &record.event {
            TraceEvent::Frame { frame, direction, .. } => {
                let Some(frame) = frame.classic() else { return };
                let bytes = frame.data().len() as u64;
                if *direction == Direction::Tx && self.own.take(*frame) {
                    self.statistics.sent += 1;
                    self.statistics.sent_bytes += bytes;
                    return;
                }
                self.statistics.received += 1;
                self.statistics.received_bytes += bytes;
                match self.hears {
                    Hears::All => put_frame(out, time_ns, frame, true),
                    Hears::Subscribed => {
                        if let Some((time_ns, frame)) = self.subscriptions.take(time_ns, frame) {
                            put_frame(out, time_ns, &frame, false);
                        }
                    }
                    Hears::Nothing => {}
                }
            }
            event => {
                self.own.event(event);
                if self.tells_errors() {
                    put_error(out, time_ns, event);
                }
            }
        }
    }

    /// Whether the client is told of errors and losses.
    pub fn tells_errors(&self) -> bool {
        self.has_chosen && self.hears != Hears::Nothing
    }

    /// Adds what intervals held back until `now_ns`.
    fn put_ripe(&mut self, now_ns: i64, out: &mut String) {
        for (time_ns, frame) in self.subscriptions.ripe(now_ns) {
            put_frame(out, time_ns, &frame, false);
        }
    }

    fn put_statistics(&mut self, out: &mut String) {
        let Statistics { every, told_at, received_bytes, received, sent_bytes, sent } = &mut self.statistics;
        if every.is_zero() || told_at.is_some_and(|told_at| told_at.elapsed() < *every) {
            return;
        }
        *told_at = Some(Instant::now());
        // Writing to memory cannot fail.
        let _ = write!(out, "< stat {received_bytes} {received} {sent_bytes} {sent} >");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_trace::TraceFrame;
    use cantap_wire::{Frame, Id};

    fn record(ms: i64, frame: &str, direction: Direction) -> TraceRecord {
        let frame = frame.parse::<Frame>().unwrap().into();
        TraceRecord {
            time_ns: ms * 1_000_000,
            device_ns: None,
            channel: 1,
            event: TraceEvent::Frame { frame, direction, late: false },
        }
    }

    #[test]
    fn a_client_hears_others_frames_and_not_its_own() {
        let mut hearing = Hearing { hears: Hears::All, ..Hearing::default() };
        hearing.own.sends(1, "123#11".parse::<TraceFrame>().unwrap());
        hearing.own.repeats(Id::standard(0x200).unwrap(), Some("200#".parse().unwrap()));
        let mut out = String::new();
        let sent = |ms, frame| record(ms, frame, Direction::Tx);
        let records =
            [sent(1, "123#11"), sent(2, "123#11"), sent(3, "200#"), record(4, "200#", Direction::Rx)];
        hearing.take(&records, &mut out);
        assert_eq!(out, "< frame 123 0.002000 11 >< frame 200 0.004000  >");
    }

    #[test]
    fn statistics_count_both_directions_and_modes_tell_what_they_are_for() {
        let mut hearing = Hearing::default();
        let mut out = String::new();
        hearing.begin(Hears::Nothing, Instant::now());
        hearing.statistics_every(Duration::from_nanos(1));
        hearing.own.sends(1, "123#11".parse::<TraceFrame>().unwrap());
        hearing.take(&[record(1, "123#11", Direction::Tx), record(2, "124#2233", Direction::Rx)], &mut out);
        assert_eq!(out, "< stat 2 1 1 1 >");
        out.clear();
        hearing.statistics_every(Duration::ZERO);
        hearing.begin(Hears::Subscribed, Instant::now());
        hearing.subscriptions.add(Id::standard(0x124).unwrap(), super::super::subscriptions::Wanted::All, 0);
        hearing.take(&[record(3, "123#11", Direction::Rx), record(4, "124#2233", Direction::Rx)], &mut out);
        assert_eq!(out, "< frame 124 0.004000 22 33  >");
    }
}
