//! Plays a trace on a bus with its original timing, kept by the device's clock.
//!
//! A time in a trace is the end of a frame, but the device needs to know when to begin. So each frame's exact length is
//! subtracted, and the frames end as far apart as in the trace, whatever their lengths. The host streams as far ahead as the
//! device's queue allows; its own delays do not show on the bus.

use std::collections::VecDeque;
use std::time::Duration;

use cantap_trace::TraceFrame;
use cantap_wire::{CHANNELS, Channel};

use crate::device::Transmission;
use crate::transmit::Stream;
use crate::{Device, DeviceError};
use cantap_trace::bits::INTERMISSION_BITS;

/// From now to the first frame: time to fill the device's queue.
const LEAD: Duration = Duration::from_millis(100);
/// Frames due later than this wait in the host: a device refuses those more than a day ahead.
const MOST_AHEAD: Duration = Duration::from_hours(1);
/// How often to check whether to continue.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// How to change the trace's times.
#[derive(Clone, Copy, Debug)]
pub struct Pace {
    /// 2 plays twice as fast, 0.5 at half the speed.
    pub speed: f64,
    /// Longer pauses are skipped: the next frame follows immediately.
    pub longest_gap: Option<Duration>,
    /// Bursts begin at least this far apart, across all channels.
    pub shortest_gap: Duration,
    /// Frames in a burst, from 1: those after the first wait only for the trace's own times.
    pub burst: u32,
    /// As fast as the bus accepts frames.
    pub ignore_times: bool,
}

impl Default for Pace {
    fn default() -> Self {
        Self { speed: 1.0, longest_gap: None, shortest_gap: Duration::ZERO, burst: 1, ignore_times: false }
    }
}

/// Converts times in a trace to times of the device.
#[derive(Clone, Debug)]
pub struct Timetable {
    pace: Pace,
    bitrates_bps: [u32; CHANNELS],
    data_bitrates_bps: [Option<u32>; CHANNELS],
    tick_ns: f64,
    first_ticks: u64,
    /// Begin of the last frame in the trace and in the replay, in ns since the first.
    last: Option<(i64, f64)>,
    /// Begin of the current burst, in ns since the first frame, and the number of its frames so far.
    burst: (f64, u32),
}

impl Timetable {
    /// The first frame begins at `first_ticks` of the device's clock.
    pub fn new(pace: Pace, bitrates_bps: [u32; CHANNELS], tick_hz: u32, first_ticks: u64) -> Self {
        Self {
            pace,
            bitrates_bps,
            data_bitrates_bps: [None; CHANNELS],
            tick_ns: 1e9 / f64::from(tick_hz),
            first_ticks,
            last: None,
            burst: (0.0, 0),
        }
    }

    /// With these bit rates of the data phases of CAN FD frames. Without one, a frame that switches its bit rate is taken to be as long as
    /// one that does not, and begins early.
    #[must_use]
    pub fn with_data_bitrates(self, data_bitrates_bps: [Option<u32>; CHANNELS]) -> Self {
        Self { data_bitrates_bps, ..self }
    }

    /// A frame's time on the bus without intermission, in ns; 0 where no bit rate is known: such a frame is handed over at its time.
    fn length_ns(&self, channel: Channel, frame: &TraceFrame) -> f64 {
        let bits = frame.bus_bits();
        let nominal_bps = self.bitrates_bps[channel.index()];
        if nominal_bps == 0 {
            return 0.0;
        }
        let data_bps = self.data_bitrates_bps[channel.index()].unwrap_or(nominal_bps).max(1);
        f64::from(bits.nominal - INTERMISSION_BITS) * 1e9 / f64::from(nominal_bps)
            + f64::from(bits.data) * 1e9 / f64::from(data_bps)
    }

