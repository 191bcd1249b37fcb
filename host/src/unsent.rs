//! Why frames were not sent: the only place that decides it, from the device's stream and status.
//!
//! A device reports how each transmission ended, but not why one does not end at all: a controller keeps trying for ever.
//! In that case the errors since its last frame, its state and the other nodes' traffic show what is in the way. This
//! module takes the device's records for that, unless the program uses them itself and hands them in.

use std::time::{Duration, Instant};

use cantap_wire::message::ChannelStatus;
use cantap_wire::record::{BusErrorKind, ErrorState, TransmitFailure};
use cantap_wire::{CHANNELS, Channel};

use crate::device::{Records, Transmission};
use crate::{Device, DeviceError, Direction, TraceEvent, TraceRecord};

/// Frames are stuck if they are due and none of them has ended for this long.
pub const PATIENCE: Duration = Duration::from_secs(1);
/// How often to ask the device for its status.
const LOOK_EVERY: Duration = Duration::from_millis(250);
/// From this load on, in per cent, a bus is full for anyone with a high identifier.
const FULL_PCT: f64 = 80.0;
/// A load is meaningful only over a time much longer than a frame.
const LEAST_SPAN_NS: i64 = 100_000_000;

/// Why frames were not sent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Cause {
    /// No other node acknowledged them.
    Unacknowledged,
    /// Errors destroyed them, or kept the controller from finding a pause.
    Destroyed,
    /// Arbitration was lost to other frames again and again.
    BusFull {
        /// Load from other nodes in per cent, if the stream has the stamps and data to compute it.
        load_pct: Option<f64>,
    },
    /// The controller went bus-off.
    BusOff,
    /// Arbitration was lost in one-shot mode.
    ArbitrationLost,
    /// Their period is shorter than the bus allows.
    Overtaken,
    /// The host took them back.
    Aborted,
    /// The channel was closed.
    Closed,
    /// Nothing on the bus explained it.
    Unknown,
}

/// Bus errors, by what they say about our frames.
#[derive(Clone, Copy, Default)]
struct Errors {
    unacknowledged: u64,
    /// Bits read differently from those sent: only a sender finds those.
    destroyed: u64,
    /// Found while other nodes sent.
    received: u64,
}

impl Errors {
    fn add(&mut self, kind: Option<BusErrorKind>) {
        *match kind {
            Some(BusErrorKind::Acknowledgment) => &mut self.unacknowledged,
            Some(BusErrorKind::BitDominant | BusErrorKind::BitRecessive) => &mut self.destroyed,
            Some(BusErrorKind::Stuff | BusErrorKind::Form | BusErrorKind::Crc) | None => &mut self.received,
        } += 1;
    }

    /// What hit our own frames, if anything.
    fn cause(self) -> Option<Cause> {
        match self {
            Self { unacknowledged: 0, destroyed: 0, .. } => None,
            Self { unacknowledged, destroyed, .. } if unacknowledged >= destroyed => {
                Some(Cause::Unacknowledged)
            }
            _ => Some(Cause::Destroyed),
        }
    }
}

/// Frames from other nodes.
#[derive(Clone, Copy, Default)]
struct Others {
    /// End of the first and of the last frame.
    span_ns: Option<(i64, i64)>,
    /// Bits on the bus within the span.
    bits: u64,
}

impl Others {
    fn add(&mut self, end_ns: i64, bits: u32) {
        match &mut self.span_ns {
            None => self.span_ns = Some((end_ns, end_ns)),
            Some((_, last_ns)) => {
                *last_ns = end_ns;
                self.bits += u64::from(bits);
            }
        }
    }

    fn load_pct(&self, bitrate_bps: u32) -> Option<f64> {
        let (first_ns, last_ns) = self.span_ns?;
        let span_ns = last_ns.saturating_sub(first_ns);
        let load_pct = self.bits as f64 * 1e11 / (f64::from(bitrate_bps) * span_ns as f64);
        (span_ns >= LEAST_SPAN_NS).then_some(load_pct.min(100.0))
    }
}

