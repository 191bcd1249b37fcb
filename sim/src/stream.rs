//! A host that streams frames for transmission, as the host library does: several requests under way, but never more
//! frames than the device's queue holds. It also tracks what became of each, on the bus and according to the device.

use std::collections::VecDeque;

use crate::board::CLOCK;
use cantap_wire::message::{ChannelConfig, MAX_SEND, Mode, TxFrame};
use cantap_wire::{CHANNELS, Channel, Command, Event};

use crate::drive::Range;
use crate::rig::{MS, Rig, RigError, timing};
use crate::{CYCLES_PER_SECOND, CYCLES_PER_US};
use cantap_emu::bus::bits::bus_bits;
use cantap_emu::bus::{BitTime, BusFrame, Member, Node};
use cantap_emu::traffic::{Frames, Kind};

const MEGABIT: u32 = 1_000_000;
/// The device's clock.
const TICKS_PER_US: u64 = 12;
const CYCLES_PER_TICK: u64 = CYCLES_PER_US / TICKS_PER_US;
/// Requests of a channel under way: half of the host library's.
const REQUESTS: usize = 3;
/// Time from the plan to its first frame.
const LEAD: u64 = 100 * MS;
/// If, after its first frame, nothing in a stream ends for this long, it has come to a halt.
const STANDSTILL: u64 = 200 * MS;
/// Bits between two frames.
const INTERMISSION_BITS: u64 = 3;

/// What became of a channel's frames.
#[derive(Clone, Debug, Default)]
pub struct Sent {
    /// Those that crossed the bus without error, in order.
    pub crossed: Vec<BusFrame>,
    /// Confirmations in order: tag, and core cycle of the stamp.
    pub confirmed: Vec<(u32, u64)>,
    /// Frames that the device reported as failed, and requests that it refused.
    pub failed: usize,
}

impl Sent {
    /// Whether every frame planned crossed the bus once, in order, and was confirmed in order.
    pub fn is_all_of(&self, planned: &[TxFrame]) -> bool {
        let crossed = self.crossed.iter().map(|crossed| crossed.frame);
        let confirmed = self.confirmed.iter().map(|(tag, _)| *tag);
        self.failed == 0
            && crossed.eq(planned.iter().map(|planned| planned.frame))
            && confirmed.eq(planned.iter().map(|planned| planned.tag))
    }

    /// Stamps of the confirmations, minus the moment at which the transmission was valid: the end of the frame.
    pub fn stamps(&self) -> Option<Range> {
        let stamps = self.confirmed.iter().zip(&self.crossed);
        Range::of(stamps.map(|((_, stamp), crossed)| *stamp as i64 - crossed.end as i64))
    }
}

/// Opens channels as participants of buses at 1 Mbit/s, each with a node that acknowledges.
pub fn join(rig: &mut Rig, channels: &[Channel]) -> Result<(), RigError> {
    for &channel in channels {
        let config = ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing(MEGABIT)?) };
        rig.open(channel, config)?;
        rig.machine.board().wires[channel.index()].add(Node::new(BitTime::of_rate(MEGABIT, CLOCK)));
    }
    Ok(())
}

/// A lane of the stream.
struct Lane<'p> {
    channel: Channel,
    planned: &'p [TxFrame],
    handed_over: usize,
    requests: VecDeque<u16>,
    sent: Sent,
}

/// Sends everything planned for each channel and waits until all of it has ended, or the stream comes to a halt.
pub fn stream(rig: &mut Rig, plans: [&[TxFrame]; CHANNELS]) -> Result<[Sent; CHANNELS], RigError> {
    let origin = rig.clock_origin();
    let mut lanes = Channel::ALL.map(|channel| Lane {
        channel,
        planned: plans[channel.index()],
        handed_over: 0,
        requests: VecDeque::new(),
        sent: Sent::default(),
    });
    rig.watch();
    let mut seen = rig.events().len();
    let mut quiet_since = rig.now() + LEAD;
    while lanes.iter().any(|lane| lane.sent.confirmed.len() + lane.sent.failed < lane.planned.len())
        && rig.now() < quiet_since + STANDSTILL
    {
        for lane in &mut lanes {
            lane.hand_over(rig);
        }
        rig.run_for(MS / 4)?;
        for lane in &mut lanes {
            lane.take_answers(rig);
        }
        if rig.events().len() > seen {
            quiet_since = quiet_since.max(rig.now());
        }
        for (ticks, event) in &rig.events()[seen..] {
            match event {
                Event::Transmitted { channel, tag, .. } => {
                    let stamp = origin + ticks * CYCLES_PER_TICK;
                    lanes[channel.index()].sent.confirmed.push((*tag, stamp));
                }
                Event::TransmitFailed { channel, .. } => lanes[channel.index()].sent.failed += 1,
                _ => {}
            }
        }
        seen = rig.events().len();
    }
    let watched = rig.take_watched();
    Ok(lanes.map(|lane| {
        let own = Member::Controller(lane.channel.index());
        let crossed = watched[lane.channel.index()].iter();
        let crossed = crossed.filter(|frame| frame.sender == own && frame.error.is_none()).copied().collect();
        Sent { crossed, ..lane.sent }
    }))
}

