//! Turns bytes into trace records: decodes a device's stream, tightens stamps, maps them to UTC and counts.
//! It has no threads and no clock and does no I/O: the reader thread drives it, and so do a listener, tests and the benchmark.

use std::ops::Add;

use cantap_wire::message::{EndReason, Status, capability};
use cantap_wire::record::{Event, LossStage, Record, Stamp, TransmitFailure};
use cantap_wire::{CHANNELS, Channel, Corruption, Decoded, Decoder, Reply, Response, TransmittedFd};

use super::clock::{ClockMap, SofMark, Ticks, UtcNs};
use super::stamps::{BitLengths, Stamped, tighten};
use crate::{Direction, TraceEvent, TraceFrame, TraceRecord};

/// Bytes decoded at a time, few enough that their records stay in the processor's cache through every pass.
pub const PIECE_BYTES: usize = 4096;

/// A device's times are in order to within a tenth of a second: a USB mark can be up to a millisecond older than the record before it.
const DISORDER_PER_S: u64 = 10;

/// What was received and lost on one channel since the session began.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ChannelCounters {
    /// Frames that arrived from the device, at this program or at the server of a shared board.
    pub received: u64,
    /// Times the controller's FIFO overran: at least this many frames were lost.
    pub lost_controller: u64,
    /// Frames that found the device's queue full.
    pub lost_queue: u64,
    /// Frames lost between device and host.
    pub lost_link: u64,
    /// Frames that arrived but that a slow consumer lost.
    pub lost_host: u64,
    /// Frames that a gateway was to send on this channel and dropped, because more came than the bus took.
    pub lost_gateway: u64,
    /// How often an unknown number of frames was lost, or may have been: where the device was deaf or its buffer was full, and once each time
    /// that the channel starts on a device that does not count its losses.
    pub unknown: u64,
    /// How often the device was off the bus while the channel was open, because another client of its server changed the mode: an unknown
    /// number of frames is missing each time.
    pub off_bus: u64,
    /// For how long in total, in nanoseconds of the device's clock; as far as its return was seen.
    pub off_bus_ns: u64,
}

impl ChannelCounters {
    /// Frames handed to the consumer.
    pub const fn delivered(&self) -> u64 {
        self.received - self.lost_host
    }

    /// Frames lost on the way to the host at any stage that can count them. Others are missing where none can: see [`Self::unknown`] and [`Self::off_bus`].
    pub const fn lost(&self) -> u64 {
        self.lost_controller + self.lost_queue + self.lost_link + self.lost_host
    }
}

/// What was received and lost since the session began.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Each channel.
    pub channels: [ChannelCounters; CHANNELS],
    /// Bytes that came from the device.
    pub bytes: u64,
    /// Messages discarded because they were damaged. Their content is counted as lost on the link.
    pub corrupt: u64,
}

impl Add for ChannelCounters {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            received: self.received + other.received,
            lost_controller: self.lost_controller + other.lost_controller,
            lost_queue: self.lost_queue + other.lost_queue,
            lost_link: self.lost_link + other.lost_link,
            lost_host: self.lost_host + other.lost_host,
            lost_gateway: self.lost_gateway + other.lost_gateway,
            unknown: self.unknown + other.unknown,
            off_bus: self.off_bus + other.off_bus,
            off_bus_ns: self.off_bus_ns + other.off_bus_ns,
        }
    }
}

impl Add for Counters {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            channels: std::array::from_fn(|channel| self.channels[channel] + other.channels[channel]),
            bytes: self.bytes + other.bytes,
            corrupt: self.corrupt + other.corrupt,
        }
    }
}

/// How a transmission ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Transmission {
    /// The channel.
    pub channel: Channel,
    /// The request's tag.
    pub tag: u32,
    /// Device time, in ticks.
    pub ticks: u64,
    /// UTC in nanoseconds since the Unix epoch.
    pub time_ns: i64,
    /// The frame as sent, or why not.
    pub result: Result<TraceFrame, TransmitFailure>,
}