/// What is known of one channel.
#[derive(Default)]
struct Seen {
    errors: Errors,
    /// The next three fields count since our last frame was sent.
    errors_since: Errors,
    others_since: Others,
    went_off_since: bool,
    /// How often each reason was given, except [`TransmitFailure::Overtaken`].
    failures: Vec<(TransmitFailure, u64)>,
    overtaken: u64,
    /// The device's time, in ticks, and the host's, from which the standstill counts.
    waiting_since: Option<(u64, Instant)>,
    stands_still: bool,
}

impl Seen {
    fn push(&mut self, record: &TraceRecord) {
        match record.event {
            TraceEvent::Frame { direction: Direction::Tx, .. } => {
                self.errors_since = Errors::default();
                self.others_since = Others::default();
                self.went_off_since = false;
            }
            TraceEvent::Frame { frame, .. } => {
                // How long a data phase takes is not known here: without it, the bus is at least so busy.
                self.others_since.add(record.time_ns, frame.bus_bits().nominal);
            }
            TraceEvent::BusError { kind, .. } => {
                self.errors.add(kind);
                self.errors_since.add(kind);
            }
            TraceEvent::State { state, .. } => self.went_off_since |= state == ErrorState::BusOff,
            _ => {}
        }
    }

    fn note(&mut self, end: &Transmission) {
        let Err(reason) = end.result else { return self.moved(end.ticks) };
        if let TransmitFailure::Overtaken { periods } = reason {
            // Periods passed while the frame was waiting.
            self.overtaken += u64::from(periods);
            return;
        }
        self.moved(end.ticks);
        match self.failures.iter_mut().find(|(known, _)| *known == reason) {
            Some((_, count)) => *count += 1,
            None => self.failures.push((reason, 1)),
        }
    }

    /// A transmission ended.
    fn moved(&mut self, ticks: u64) {
        self.waiting_since = Some((ticks, Instant::now()));
    }

    fn failed(&self) -> u64 {
        self.failures.iter().map(|(_, count)| count).sum()
    }

    fn cause(&self, status: &ChannelStatus, clock_hz: u32) -> Cause {
        let told = self.failures.iter().max_by_key(|(_, count)| *count).map(|(reason, _)| *reason);
        if status.state == ErrorState::BusOff || self.went_off_since || told == Some(TransmitFailure::BusOff)
        {
            return Cause::BusOff;
        }
        match told.filter(|_| !self.stands_still) {
            None => self.obstacle(status, clock_hz),
            Some(TransmitFailure::BusError) => self.errors.cause().unwrap_or(Cause::Destroyed),
            Some(TransmitFailure::ArbitrationLost) => Cause::ArbitrationLost,
            Some(TransmitFailure::Aborted) => Cause::Aborted,
            Some(TransmitFailure::Closed) => Cause::Closed,
            Some(TransmitFailure::BusOff) => Cause::BusOff,
            Some(TransmitFailure::Overtaken { .. }) => Cause::Overtaken,
            // A gateway's, not of a frame that a host has asked for.
            Some(TransmitFailure::Loop) => Cause::Unknown,
        }
    }

    /// What is in the way of frames that are still waiting.
    fn obstacle(&self, status: &ChannelStatus, clock_hz: u32) -> Cause {
        if let Some(cause) = self.errors_since.cause() {
            return cause;
        }
        // A load is computed from times and data, which a channel may leave out.
        let whole = status.open.filter(|config| !config.omit_stamps && !config.omit_data);
        let load_pct =
            whole.and_then(|config| self.others_since.load_pct(config.timing.known_bitrate_bps(clock_hz)?));
        let others_send = self.others_since.span_ns.is_some();
        if load_pct.map_or(others_send && self.stands_still, |load_pct| load_pct >= FULL_PCT) {
            Cause::BusFull { load_pct }
        } else if self.overtaken > 0 && !self.stands_still {
            Cause::Overtaken
        } else if self.errors_since.received > 0 {
            Cause::Destroyed
        } else {
            Cause::Unknown
        }
    }
}

fn take(channels: &mut [Seen; CHANNELS], records: &[TraceRecord]) {
    for record in records {
        if let Some(channel) = Channel::from_number(record.channel) {
            channels[channel.index()].push(record);
        }
    }
}

/// Watches frames being sent.
pub struct Watch<'d> {
    device: &'d Device,
    /// `None` if the program uses the records itself and hands them in.
    records: Option<Records>,
    channels: [Seen; CHANNELS],
    recovers: bool,
    look_at: Instant,
}

