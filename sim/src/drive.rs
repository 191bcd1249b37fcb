//! What the firmware does to a bus, measured on the bus itself: how soon it replies, how well it keeps times, how
//! much it can send. For tests, which hold it against limits, and for the benchmark, which prints it.

use cantap_wire::message::{ChannelConfig, Filter, FrameKind, Mode, Periodic, Trigger, TxFrame};
use cantap_wire::{Channel, Command, Frame, Id, Reply};

use crate::bus::bits::bus_bits;
use crate::bus::{BitTime, BusFrame, Member, Node};
use crate::rig::{MS, Rig, RigError, timing};
use crate::traffic::{Frames, Kind, Script};
use crate::{CYCLES_PER_SECOND, CYCLES_PER_US};

const MEGABIT: u32 = 1_000_000;
const CHANNEL: Channel = Channel::Can1;
/// The device's ticks per microsecond.
const TICKS_PER_US: u64 = 12;
/// Bits between two frames.
const INTERMISSION_BITS: u64 = 3;

/// Least and most of what was measured, in microseconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    /// Least.
    pub min_us: f64,
    /// Most.
    pub max_us: f64,
}

impl Range {
    fn of(cycles: impl Iterator<Item = i64>) -> Option<Self> {
        cycles.fold(None, |range: Option<Self>, cycles| {
            let us = cycles as f64 / CYCLES_PER_US as f64;
            let Self { min_us, max_us } = range.unwrap_or(Self { min_us: us, max_us: us });
            Some(Self { min_us: min_us.min(us), max_us: max_us.max(us) })
        })
    }

    /// From the least to the most.
    pub fn width_us(&self) -> f64 {
        self.max_us - self.min_us
    }
}

/// Opens channel 1 to take part in a bus at 1 Mbit/s with a node that acknowledges.
pub fn join(rig: &mut Rig) -> Result<(), RigError> {
    let config = ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing(MEGABIT)?) };
    rig.open(CHANNEL, config)?;
    rig.machine.board().wires[CHANNEL.index()].add(Node::new(BitTime::of_rate(MEGABIT)));
    Ok(())
}

/// Frames that cross channel 1's bus in the next `cycles`.
pub fn watch(rig: &mut Rig, cycles: u64) -> Result<Vec<BusFrame>, RigError> {
    let until = rig.now() + cycles;
    rig.machine.run_until(until)?;
    Ok(rig.machine.board().wires[CHANNEL.index()].take_history())
}

fn ours(frames: &[BusFrame]) -> impl Iterator<Item = &BusFrame> {
    frames.iter().filter(|frame| frame.sender == Member::Controller(CHANNEL.index()) && frame.error.is_none())
}

/// From the end of a frame (its last end-of-frame bit) to the start of the reply that it calls for; the
/// intermission of 3 µs is part of it.
pub fn reply_latency(rig: &mut Rig) -> Result<Option<Range>, RigError> {
    const CALLS: u64 = 100;
    const EVERY_US: u64 = 733;
    let (call, reply) = (frame(0x100), frame(0x200));
    let filter = Filter { extended: false, kind: FrameKind::Any, id: 0x100, mask: Id::MAX_STANDARD };
    rig.ask(Command::SetTrigger {
        channel: CHANNEL,
        slot: 0,
        entry: Some(Trigger { filter, reply, count: 0 }),
    })?;
    let from = rig.now() + MS;
    let calls = (0..CALLS).map(|n| (from + n * EVERY_US * CYCLES_PER_US, call)).collect();
    let caller = Node::new(BitTime::of_rate(MEGABIT)).with_source(Script::new(calls));
    rig.machine.board().wires[CHANNEL.index()].add(caller);
    let crossed = watch(rig, 2 * MS + CALLS * EVERY_US * CYCLES_PER_US)?;
    let replied = crossed.windows(2).filter(|pair| pair[0].frame == call && pair[1].frame == reply);
    let latencies: Vec<i64> = replied.map(|pair| (pair[1].start - pair[0].end) as i64).collect();
    rig.ask(Command::SetTrigger { channel: CHANNEL, slot: 0, entry: None })?;
    // A call that was not replied to at once is no measurement but a failure.
    Ok(Range::of(latencies.iter().copied()).filter(|_| latencies.len() as u64 == CALLS))
}

