//! Statistics of one channel.

use cantap_can::{BusErrorKind, ErrorState, LossStage, TransmitFailure};

use super::ids::{IdStatistics, Ids};
use super::windows::{Window, Windows, per_second};
use super::work_load::WorkLoad;
use cantap_trace::{Direction, Id, Moment, TraceEvent, TraceFrame, TraceRecord};

/// Statistics of one channel.
#[derive(Clone, Debug)]
pub struct ChannelStatistics {
    /// The channel, from 1.
    pub number: u8,
    /// Its bit rate in bit/s, if known.
    pub bitrate_bps: Option<u32>,
    /// The bit rate of its data phases in bit/s, if known.
    pub data_bitrate_bps: Option<u32>,
    /// Frames, sent and received.
    pub frames: u64,
    /// Frames sent by the device.
    pub sent: u64,
    /// Frames with a 29-bit identifier.
    pub extended: u64,
    /// Remote frames.
    pub remote: u64,
    /// CAN FD frames.
    pub fd: u64,
    /// CAN FD frames with a separate bit rate in the data phase.
    pub brs: u64,
    /// CAN FD frames from an error passive sender.
    pub esi: u64,
    /// Frames whose time is only an upper bound.
    pub late: u64,
    /// Bits of all frames, with stuff bits and intermission.
    pub bits: u64,
    /// Data bytes of all frames.
    pub data_bytes: u64,
    /// Ends of the first and the last frame, in nanoseconds.
    pub span_ns: Option<(i64, i64)>,
    /// Records with a time before that of the previous record.
    pub out_of_order: u64,
    /// Work load; `None` without a bit rate, or if that of a frame's data phase is unknown.
    pub load: Option<WorkLoad>,
    /// Errors on the bus.
    pub errors: Errors,
    /// Frames that are missing.
    pub losses: Losses,
    /// The controller's state, if it was reported.
    pub state: Option<ErrorState>,
    /// How often the state changed.
    pub state_changes: u64,
    /// The controller's transmit and receive error counters, if they were reported.
    pub counters: Option<(u8, u8)>,
    /// Frames that should have been sent but were not.
    pub transmit_failures: u64,
    windows: Windows,
    ids: Ids,
    latest_ns: i64,
    gaps: u32,
    first_bits: u64,
    latest_frame_ns: Option<i64>,
    /// Time between frames, where it went on.
    covered_ns: u64,
    /// How far it has gone: the latest frame's time since the clock was last set back.
    reached_ns: i64,
    /// The common divisor of all intervals between two frames; 0 before the first.
    step_ns: u64,
    /// Frames with the same stamp as the frame before.
    shared_stamps: u64,
}

/// No two stamps of one recording are so far out of order.
const SET_BACK_NS: i64 = 1_000_000_000;

/// Errors detected by a channel's controller.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Errors {
    /// By kind, in the order of [`BusErrorKind`].
    pub by_kind: [u64; 6],
    /// Of unknown kind.
    pub unknown: u64,
    /// Counted but not reported one by one.
    pub suppressed: u64,
}

impl Errors {
    /// The total.
    pub fn total(&self) -> u64 {
        self.by_kind.iter().sum::<u64>() + self.unknown + self.suppressed
    }

    /// Errors of one kind.
    pub fn of(&self, kind: BusErrorKind) -> u64 {
        self.by_kind[kind as usize]
    }
}

/// Frames that are missing from a channel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Losses {
    /// By stage, in the order of [`LossStage`].
    pub by_stage: [u64; LossStage::ALL.len()],
    /// Losses at a stage that the trace does not name.
    pub unknown: u64,
    /// Places in the trace where frames are missing.
    pub gaps: u64,
    /// Those of them at which it is unknown how many, because the device was not on the bus, or not there.
    pub uncounted: u64,
    /// Whether there may be more: hardware cannot count the frames lost in an overrun.
    pub at_least: bool,
}

impl Losses {
    /// The total.
    pub fn total(&self) -> u64 {
        self.by_stage.iter().sum::<u64>() + self.unknown
    }

    /// Frames lost at one stage.
    pub fn of(&self, stage: LossStage) -> u64 {
        self.by_stage[stage as usize]
    }
}

