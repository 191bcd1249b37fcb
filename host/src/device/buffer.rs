//! The bounded buffer between the reader thread and the consumer of the records. The reader never waits: what
//! does not fit is counted, and a loss record stands in its place.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cantap_wire::CHANNELS;
use cantap_wire::record::LossStage;

use super::DeviceError;
use crate::{TraceEvent, TraceRecord};

/// This many records that are not frames may exceed the capacity, so that what explains a gap is kept.
const RESERVE: usize = 65_536;
/// Used-up vectors kept for the next batches.
const SPARES: usize = 4;

/// How the stream ended.
enum End {
    Clean,
    Failed(Option<DeviceError>),
}

struct State {
    batches: VecDeque<Vec<TraceRecord>>,
    records: usize,
    spares: Vec<Vec<TraceRecord>>,
    /// Frames lost here that no record reports yet.
    unreported: [u32; CHANNELS],
    /// All frames lost here.
    lost: [u64; CHANNELS],
    /// Time of the last record that was dropped.
    lost_at_ns: i64,
    end: Option<End>,
}

/// The buffer, also for programs that pass on records that came from a device.
pub struct Buffer {
    state: Mutex<State>,
    changed: Condvar,
    capacity: usize,
}

impl Buffer {
    /// A buffer for `capacity` records.
    pub fn new(capacity: usize) -> Self {
        let state = State {
            batches: VecDeque::new(),
            records: 0,
            spares: Vec::new(),
            unreported: [0; CHANNELS],
            lost: [0; CHANNELS],
            lost_at_ns: 0,
            end: None,
        };
        Self { state: Mutex::new(state), changed: Condvar::new(), capacity }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // Nothing panics while the lock is held, and the state would still be consistent.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes the records out of `batch`, leaving it empty, and returns how many frames found no room, per
    /// channel. Records after the end belong to nobody: they are neither kept nor counted as lost.
    pub fn push(&self, batch: &mut Vec<TraceRecord>) -> [u32; CHANNELS] {
        if batch.is_empty() {
            return [0; CHANNELS];
        }
        let mut state = self.lock();
        if state.end.is_some() {
            batch.clear();
            return [0; CHANNELS];
        }
        let mut lost = [0; CHANNELS];
        let fits = state.records + batch.len() <= self.capacity;
        if !fits {
            state.lost_at_ns = batch.last().map_or(0, |record| record.time_ns);
            let room = (self.capacity + RESERVE).saturating_sub(state.records);
            let mut kept = 0;
            batch.retain(|record| {
                let TraceEvent::Frame { .. } = record.event else {
                    kept += 1;
                    return kept <= room;
                };
                lost[usize::from(record.channel == 2)] += 1;
                false
            });
            for (sum, lost) in state.unreported.iter_mut().zip(lost) {
                *sum = sum.wrapping_add(lost);
            }
            for (sum, lost) in state.lost.iter_mut().zip(lost) {
                *sum += u64::from(lost);
            }
        }
        let mut next = state.spares.pop().unwrap_or_default();
        if fits {
            state.report_losses(&mut next);
        }
        next.append(batch);
        if next.is_empty() {
            state.spares.push(next);
            return lost;
        }
        state.records += next.len();
        state.batches.push_back(next);
        drop(state);
        self.changed.notify_all();
        lost
    }

    /// Ends the stream.
    pub fn finish(&self) {
        self.end(End::Clean);
    }

    /// Ends the stream with an error.
    pub fn fail(&self, error: DeviceError) {
        self.end(End::Failed(Some(error)));
    }

    fn end(&self, end: End) {
        let mut state = self.lock();
        if state.end.is_none() {
            let mut last = Vec::new();
            state.report_losses(&mut last);
            state.records += last.len();
            if !last.is_empty() {
                state.batches.push_back(last);
            }
            state.end = Some(end);
        }
        drop(state);
        self.changed.notify_all();
    }

    /// Frames of each channel that found no room here so far.
    pub fn lost(&self) -> [u64; CHANNELS] {
        self.lock().lost
    }

    /// Whether the stream has ended.
    pub fn has_ended(&self) -> bool {
        self.lock().end.is_some()
    }

    /// Whether [`Self::pop`] would not wait.
    pub fn is_ready(&self) -> bool {
        let state = self.lock();
        !state.batches.is_empty() || state.end.is_some()
    }

    /// The next records; empty if there are none within `timeout`; `None` after the last. An error is
    /// reported once, after everything before it has been taken.
    pub fn pop(&self, timeout: Option<Duration>) -> Result<Option<Vec<TraceRecord>>, DeviceError> {
        let deadline = timeout.map(|timeout| Instant::now() + timeout);
        let mut state = self.lock();
        loop {
            if let Some(batch) = state.batches.pop_front() {
                state.records -= batch.len();
                return Ok(Some(batch));
            }
            match &mut state.end {
                Some(End::Failed(error)) => return error.take().map_or(Ok(None), Err),
                Some(End::Clean) => return Ok(None),
                None => {}
            }
            state = match deadline {
                None => self.changed.wait(state).unwrap_or_else(PoisonError::into_inner),
                Some(deadline) => {
                    let left = deadline.saturating_duration_since(Instant::now());
                    if left.is_zero() {
                        return Ok(Some(Vec::new()));
                    }
                    self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0
                }
            };
        }
    }

    /// Gives a used-up vector back.
    pub fn recycle(&self, mut batch: Vec<TraceRecord>) {
        batch.clear();
        let mut state = self.lock();
        if state.spares.len() < SPARES {
            state.spares.push(batch);
        }
    }
}

impl State {
    fn report_losses(&mut self, out: &mut Vec<TraceRecord>) {
        for (index, count) in self.unreported.iter_mut().enumerate().filter(|(_, count)| **count > 0) {
            let stage = Some(LossStage::Host);
            let event = TraceEvent::Lost { stage, count: *count, at_least: false };
            out.push(TraceRecord {
                time_ns: self.lost_at_ns,
                device_ns: None,
                channel: index as u8 + 1,
                event,
            });
            *count = 0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Direction;

    fn frames(times: std::ops::Range<i64>) -> Vec<TraceRecord> {
        let event =
            TraceEvent::Frame { frame: "123#".parse().unwrap(), direction: Direction::Rx, late: false };
        times.map(|time_ns| TraceRecord { time_ns, device_ns: None, channel: 2, event }).collect()
    }

    /// Whoever closed the stream must find as many losses in it as the counters say.
    #[test]
    fn what_comes_behind_the_end_is_not_lost() {
        let buffer = Buffer::new(1);
        assert_eq!(buffer.push(&mut frames(0..2)), [0, 2]);
        buffer.finish();
        let mut late = frames(2..4);
        assert_eq!((buffer.push(&mut late), late.len()), ([0, 0], 0));
        let all: Vec<_> = std::iter::from_fn(|| buffer.pop(None).unwrap()).flatten().collect();
        let losses = |record: &TraceRecord| match record.event {
            TraceEvent::Lost { count, .. } => count,
            _ => 0,
        };
        assert_eq!(all.iter().map(losses).sum::<u32>(), 2);
    }

    #[test]
    fn what_does_not_fit_is_counted_and_stands_in_its_place() {
        let buffer = Buffer::new(10);
        assert_eq!(buffer.push(&mut frames(0..8)), [0, 0]);
        assert_eq!(buffer.push(&mut frames(8..12)), [0, 4]);
        assert_eq!(buffer.push(&mut frames(12..15)), [0, 3]);
        assert_eq!(buffer.pop(None).unwrap().unwrap().len(), 8);
        assert_eq!(buffer.push(&mut frames(15..17)), [0, 0]);
        let next = buffer.pop(None).unwrap().unwrap();
        let lost = TraceEvent::Lost { stage: Some(LossStage::Host), count: 7, at_least: false };
        assert_eq!(next[0], TraceRecord { time_ns: 14, device_ns: None, channel: 2, event: lost });
        assert_eq!(next[1..], frames(15..17));
    }

    #[test]
    fn an_error_comes_after_everything_received_and_once() {
        let buffer = Buffer::new(10);
        buffer.push(&mut frames(0..1));
        buffer.fail(DeviceError::WrongReply);
        assert_eq!(buffer.pop(None).unwrap(), Some(frames(0..1)));
        assert!(buffer.pop(None).is_err());
        assert_eq!(buffer.pop(None).unwrap(), None);
    }

    #[test]
    fn losses_at_the_very_end_are_reported_too() {
        let buffer = Buffer::new(1);
        assert_eq!(buffer.push(&mut frames(0..2)), [0, 2]);
        buffer.finish();
        assert_eq!(buffer.pop(None).unwrap().unwrap().len(), 1);
        assert_eq!(buffer.pop(None).unwrap(), None);
    }
}