/// What the stream contains besides records.
#[derive(Clone, Debug, PartialEq, Eq)]
#[expect(clippy::large_enum_variant, reason = "handed on at once, a few in a second")]
pub enum Notice {
    /// An answer.
    Response(Response),
    /// The device speaks this other protocol version.
    OtherProtocol(u16),
    /// Nothing more follows from this channel.
    Stopped(Channel),
    /// The stream started over: the session is no longer ours.
    WentBack,
    /// The device's times contradict one another: its stamps cannot be trusted.
    TimesDisagree,
    /// The device has ended the session.
    Ended {
        /// The time after which nothing was captured, in UTC nanoseconds since the Unix epoch.
        time_ns: i64,
        /// Why.
        reason: EndReason,
    },
    /// A transmission ended.
    Transmission(Transmission),
}

/// One device's stream.
pub struct Intake {
    decoder: Decoder,
    /// What was decoded but not yet placed in time.
    stamped: Vec<Stamped>,
    records: Vec<TraceRecord>,
    lengths: BitLengths,
    clock: ClockMap,
    /// The last record's time.
    last_ns: i64,
    counters: Counters,
    /// Device time of the latest record, in ticks.
    latest_ticks: u64,
    /// Device time since when it is off each bus, in ticks, if it is.
    off_bus_since: [Option<u64>; CHANNELS],
    /// Ticks per second of the device's times.
    tick_hz: u32,
    /// How far a time may be before that of the preceding record, in ticks.
    disorder_ticks: u64,
    /// Whether the device counts its losses.
    counts_losses: bool,
    /// Whether its times are those of its own clock: another maker's adapter's have been placed in this computer's time already.
    has_own_clock: bool,
    /// Whether `Hello` was answered; anything earlier belongs to another program's session.
    in_session: bool,
}

impl Intake {
    /// An intake that waits for the answer to `Hello`.
    pub fn new() -> Self {
        Self {
            decoder: Decoder::new(),
            stamped: Vec::new(),
            records: Vec::new(),
            lengths: BitLengths::default(),
            clock: ClockMap::new(cantap_tick_hz_before_hello(), UtcNs(0)),
            last_ns: i64::MIN,
            counters: Counters::default(),
            latest_ticks: 0,
            off_bus_since: [None; CHANNELS],
            tick_hz: cantap_tick_hz_before_hello(),
            disorder_ticks: u64::MAX,
            counts_losses: true,
            has_own_clock: true,
            in_session: false,
        }
    }