impl ChannelStatistics {
    pub(super) fn new(
        number: u8,
        bitrate_bps: Option<u32>,
        data_bitrate_bps: Option<u32>,
        has_load: bool,
        origin_ns: i64,
        window_ns: u64,
        peaks: usize,
    ) -> Self {
        let load_of_bps = bitrate_bps.filter(|_| has_load);
        Self {
            number,
            bitrate_bps,
            data_bitrate_bps,
            frames: 0,
            sent: 0,
            extended: 0,
            remote: 0,
            fd: 0,
            brs: 0,
            esi: 0,
            late: 0,
            bits: 0,
            data_bytes: 0,
            span_ns: None,
            out_of_order: 0,
            load: load_of_bps.map(WorkLoad::new),
            errors: Errors::default(),
            losses: Losses::default(),
            state: None,
            state_changes: 0,
            counters: None,
            transmit_failures: 0,
            windows: Windows::new(number, origin_ns, window_ns, load_of_bps, data_bitrate_bps, peaks),
            ids: Ids::default(),
            latest_ns: i64::MIN,
            gaps: 0,
            first_bits: 0,
            latest_frame_ns: None,
            covered_ns: 0,
            reached_ns: i64::MIN,
            step_ns: 0,
            shared_stamps: 0,
        }
    }

    #[inline]
    pub(super) fn push(&mut self, record: &TraceRecord, closed: &mut impl FnMut(&Window)) {
        let time_ns = record.time_ns;
        if time_ns < self.latest_ns {
            self.out_of_order += 1;
        }
        self.latest_ns = time_ns;
        if matches!(record.event, TraceEvent::Lost { .. }) {
            self.interrupt();
        }
        self.windows.advance(time_ns, closed);
        if record.event == TraceEvent::GAP {
            self.suspend();
        }
        match &record.event {
            TraceEvent::Frame { frame, direction, late } => {
                self.frame(frame, *direction, *late, record.moment(), closed);
            }
            TraceEvent::BusError { kind, counters } => {
                match kind {
                    Some(kind) => self.errors.by_kind[*kind as usize] += 1,
                    None => self.errors.unknown += 1,
                }
                self.counters = counters.or(self.counters);
                self.windows.errors(1);
            }
            TraceEvent::ErrorsSuppressed { count } => {
                self.errors.suppressed += u64::from(*count);
                self.windows.errors(u64::from(*count));
            }
            TraceEvent::State { state, counters } => {
                self.state_changes += u64::from(self.state != Some(*state));
                self.state = Some(*state);
                self.counters = counters.or(self.counters);
            }
            TraceEvent::Lost { stage, count, at_least } => {
                match stage {
                    Some(stage) => self.losses.by_stage[*stage as usize] += u64::from(*count),
                    None => self.losses.unknown += u64::from(*count),
                }
                self.losses.gaps += 1;
                self.losses.uncounted += u64::from(*count == 0 && *at_least);
                self.losses.at_least |= *at_least;
                self.windows.lost(u64::from(*count));
            }
            TraceEvent::TransmitFailed { reason, .. } => {
                self.transmit_failures += match *reason {
                    TransmitFailure::Overtaken { periods } => u64::from(periods),
                    _ => 1,
                };
            }
            TraceEvent::Disturbed { .. } | TraceEvent::Lin { .. } => {}
        }
    }

    #[inline]
    fn frame(
        &mut self,
        frame: &TraceFrame,
        direction: Direction,
        late: bool,
        end: Moment,
        closed: &mut impl FnMut(&Window),
    ) {
        let end_ns = end.time_ns;
        let on_bus = frame.bus_bits();
        if frame.is_fd() {
            self.fd_frame(frame, on_bus.data > 0);
        }
        let bits = on_bus.total();
        self.frames += 1;
        self.bits += u64::from(bits);
        self.data_bytes += frame.data_len() as u64;
        self.sent += u64::from(direction == Direction::Tx);
        self.extended += u64::from(frame.id().is_extended());
        self.remote += u64::from(frame.is_remote());
        self.late += u64::from(late);
        if self.span_ns.is_none() {
            self.first_bits = u64::from(bits);
        }
        let (first, last) = self.span_ns.unwrap_or((end_ns, end_ns));
        let interval = self.latest_frame_ns.map_or(0, |before| end_ns.saturating_sub(before));
        if self.latest_frame_ns.is_some() {
            self.shared_stamps += u64::from(interval == 0);
            // It soon divides every interval, so that this costs only one division.
            let step = interval.unsigned_abs();
            if self.step_ns == 0 || !step.is_multiple_of(self.step_ns) {
                self.step_ns = common_divisor(self.step_ns, step);
            }
        }
        // Frames that are stamped a little out of order add nothing twice: only a longer way back is a clock that was set back.
        let is_first = self.latest_frame_ns.is_none();
        if is_first || end_ns.saturating_add(SET_BACK_NS) < self.reached_ns {
            self.reached_ns = end_ns;
        }
        let ahead = end_ns.saturating_sub(self.reached_ns).max(0);
        self.reached_ns = self.reached_ns.max(end_ns);
        self.latest_frame_ns = Some(end_ns);
        self.covered_ns = self.covered_ns.saturating_add(ahead as u64);
        self.span_ns = Some((first.min(end_ns), last.max(end_ns)));
        if let Some(load) = &mut self.load {
            // Without its rate, the data phase has no bits here: see `fd_frame`.
            let data = match (self.bitrate_bps, self.data_bitrate_bps) {
                (Some(nominal), Some(data)) if on_bus.data > 0 => {
                    f64::from(on_bus.data) * f64::from(nominal) / f64::from(data)
                }
                _ => 0.0,
            };
            load.frame(end_ns, f64::from(on_bus.nominal) + data);
        }
        self.windows.frame(end_ns, on_bus, closed);
        self.ids.add(frame, direction, bits, end, self.gaps);
    }