/// How far the intervals of a periodic frame are from its period.
pub fn periodic_jitter(rig: &mut Rig, period_us: u64) -> Result<Option<Range>, RigError> {
    const COUNT: u64 = 100;
    let period_ticks = (period_us * TICKS_PER_US) as u32;
    let modifiers = [].into_iter().collect();
    let entry = Periodic { frame: frame(0x300), period_ticks, count: COUNT as u32, modifiers };
    rig.ask(Command::SetPeriodic { channel: CHANNEL, slot: 0, entry: Some(entry) })?;
    let crossed = watch(rig, (COUNT + 2) * period_us * CYCLES_PER_US)?;
    let starts: Vec<u64> = ours(&crossed).map(|frame| frame.start).collect();
    let period = (period_us * CYCLES_PER_US) as i64;
    // The first was on the bus before the watch began, perhaps.
    let whole = starts.len() as u64 >= COUNT - 1;
    Ok(Range::of(starts.windows(2).map(|pair| (pair[1] - pair[0]) as i64 - period)).filter(|_| whole))
}

/// How late timed frames start, at a load in per cent: the range's width is the error of their spacing.
pub fn timed_start(rig: &mut Rig, load_percent: f64) -> Result<Option<Range>, RigError> {
    const COUNT: usize = 240;
    const LEAD_US: u64 = 60_000;
    let Reply::Time(now) = rig.ask(Command::Time)? else { return Ok(None) };
    let (cycle, mut frames) = (rig.now(), Frames::new(Kind::Mix, 7));
    let mut at_ticks = now + LEAD_US * TICKS_PER_US;
    let mut planned = Vec::new();
    for tag in 0..COUNT as u32 {
        let frame = frames.next_frame();
        planned.push(TxFrame { tag, frame, at_ticks: Some(at_ticks) });
        at_ticks += (f64::from(bus_bits(&frame)) * TICKS_PER_US as f64 * 100.0 / load_percent).ceil() as u64;
    }
    for frames in planned.chunks(cantap_wire::message::MAX_SEND) {
        rig.ask(Command::Send { channel: CHANNEL, frames: frames.iter().copied().collect() })?;
    }
    let length_us = (at_ticks - now) / TICKS_PER_US;
    let end = cycle + (length_us + 2_000) * CYCLES_PER_US;
    let crossed = watch(rig, end - rig.now())?;
    let sent: Vec<&BusFrame> = ours(&crossed).collect();
    let in_order = sent.iter().map(|sent| sent.frame).eq(planned.iter().map(|planned| planned.frame));
    let late = sent.iter().zip(&planned).map(|(sent, planned)| {
        let ticks_ahead = planned.at_ticks.unwrap_or(now) - now;
        // The answer to `Time` came some time before `cycle`; that is the same for all.
        sent.start as i64 - (cycle + ticks_ahead * CYCLES_PER_US / TICKS_PER_US) as i64
    });
    Ok(Range::of(late).filter(|_| in_order))
}

/// The load in per cent that frames with eight bytes make, queued as fast as the device takes them.
pub fn back_to_back_load(rig: &mut Rig) -> Result<f64, RigError> {
    const COUNT: usize = 240;
    let mut frames = Frames::new(Kind::Std8, 3);
    let planned: Vec<TxFrame> =
        (0..COUNT as u32).map(|tag| TxFrame { tag, frame: frames.next_frame(), at_ticks: None }).collect();
    let Reply::Time(now) = rig.ask(Command::Time)? else { return Ok(0.0) };
    // All wait for one moment, so that the host's own pace is not what is measured.
    let at_ticks = Some(now + 60_000 * TICKS_PER_US);
    for frames in planned.chunks(cantap_wire::message::MAX_SEND) {
        let frames = frames.iter().map(|frame| TxFrame { at_ticks, ..*frame }).collect();
        rig.ask(Command::Send { channel: CHANNEL, frames })?;
    }
    let crossed = watch(rig, CYCLES_PER_SECOND / 5)?;
    let sent: Vec<&BusFrame> = ours(&crossed).collect();
    let (Some(first), Some(last)) = (sent.first(), sent.last()) else { return Ok(0.0) };
    if sent.len() != COUNT {
        return Ok(0.0);
    }
    let bits: u64 = sent.iter().map(|sent| u64::from(bus_bits(&sent.frame))).sum();
    let bit = BitTime::of_rate(MEGABIT);
    Ok(bit.cycles(bits) as f64 * 100.0 / (last.end + bit.cycles(INTERMISSION_BITS) - first.start) as f64)
}

fn frame(id: u32) -> Frame {
    Frame::from_bus(Id::standard_truncated(id), false, 2, [0xA5, 0x5A, 0, 0, 0, 0, 0, 0])
}