impl<'d> Watch<'d> {
    /// Watches a device from now on. `recovers` says that the caller brings channels with manual recovery back from bus-off;
    /// otherwise such a channel is stuck.
    pub fn new(device: &'d Device, recovers: bool) -> Self {
        Self {
            device,
            records: Some(device.records()),
            channels: Default::default(),
            recovers,
            look_at: Instant::now(),
        }
    }

    /// The same for a program that uses the records itself and passes each of them to [`Self::take`].
    pub fn fed(device: &'d Device, recovers: bool) -> Self {
        Self { device, records: None, channels: Default::default(), recovers, look_at: Instant::now() }
    }

    /// Notes what was on the bus.
    pub fn take(&mut self, records: &[TraceRecord]) {
        take(&mut self.channels, records);
    }

    /// Notes how transmissions ended.
    pub fn note(&mut self, ends: &[Transmission]) {
        for end in ends {
            self.channels[end.channel.index()].note(end);
        }
    }

    /// Frames had a good reason to wait so far: patience starts again.
    pub fn excuse(&mut self) {
        for seen in &mut self.channels {
            seen.waiting_since = None;
        }
    }

    /// Whether a channel's frames are stuck: due by the device's clock, and none of them ended for [`PATIENCE`]. `due` gives
    /// when the oldest frame of a channel became due, in ticks, if one is waiting. Call it repeatedly; it asks the device
    /// now and then.
    pub fn stands_still(
        &mut self,
        due: impl Fn(Channel, &ChannelStatus) -> Option<u64>,
    ) -> Result<bool, DeviceError> {
        let now = Instant::now();
        if now < self.look_at {
            return Ok(false);
        }
        self.look_at = now + LOOK_EVERY;
        self.take_records()?;
        let status = self.device.status()?;
        let patience_ticks = PATIENCE.as_secs() * u64::from(self.device.hello().tick_hz);
        for channel in Channel::ALL {
            let (state, seen) = (&status.channels[channel.index()], &mut self.channels[channel.index()]);
            let Some(config) = state.open else { continue };
            let is_gone = state.state == ErrorState::BusOff && config.manual_recovery && !self.recovers;
            let waits = due(channel, state);
            if waits.is_none() {
                seen.waiting_since = None;
            }
            seen.stands_still = is_gone
                || waits.is_some_and(|due| {
                    let (since, since_here) = *seen.waiting_since.get_or_insert((status.ticks, now));
                    // By both clocks: an emulated device's may be much slower than ours, or much faster.
                    status.ticks.saturating_sub(since.max(due)) >= patience_ticks
                        && now.saturating_duration_since(since_here) >= PATIENCE
                });
        }
        Ok(self.channels.iter().any(|seen| seen.stands_still))
    }

    /// Why frames were not sent, on the channel that has most of them. The channels must still be open.
    pub fn cause(&mut self) -> Result<Cause, DeviceError> {
        self.take_records()?;
        let status = self.device.status()?;
        let clock_hz = self.device.hello().can_clock_hz;
        // A closed channel has no frames, and explains none.
        let seen = self.channels.iter().zip(&status.channels).filter(|(_, state)| state.open.is_some());
        let worst = seen.max_by_key(|(seen, _)| {
            (seen.stands_still, seen.failed() + seen.overtaken, seen.errors_since.cause().is_some())
        });
        Ok(worst.map_or(Cause::Unknown, |(seen, status)| seen.cause(status, clock_hz)))
    }