    #[cold]
    fn fd_frame(&mut self, frame: &TraceFrame, is_switched: bool) {
        self.fd += 1;
        self.brs += u64::from(is_switched);
        self.esi += u64::from(frame.fd().is_some_and(cantap_trace::FdFrame::esi));
        // The duration of a data phase with a separate rate is unknown without that rate.
        if is_switched && self.data_bitrate_bps.is_none() && self.load.take().is_some() {
            self.windows.forget_load();
        }
    }

    /// The interval from the last frame to the next one is meaningless.
    fn interrupt(&mut self) {
        self.gaps = self.gaps.wrapping_add(1);
        self.windows.gap();
        if let Some(load) = &mut self.load {
            load.gap();
        }
    }

    /// Nothing is known about the time from the last record to the next one.
    pub(super) fn suspend(&mut self) {
        self.interrupt();
        self.latest_frame_ns = None;
        self.windows.suspend();
    }

    pub(super) fn advance(&mut self, now_ns: i64, closed: &mut impl FnMut(&Window)) {
        // Only a record's own time can show that the clock was set back, or end a suspended time.
        if now_ns > self.latest_ns && !self.windows.is_suspended() {
            self.windows.advance(now_ns, closed);
        }
    }

    pub(super) fn finish(&mut self, now_ns: i64, closed: &mut impl FnMut(&Window)) {
        self.windows.finish(now_ns, closed);
    }

    /// From the first frame's end to the last one's, in nanoseconds; if the trace's clock was set back (two
    /// logs were joined), the sum of its parts.
    pub fn covered_ns(&self) -> u64 {
        self.covered_ns
    }

    /// Bits of the first frame, which lie before [`Self::span_ns`].
    pub(super) fn first_bits(&self) -> u64 {
        self.first_bits
    }

    /// The resolution of all stamps, in nanoseconds, if it is coarser than the frames: many of them share a stamp, which is
    /// impossible on a bus.
    pub fn coarse_step_ns(&self) -> Option<u64> {
        /// Percentage of frames that share a stamp: some do if two from a USB packet are stamped on arrival.
        const SHARED_PCT: u64 = 10;
        /// A finer resolution hides no frame's length.
        const FINE_NS: u64 = 100_000;
        let many = self.shared_stamps * 100 >= self.frames * SHARED_PCT && self.shared_stamps > 1;
        (many && self.step_ns >= FINE_NS).then_some(self.step_ns)
    }

    /// Frames per second from the first to the last: number of intervals over time.
    pub fn frames_per_s(&self) -> f64 {
        per_second(self.frames.saturating_sub(1), self.covered_ns)
    }

    /// Least and mean load of the whole, finished windows from which no frame is missing, in per cent; `None` without
    /// a bit rate or such a window.
    pub fn window_least_and_mean_pct(&self) -> Option<(f64, f64)> {
        self.windows.least_and_mean_pct()
    }

    /// Largest load of a whole, finished window, in per cent: a lower bound if frames are missing from it.
    pub fn window_largest_pct(&self) -> Option<f64> {
        self.windows.largest_pct()
    }

    /// The busiest finished windows, the busiest first.
    pub fn peaks(&self) -> impl Iterator<Item = &Window> {
        self.windows.peaks()
    }

    /// The current window, up to `now_ns`.
    pub fn running_window(&self, now_ns: i64) -> Window {
        self.windows.running(now_ns)
    }

    /// Statistics of each identifier, in order of appearance. At most [`MOST_IDS`](super::MOST_IDS).
    pub fn ids(&self) -> impl Iterator<Item = &IdStatistics> {
        self.ids.iter()
    }

    /// Statistics of one identifier.
    pub fn id(&self, id: Id) -> Option<&IdStatistics> {
        self.ids.get(id)
    }

    /// How many identifiers are listed.
    pub fn id_count(&self) -> usize {
        self.ids.len()
    }

    /// Frames of identifiers beyond [`MOST_IDS`](super::MOST_IDS).
    pub fn unlisted_frames(&self) -> u64 {
        self.ids.unlisted_frames
    }
}

/// The greatest common divisor; of 0 and a number, the number.
fn common_divisor(mut a: u64, mut b: u64) -> u64 {
    while b != 0 {
        (a, b) = (b, a % b);
    }
    a
}