    /// When a frame that ended at `end_ns` in the trace should begin, and when it will end, in ticks. A beginning before
    /// the device's start becomes 0; an end before it wraps.
    pub fn next(&mut self, end_ns: i64, channel: Channel, frame: &TraceFrame) -> (u64, u64) {
        let length_ns = self.length_ns(channel, frame);
        let begin_ns = end_ns - length_ns.round() as i64;
        let at_ns = self.last.map_or(0.0, |(last_ns, last_at_ns)| {
            // Negative if the other channel's shorter frame ended first.
            let mut gap_ns = (begin_ns - last_ns) as f64;
            if self.pace.longest_gap.is_some_and(|longest| gap_ns > longest.as_nanos() as f64) {
                gap_ns = 0.0;
            }
            let at_ns = last_at_ns + gap_ns / self.pace.speed;
            let (burst_at_ns, frames) = self.burst;
            match self.pace.shortest_gap {
                Duration::ZERO => at_ns,
                shortest if frames >= self.pace.burst => at_ns.max(burst_at_ns + shortest.as_nanos() as f64),
                _ => at_ns.max(last_at_ns),
            }
        });
        let (burst_at_ns, frames) = self.burst;
        self.burst =
            if frames == 0 || frames >= self.pace.burst { (at_ns, 1) } else { (burst_at_ns, frames + 1) };
        self.last = Some((begin_ns, at_ns));
        // Whole ticks first: a float cannot hold the nanoseconds of a long uptime.
        let ticks = |ns: f64| (ns / self.tick_ns).round() as i64;
        // In a trace out of order, an end may be planned before the device's start: lateness counts from
        // there, too.
        let end = self.first_ticks.wrapping_add_signed(ticks(at_ns + length_ns));
        (self.first_ticks.saturating_add_signed(ticks(at_ns)), end)
    }
}

/// How accurately a replay kept its times.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Accuracy {
    /// Frames compared.
    pub frames: u64,
    /// How much earlier than planned a frame ended, at most, relative to the first one, in µs.
    pub early_us: f64,
    /// How much later, at most, in µs. A busy bus delays frames.
    pub late_us: f64,
}

/// A replay in progress.
pub struct Replay<'d> {
    device: &'d Device,
    stream: Stream<'d>,
    /// Frames later than this wait until they are nearer.
    horizon_ticks: u64,
    timetable: Timetable,
    tick_hz: u32,
    /// Planned ends of frames in progress, per channel.
    planned: [VecDeque<(u32, u64)>; CHANNELS],
    /// Lateness of the first frame, in ticks; all others are compared with it.
    first_late: Option<i64>,
    accuracy: Accuracy,
}

impl<'d> Replay<'d> {
    /// A replay on channels that are open at these bit rates.
    pub fn new(device: &'d Device, pace: Pace, bitrates_bps: [u32; CHANNELS]) -> Result<Self, DeviceError> {
        let tick_hz = device.hello().tick_hz;
        let lead = (LEAD.as_secs_f64() * f64::from(tick_hz)) as u64;
        let data_bitrates_bps = Channel::ALL.map(|channel| device.data_bitrate(channel));
        let timetable = Timetable::new(pace, bitrates_bps, tick_hz, device.time()? + lead)
            .with_data_bitrates(data_bitrates_bps);
        Ok(Self {
            device,
            stream: Stream::new(device),
            horizon_ticks: 0,
            timetable,
            tick_hz,
            planned: Default::default(),
            first_late: None,
            accuracy: Accuracy::default(),
        })
    }

    /// Adds the trace's next frame. Waits while the device's queue is full or the frame is due too far ahead; returns false if
    /// `go_on` returned false meanwhile.
    pub fn push(
        &mut self,
        end_ns: i64,
        channel: Channel,
        frame: impl Into<TraceFrame>,
        mut go_on: impl FnMut(&mut Self) -> bool,
    ) -> Result<bool, DeviceError> {
        let frame = frame.into();
        let (begin, end) = self.timetable.next(end_ns, channel, &frame);
        let ignore_times = self.timetable.pace.ignore_times;
        let at = (!ignore_times).then_some(begin);
        let horizon = MOST_AHEAD.as_secs() * u64::from(self.tick_hz);
        if !ignore_times && begin > self.horizon_ticks {
            // Nothing may be left here while waiting.
            self.stream.flush()?;
            loop {
                self.horizon_ticks = self.device.time()? + horizon;
                if begin <= self.horizon_ticks {
                    break;
                }
                self.stream.wait(LOOK_EVERY)?;
                if !go_on(self) {
                    return Ok(false);
                }
            }
        }
        while self.stream.is_full(channel) {
            self.stream.wait_for_room()?;
            if !go_on(self) {
                return Ok(false);
            }
        }
        let tag = self.stream.add(channel, frame, at)?;
        if !ignore_times {
            self.planned[channel.index()].push_back((tag, end));
        }
        Ok(true)
    }

    /// Waits for the rest; see [`Stream::finish`].
    pub fn finish(&mut self, go_on: impl FnMut(Duration) -> bool) -> Result<bool, DeviceError> {
        self.stream.finish(go_on)
    }

    /// Hands everything to the device.
    pub fn flush(&mut self) -> Result<(), DeviceError> {
        self.stream.flush()
    }

    /// Waits for the next transmission to end, at most this long.
    pub fn wait(&mut self, at_most: Duration) -> Result<(), DeviceError> {
        self.stream.wait(at_most)
    }