    /// Takes [`PIECE_BYTES`] or fewer (more works, but slower) that have arrived by `now`, reports notices, and returns the records, to
    /// be taken out of the vector.
    pub fn push(
        &mut self,
        bytes: &[u8],
        now: UtcNs,
        mut notice: impl FnMut(Notice),
    ) -> &mut Vec<TraceRecord> {
        let Self {
            decoder,
            stamped,
            records,
            counters,
            clock,
            in_session,
            lengths,
            last_ns,
            latest_ticks,
            off_bus_since,
            tick_hz,
            disorder_ticks,
            counts_losses,
            has_own_clock,
        } = self;
        let mut last_ticks = None;
        let mut ended = None;
        counters.bytes += bytes.len() as u64;
        decoder.push(bytes, |decoded| match decoded {
            Decoded::Record { .. } | Decoded::BatchesLost { .. } if !*in_session => {}
            Decoded::Record { ticks, record: Record::Received(received) } => {
                last_ticks = Some(ticks);
                counters.channels[received.channel.index()].received += 1;
                stamped.push(frame(received.channel, received.frame.into(), ticks, received.stamp));
            }
            Decoded::Record { ticks, record: Record::ReceivedFd(received) } => {
                last_ticks = Some(ticks);
                counters.channels[received.channel.index()].received += 1;
                stamped.push(frame(received.channel, received.frame.into(), ticks, received.stamp));
            }
            Decoded::Record { ticks, record: Record::TransmittedFd(sent) } => {
                last_ticks = Some(ticks);
                let TransmittedFd { channel, tag, frame } = sent;
                on_sent((channel, tag, frame.into()), Ticks(ticks), clock, stamped, &mut notice);
            }
            Decoded::Record { ticks, record: Record::Event(event) } => {
                last_ticks = Some(ticks);
                follow_bus(event, ticks, *tick_hz, off_bus_since, counters);
                if let (Event::Started { channel }, false) = (event, *counts_losses) {
                    counters.channels[channel.index()].unknown += 1;
                    let (at, channel) = (Ticks(ticks), channel.number());
                    stamped.push(Stamped { at, channel, event: TraceEvent::UNCOUNTED });
                }
                on_event(event, Ticks(ticks), counters, clock, stamped, &mut notice);
            }
            Decoded::BatchesLost { frames, .. } => {
                for (channel, count) in Channel::ALL.into_iter().zip(frames) {
                    counters.channels[channel.index()].lost_link += u64::from(count);
                    // Its time is known once the next record is; zero means "not earlier than the last".
                    let at = Ticks(last_ticks.unwrap_or(0));
                    stamped.extend(lost(channel, at, LossStage::Link, count, false));
                }
            }
            Decoded::Response(response) => {
                // A later answer was requested by another program, or by us a second time before the first
                // arrived.
                if let (Ok(Reply::Hello(answer)), false) = (&response.result, *in_session) {
                    // What comes before belongs to a session that is over.
                    *in_session = true;
                    stamped.clear();
                    records.clear();
                    last_ticks = None;
                    *latest_ticks = 0;
                    *tick_hz = answer.tick_hz.max(1);
                    *counts_losses = answer.counts_losses();
                    *disorder_ticks = u64::from(answer.tick_hz) / DISORDER_PER_S;
                    *counters = Counters::default();
                    *off_bus_since = [None; CHANNELS];
                    *lengths = BitLengths::default();
                    *has_own_clock = answer.capabilities & capability::ADAPTER == 0;
                    if !*has_own_clock {
                        lengths.leave_out_sent();
                    }
                    *last_ns = i64::MIN;
                    *clock = ClockMap::new(answer.tick_hz, now);
                }
                notice(Notice::Response(response.clone()));
            }
            Decoded::Ended { ticks, reason } if *in_session => {
                *in_session = false;
                ended = Some((ticks, reason));
            }
            Decoded::Ended { .. } => {}
            Decoded::Corrupt(corruption) => {
                counters.corrupt += 1;
                if *in_session && matches!(corruption, Corruption::OutOfOrder { .. }) {
                    notice(Notice::WentBack);
                }
            }
            Decoded::OtherProtocol(version) => notice(Notice::OtherProtocol(version)),
        });
        let went_back = last_ticks.is_some_and(|last| latest_ticks.saturating_sub(last) > *disorder_ticks);
        if went_back {
            self.withhold();
            notice(Notice::TimesDisagree);
        } else {
            *latest_ticks = (*latest_ticks).max(last_ticks.unwrap_or(0));
        }
        self.place_in_time();
        if let Some((ticks, reason)) = ended {
            notice(Notice::Ended { time_ns: self.clock.utc(Ticks(ticks)).0, reason });
        }
        &mut self.records
    }

    /// The records that wait to be taken out of the vector.
    pub const fn records(&mut self) -> &mut Vec<TraceRecord> {
        &mut self.records
    }

    /// Counts the new frames as lost, because their times are unknown.
    fn withhold(&mut self) {
        let at = Ticks(self.latest_ticks);
        let mut frames = [0; CHANNELS];
        for stamped in self.stamped.drain(..) {
            let is_received = matches!(stamped.event, TraceEvent::Frame { direction: Direction::Rx, .. });
            frames[usize::from(stamped.channel == 2)] += u32::from(is_received);
        }
        for (channel, count) in Channel::ALL.into_iter().zip(frames) {
            let counters = &mut self.counters.channels[channel.index()];
            counters.received -= u64::from(count);
            counters.lost_link += u64::from(count);
            self.stamped.extend(lost(channel, at, LossStage::Link, count, false));
        }
    }

    /// Tightens the new records, maps them to UTC and puts them in order. If the stamps of one channel were
    /// moved back, it may now come before the other channel; nothing moves to before what was already handed
    /// over.
    fn place_in_time(&mut self) {
        tighten(&mut self.stamped, &self.lengths);
        let mut sorted = true;
        let mut previous = self.last_ns;
        for Stamped { at, channel, event } in self.stamped.drain(..) {
            let time_ns = self.clock.utc(at).0.max(self.last_ns);
            sorted &= time_ns >= previous;
            previous = time_ns;
            let device_ns = self.has_own_clock.then(|| at.device_ns(self.tick_hz)).flatten();
            self.records.push(TraceRecord { time_ns, device_ns, channel, event });
        }
        if !sorted {
            self.sort();
        }
        if let Some(last) = self.records.last() {
            self.last_ns = last.time_ns;
        }
    }