    fn take_records(&mut self) -> Result<(), DeviceError> {
        let Some(records) = &mut self.records else { return Ok(()) };
        while let Some(batch) = records.next_batch(Duration::ZERO)? {
            if batch.is_empty() {
                break;
            }
            take(&mut self.channels, &batch);
            records.recycle(batch);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_wire::BitTiming;
    use cantap_wire::message::ChannelConfig;

    const CLOCK_HZ: u32 = 36_000_000;

    fn status(state: ErrorState) -> ChannelStatus {
        let timing = BitTiming::choose(CLOCK_HZ, 500_000, None).unwrap();
        ChannelStatus {
            open: Some(ChannelConfig::listen_only(timing)),
            state,
            tec: 0,
            rec: 0,
            last_error: None,
            frames: 0,
            lost_controller: 0,
            lost_queue: 0,
            bus_errors: 0,
            transmitted: 0,
            transmit_failures: 0,
            tx_pending: 1,
        }
    }

    fn seen(events: &[TraceEvent], ends: &[TransmitFailure]) -> Seen {
        let mut seen = Seen::default();
        for (at, event) in (0..).zip(events) {
            seen.push(&TraceRecord { time_ns: at * 1_000_000, device_ns: None, channel: 1, event: *event });
        }
        for reason in ends {
            let result = Err(*reason);
            seen.note(&Transmission { channel: Channel::Can1, tag: 0, ticks: 0, time_ns: 0, result });
        }
        seen
    }

    fn frame(direction: Direction, text: &str) -> TraceEvent {
        TraceEvent::Frame { frame: text.parse().unwrap(), direction, late: false }
    }

    fn error(kind: BusErrorKind) -> TraceEvent {
        TraceEvent::BusError { kind: Some(kind), counters: None }
    }

    fn cause(mut seen: Seen, stands_still: bool) -> Cause {
        seen.stands_still = stands_still;
        seen.cause(&status(ErrorState::Active), CLOCK_HZ)
    }

    #[test]
    fn what_stands_still_is_explained_by_what_was_seen_since_the_last_frame_of_ours() {
        let (ack, bit) = (error(BusErrorKind::Acknowledgment), error(BusErrorKind::BitDominant));
        let ours = frame(Direction::Tx, "123#");
        assert_eq!(cause(seen(&[bit, ours, ack], &[]), true), Cause::Unacknowledged);
        assert_eq!(cause(seen(&[ack, ours, bit], &[]), true), Cause::Destroyed);
        assert_eq!(cause(seen(&[ack, ours], &[]), true), Cause::Unknown);
        // Only a receiver finds those: other nodes cannot send either.
        assert_eq!(cause(seen(&[error(BusErrorKind::Stuff)], &[]), true), Cause::Destroyed);
        let off = TraceEvent::State { state: ErrorState::BusOff, counters: None };
        assert_eq!(cause(seen(&[bit, off], &[]), true), Cause::BusOff);
        assert_eq!(cause(seen(&[off, ours], &[]), true), Cause::Unknown);
    }

    #[test]
    fn a_bus_is_full_only_with_the_load_to_show_for_it() {
        let text = "0F0#1122334455667788";
        let others = frame(Direction::Rx, text);
        // A quarter of each millisecond does not make the bus full.
        assert_eq!(cause(seen(&[others; 200], &[]), true), Cause::Unknown);
        let length_ns = i64::from(crate::bits_on_bus(&text.parse().unwrap())) * 2_000;
        let mut full = Seen::default();
        for at in 0..1000 {
            full.push(&TraceRecord { time_ns: at * length_ns, device_ns: None, channel: 1, event: others });
        }
        assert_eq!(cause(full, true), Cause::BusFull { load_pct: Some(100.0) });
    }

    #[test]
    fn reasons_that_the_device_gave_count_where_nothing_waits() {
        use TransmitFailure::{ArbitrationLost, BusError, BusOff, Overtaken};
        let ours = frame(Direction::Tx, "123#");
        let (ack, bit) = (error(BusErrorKind::Acknowledgment), error(BusErrorKind::BitRecessive));
        // One-shot: the errors came before the frames that got through.
        assert_eq!(cause(seen(&[bit, bit, ours], &[BusError; 2]), false), Cause::Destroyed);
        assert_eq!(cause(seen(&[ack, ack, ours], &[BusError; 2]), false), Cause::Unacknowledged);
        assert_eq!(
            cause(seen(&[], &[ArbitrationLost, ArbitrationLost, BusError]), false),
            Cause::ArbitrationLost
        );
        assert_eq!(cause(seen(&[ours], &[BusOff]), false), Cause::BusOff);
        // A period that passed is not a failed frame.
        let overtaken = seen(&[ours], &[Overtaken { periods: 5 }, Overtaken { periods: 2 }]);
        assert_eq!((overtaken.failed(), overtaken.overtaken), (0, 7));
        assert_eq!(cause(overtaken, false), Cause::Overtaken);
        assert_eq!(cause(seen(&[ours, ack], &[Overtaken { periods: 5 }]), false), Cause::Unacknowledged);
    }
}