    /// Number of frames handed over that have not ended.
    pub fn under_way(&self) -> usize {
        self.stream.under_way()
    }

    /// See [`Stream::oldest_due`].
    pub fn oldest_due(&self) -> [Option<u64>; CHANNELS] {
        self.stream.oldest_due()
    }

    /// How frames ended since the last call.
    pub fn take_ended(&mut self) -> Vec<Transmission> {
        let ended = self.stream.take_ended();
        for end in &ended {
            let planned = &mut self.planned[end.channel.index()];
            // A failed frame was not sent at its time; the sent ones are found in order.
            while let Some((tag, at)) = planned.pop_front() {
                if tag == end.tag {
                    if end.result.is_ok() {
                        self.compare(end.ticks, at);
                    }
                    break;
                }
            }
        }
        ended
    }

    fn compare(&mut self, ticks: u64, planned: u64) {
        // Either may be the greater; a planned end may lie before zero.
        let late = ticks.wrapping_sub(planned) as i64;
        let first = *self.first_late.get_or_insert(late);
        let off_us = (late - first) as f64 * 1e6 / f64::from(self.tick_hz);
        self.accuracy.frames += 1;
        self.accuracy.late_us = self.accuracy.late_us.max(off_us);
        self.accuracy.early_us = self.accuracy.early_us.max(-off_us);
    }

    /// How accurately the times have been kept so far.
    pub const fn accuracy(&self) -> Accuracy {
        self.accuracy
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAN1: Channel = Channel::Can1;

    fn table(pace: Pace) -> Timetable {
        Timetable::new(pace, [1_000_000, 500_000], 12_000_000, 1_000)
    }

    fn frame(text: &str) -> TraceFrame {
        text.parse().unwrap()
    }

    #[test]
    fn frames_end_as_far_apart_as_in_the_trace_whatever_their_lengths() {
        let mut table = table(Pace::default());
        let (short, long) = (frame("555#"), frame("1F334455#1122334455667788"));
        let ends: Vec<u64> = [(1_000_000, short), (1_300_000, long), (1_500_000, short)]
            .iter()
            .map(|(end_ns, frame)| table.next(*end_ns, CAN1, frame).1)
            .collect();
        assert_eq!([ends[1] - ends[0], ends[2] - ends[1]], [3_600, 2_400]);
    }

    #[test]
    fn a_can_fd_frame_takes_as_long_as_both_its_bit_rates_make_it() {
        let long = frame(&format!("123##1{}", "55".repeat(64)));
        let length = |data_bitrates_bps| {
            let (begin, end) =
                table(Pace::default()).with_data_bitrates(data_bitrates_bps).next(0, CAN1, &long);
            end - begin
        };
        let bits = long.bus_bits();
        assert_eq!(length([None; 2]), u64::from(12 * (bits.nominal - 3 + bits.data)));
        assert_eq!(length([Some(4_000_000), None]), u64::from(12 * (bits.nominal - 3) + 3 * bits.data));
    }

    #[test]
    fn speed_and_gaps_change_the_spacing() {
        let begins = |pace| {
            let mut table = table(pace);
            [0, 1_000_000, 11_000_000].map(|end_ns| table.next(end_ns, CAN1, &frame("555#")).0 - 1_000)
        };
        assert_eq!(begins(Pace::default()), [0, 12_000, 132_000]);
        assert_eq!(begins(Pace { speed: 2.0, ..Pace::default() }), [0, 6_000, 66_000]);
        let longest_gap = Some(Duration::from_millis(2));
        assert_eq!(begins(Pace { longest_gap, ..Pace::default() }), [0, 12_000, 12_000]);
        let shortest_gap = Duration::from_millis(5);
        assert_eq!(begins(Pace { shortest_gap, ..Pace::default() }), [0, 60_000, 180_000]);
        // The second belongs to the first one's burst; the third is late anyway.
        assert_eq!(begins(Pace { shortest_gap, burst: 2, ..Pace::default() }), [0, 12_000, 132_000]);
    }

    /// The device may have just started: a frame planned long before that is late by the whole difference.
    #[test]
    fn an_end_planned_before_the_devices_start_is_not_clipped() {
        let mut table = table(Pace::default());
        let first = table.next(1_000_000_000, CAN1, &frame("555#"));
        let second = table.next(500_000_000, CAN1, &frame("555#"));
        assert_eq!(second.0, 0);
        assert_eq!(first.1.wrapping_sub(second.1), 6_000_000);
    }
}