    /// Orders by time and keeps each channel's order: no record overtakes another of its own channel.
    fn sort(&mut self) {
        let mut latest = [i64::MIN; CHANNELS];
        for record in &mut self.records {
            let latest = &mut latest[usize::from(record.channel == 2)];
            record.time_ns = record.time_ns.max(*latest);
            *latest = record.time_ns;
        }
        self.records.sort_by_key(|record| record.time_ns);
    }

    /// Adds a round trip of the clock. `latest_ticks`: the time of the latest record when the device was asked; what had been heard by then
    /// had happened. (Records heard since may be later than the answer: a server passes them on without waiting for its answers.)
    /// Returns false if the answer is earlier than that, which is impossible.
    #[must_use]
    pub fn add_time(&mut self, ticks: Ticks, latest_ticks: u64, asked: UtcNs, answered: UtcNs) -> bool {
        let is_possible = latest_ticks.saturating_sub(ticks.0) <= self.disorder_ticks;
        if is_possible {
            self.clock.add(ticks, asked, answered);
        }
        is_possible
    }

    /// The clock's map, for reading or settling.
    pub fn clock(&mut self) -> &mut ClockMap {
        &mut self.clock
    }

    /// The bit lengths, to be set when a channel opens.
    pub fn lengths(&mut self) -> &mut BitLengths {
        &mut self.lengths
    }

    /// Whether `Hello` was answered.
    pub const fn is_in_session(&self) -> bool {
        self.in_session
    }

    /// Device time of the latest record, in ticks.
    pub const fn latest_ticks(&self) -> u64 {
        self.latest_ticks
    }

    /// What was counted.
    pub const fn counters(&self) -> &Counters {
        &self.counters
    }

    /// Counts frames lost by the consumer.
    pub fn count_host_losses(&mut self, lost: [u32; CHANNELS]) {
        for (channel, lost) in self.counters.channels.iter_mut().zip(lost) {
            channel.lost_host += u64::from(lost);
        }
    }

    /// Adds losses that only the device's own counters show, at the end of a session.
    pub fn add_losses(&mut self, channel: Channel, stage: LossStage, count: u32) -> &mut Vec<TraceRecord> {
        let counters = &mut self.counters.channels[channel.index()];
        match stage {
            LossStage::Controller => counters.lost_controller += u64::from(count),
            LossStage::Queue => counters.lost_queue += u64::from(count),
            LossStage::Link => counters.lost_link += u64::from(count),
            LossStage::Host => counters.lost_host += u64::from(count),
            LossStage::Gateway => counters.lost_gateway += u64::from(count),
        }
        self.stamped.extend(lost(channel, Ticks(0), stage, count, stage == LossStage::Controller));
        self.place_in_time();
        &mut self.records
    }
}

impl Default for Intake {
    fn default() -> Self {
        Self::new()
    }
}

/// What a device's counters show beyond ours once both channels are closed: a lost batch may have contained loss records, and nothing after
/// the last batch reports its content.
pub fn unaccounted(status: &Status, counters: &Counters) -> Vec<(Channel, LossStage, u32)> {
    let missing = |device: u32, ours: u64| device.wrapping_sub(ours as u32);
    let of = |channel: Channel| {
        let (device, ours) = (&status.channels[channel.index()], &counters.channels[channel.index()]);
        let on_the_link =
            missing(device.frames.wrapping_sub(device.lost_queue), ours.received + ours.lost_link);
        [
            (channel, LossStage::Controller, missing(device.lost_controller, ours.lost_controller)),
            (channel, LossStage::Queue, missing(device.lost_queue, ours.lost_queue)),
            (channel, LossStage::Link, on_the_link),
        ]
    };
    let is_loss = |(_, _, count): &(Channel, LossStage, u32)| *count > 0 && *count < u32::MAX / 2;
    Channel::ALL.into_iter().flat_map(of).filter(is_loss).collect()
}

/// No record is kept before `Hello` gives the tick rate; any number will do.
const fn cantap_tick_hz_before_hello() -> u32 {
    1_000_000
}

#[inline]
fn frame(channel: Channel, frame: TraceFrame, ticks: u64, stamp: Stamp) -> Stamped {
    let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: stamp != Stamp::Exact };
    Stamped { at: Ticks(ticks), channel: channel.number(), event }
}