impl Lane<'_> {
    fn take_answers(&mut self, rig: &mut Rig) {
        while let Some(response) = self.requests.front().and_then(|id| rig.session.response(*id)) {
            self.requests.pop_front();
            self.sent.failed += usize::from(response.result.is_err());
        }
    }

    /// Sends requests while there is room for their frames.
    fn hand_over(&mut self, rig: &mut Rig) {
        let ended = self.sent.confirmed.len() + self.sent.failed;
        while self.requests.len() < REQUESTS {
            let room = rig.tx_queue() - (self.handed_over - ended);
            let rest = &self.planned[self.handed_over..];
            let count = room.min(MAX_SEND).min(rest.len());
            if count == 0 {
                return;
            }
            let frames = rest[..count].iter().copied().collect();
            let (id, bytes) = rig.session.request(Command::Send { channel: self.channel, frames });
            rig.with_host(|host, _| host.send(&bytes));
            self.requests.push_back(id);
            self.handed_over += count;
        }
    }
}

/// How a replay kept its times.
#[derive(Clone, Copy, Debug)]
pub struct Replayed {
    /// Start on the bus minus the planned time; the range's width is the error of the spacing.
    pub late: Range,
    /// Stamps of the confirmations.
    pub stamps: Range,
}

/// Streams `seconds` of timed frames to open channels: random ones of every kind that occupy `load_percent` of each bus, at
/// separate times for each channel. `None` if one is missing, doubled or out of order.
pub fn replay(
    rig: &mut Rig,
    channels: &[Channel],
    load_percent: f64,
    seconds: f64,
) -> Result<Option<Vec<Replayed>>, RigError> {
    let origin = rig.clock_origin();
    let first = (rig.now() + LEAD - origin) / CYCLES_PER_TICK;
    let mut plans: [Vec<TxFrame>; CHANNELS] = Default::default();
    for &channel in channels {
        let mut frames = Frames::new(Kind::Mix, 7 + channel.index() as u64);
        let mut at = first as f64;
        while at < first as f64 + seconds * 1e6 * TICKS_PER_US as f64 {
            let frame = frames.next_frame();
            let tag = plans[channel.index()].len() as u32;
            plans[channel.index()].push(TxFrame { tag, frame, at_ticks: Some(at.ceil() as u64) });
            at += f64::from(bus_bits(&frame)) * TICKS_PER_US as f64 * 100.0 / load_percent;
        }
    }
    let sent = stream(rig, plans.each_ref().map(Vec::as_slice))?;
    let replayed = channels.iter().map(|channel| {
        let (sent, planned) = (&sent[channel.index()], &plans[channel.index()]);
        let due = planned.iter().map(|planned| origin + planned.at_ticks.unwrap_or(0) * CYCLES_PER_TICK);
        let late = sent.crossed.iter().zip(due).map(|(crossed, due)| crossed.start as i64 - due as i64);
        let late = Range::of(late).filter(|_| sent.is_all_of(planned))?;
        Some(Replayed { late, stamps: sent.stamps()? })
    });
    Ok(replayed.collect())
}

/// How a bus was filled.
#[derive(Clone, Copy, Debug)]
pub struct Filled {
    /// Share of the time with a frame or its intermission on the bus, in per cent.
    pub load_percent: f64,
    /// How many frames.
    pub frames: usize,
    /// Stamps of the confirmations.
    pub stamps: Range,
}

/// Streams `seconds` of frames to open channels, as fast as the buses take them. `None` if one is missing, doubled
/// or out of order.
pub fn fill(
    rig: &mut Rig,
    channels: &[Channel],
    kind: Kind,
    seconds: f64,
) -> Result<Option<Vec<Filled>>, RigError> {
    let bit = BitTime::of_rate(MEGABIT, CLOCK);
    let mut plans: [Vec<TxFrame>; CHANNELS] = Default::default();
    for &channel in channels {
        let (mut frames, mut bits) = (Frames::new(kind, 3 + channel.index() as u64), 0);
        while bit.cycles(bits) < (seconds * CYCLES_PER_SECOND as f64) as u64 {
            let frame = frames.next_frame();
            bits += u64::from(bus_bits(&frame));
            let tag = plans[channel.index()].len() as u32;
            plans[channel.index()].push(TxFrame { tag, frame, at_ticks: None });
        }
    }
    let sent = stream(rig, plans.each_ref().map(Vec::as_slice))?;
    let filled = channels.iter().map(|channel| {
        let (sent, planned) = (&sent[channel.index()], &plans[channel.index()]);
        let (first, last) = (sent.crossed.first()?, sent.crossed.last()?);
        let bits: u64 = sent.crossed.iter().map(|crossed| u64::from(bus_bits(&crossed.frame))).sum();
        let span = last.end + bit.cycles(INTERMISSION_BITS) - first.start;
        let load_percent = 100.0 * bit.cycles(bits) as f64 / span as f64;
        let stamps = sent.stamps().filter(|_| sent.is_all_of(planned))?;
        Some(Filled { load_percent, frames: sent.crossed.len(), stamps })
    });
    Ok(filled.collect())
}