fn lost(channel: Channel, at: Ticks, stage: LossStage, count: u32, at_least: bool) -> Option<Stamped> {
    let event = TraceEvent::Lost { stage: Some(stage), count, at_least };
    (count > 0).then_some(Stamped { at, channel: channel.number(), event })
}

/// Counts when the device leaves a bus and comes back while the channel is open: a loss of an unknown number, and the channel's next start.
fn follow_bus(
    event: Event,
    ticks: u64,
    tick_hz: u32,
    since: &mut [Option<u64>; CHANNELS],
    counters: &mut Counters,
) {
    match event {
        Event::Lost { channel, stage: LossStage::Link, count: 0, at_least: true } => {
            counters.channels[channel.index()].off_bus += 1;
            since[channel.index()] = Some(ticks);
        }
        Event::Started { channel } => {
            let away = since[channel.index()].take().map_or(0, |since| ticks.saturating_sub(since));
            let away_ns = u128::from(away) * 1_000_000_000 / u128::from(tick_hz);
            let sum = &mut counters.channels[channel.index()].off_bus_ns;
            *sum = sum.saturating_add(u64::try_from(away_ns).unwrap_or(u64::MAX));
        }
        Event::Stopped { channel } => since[channel.index()] = None,
        _ => {}
    }
}

/// A frame of ours was on the bus.
fn on_sent(
    (channel, tag, frame): (Channel, u32, TraceFrame),
    at: Ticks,
    clock: &ClockMap,
    stamped: &mut Vec<Stamped>,
    notice: &mut impl FnMut(Notice),
) {
    let (ticks, time_ns) = (at.0, clock.utc(at).0);
    notice(Notice::Transmission(Transmission { channel, tag, ticks, time_ns, result: Ok(frame) }));
    let event = TraceEvent::Frame { frame, direction: Direction::Tx, late: false };
    stamped.push(Stamped { at, channel: channel.number(), event });
}

/// Everything that is not a received frame.
fn on_event(
    event: Event,
    at: Ticks,
    counters: &mut Counters,
    clock: &mut ClockMap,
    stamped: &mut Vec<Stamped>,
    notice: &mut impl FnMut(Notice),
) {
    let (channel, event) = match event {
        Event::Lost { channel, stage, count, at_least } => {
            let counters = &mut counters.channels[channel.index()];
            // On the link, this is a time off the bus, which has a count of its own.
            counters.unknown += u64::from(count == 0 && at_least && stage != LossStage::Link);
            match stage {
                LossStage::Controller => counters.lost_controller += u64::from(count),
                LossStage::Queue => counters.lost_queue += u64::from(count),
                LossStage::Link => counters.lost_link += u64::from(count),
                // A server of a shared board had them, but this client was too slow.
                LossStage::Host => {
                    counters.received += u64::from(count);
                    counters.lost_host += u64::from(count);
                }
                LossStage::Gateway => counters.lost_gateway += u64::from(count),
            }
            (channel, TraceEvent::Lost { stage: Some(stage), count, at_least })
        }
        Event::BusError { channel, kind, tec, rec } => {
            (channel, TraceEvent::BusError { kind: Some(kind), counters: Some((tec, rec)) })
        }
        Event::ErrorsSuppressed { channel, count } => (channel, TraceEvent::ErrorsSuppressed { count }),
        Event::State { channel, state, tec, rec } => {
            (channel, TraceEvent::State { state, counters: Some((tec, rec)) })
        }
        Event::Transmitted { channel, tag, frame } => {
            return on_sent((channel, tag, frame.into()), at, clock, stamped, notice);
        }
        Event::TransmitFailed { channel, tag, reason } => {
            let (ticks, time_ns) = (at.0, clock.utc(at).0);
            notice(Notice::Transmission(Transmission { channel, tag, ticks, time_ns, result: Err(reason) }));
            (channel, TraceEvent::TransmitFailed { tag, reason })
        }
        Event::Disturbed { channel, ticks } => {
            (channel, TraceEvent::Disturbed { length_ns: clock.nominal_ns(ticks.into()) })
        }
        Event::Stopped { channel } => return notice(Notice::Stopped(channel)),
        Event::SofMark { frame, doubled } => {
            return clock.mark(SofMark { frame, at, doubled });
        }
        Event::Started { .. } => return,
    };
    stamped.push(Stamped { at, channel: channel.number(), event });
}
