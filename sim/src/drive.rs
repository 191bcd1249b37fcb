//! What the firmware does to a bus, measured on the bus itself: how soon it replies, how well it keeps times, how
//! much it can send. For tests, which compare the figures with limits, and for the benchmark, which prints them.

use crate::board::CLOCK;
use cantap_wire::message::{Checksum, Filter, FrameKind, Modifier, Periodic, Trigger};
use cantap_wire::{Channel, Command, Frame, Id};

use crate::CYCLES_PER_US;
use crate::rig::{MS, Rig, RigError};
use cantap_emu::bus::{BitTime, BusFrame, Member, Node};
use cantap_emu::traffic::Script;

const MEGABIT: u32 = 1_000_000;
const CHANNEL: Channel = Channel::Can1;
/// The device's ticks per microsecond.
const TICKS_PER_US: u64 = 12;

/// Least and most of what was measured, in microseconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    /// Least.
    pub min_us: f64,
    /// Most.
    pub max_us: f64,
}

impl Range {
    pub(crate) fn of(cycles: impl Iterator<Item = i64>) -> Option<Self> {
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

/// Frames that cross channel 1's bus in the next `cycles`.
pub fn watch(rig: &mut Rig, cycles: u64) -> Result<Vec<BusFrame>, RigError> {
    let until = rig.now() + cycles;
    rig.machine.run_until(until)?;
    Ok(rig.machine.board().wires[CHANNEL.index()].take_history())
}

fn ours(frames: &[BusFrame]) -> impl Iterator<Item = &BusFrame> {
    frames.iter().filter(|frame| frame.sender == Member::Controller(CHANNEL.index()) && frame.error.is_none())
}

/// From the end of a frame (its last end-of-frame bit) to the start of the reply that it triggers; this
/// includes the intermission of 3 µs.
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
    let caller = Node::new(BitTime::of_rate(MEGABIT, CLOCK)).with_source(Script::new(calls));
    rig.machine.board().wires[CHANNEL.index()].add(caller);
    let crossed = watch(rig, 2 * MS + CALLS * EVERY_US * CYCLES_PER_US)?;
    let replied = crossed.windows(2).filter(|pair| pair[0].frame == call && pair[1].frame == reply);
    let latencies: Vec<i64> = replied.map(|pair| (pair[1].start - pair[0].end) as i64).collect();
    rig.ask(Command::SetTrigger { channel: CHANNEL, slot: 0, entry: None })?;
    // A trigger frame that was not replied to at once is a failure, not a measurement.
    Ok(Range::of(latencies.iter().copied()).filter(|_| latencies.len() as u64 == CALLS))
}

/// How far the intervals of a periodic frame deviate from its period.
pub fn periodic_jitter(rig: &mut Rig, period_us: u64) -> Result<Option<Range>, RigError> {
    const COUNT: u64 = 100;
    let period_ticks = (period_us * TICKS_PER_US) as u32;
    let modifiers = [].into_iter().collect();
    let entry = Periodic { frame: frame(0x300), period_ticks, count: COUNT as u32, modifiers };
    rig.ask(Command::SetPeriodic { channel: CHANNEL, slot: 0, entry: Some(entry) })?;
    let crossed = watch(rig, (COUNT + 2) * period_us * CYCLES_PER_US)?;
    let starts: Vec<u64> = ours(&crossed).map(|frame| frame.start).collect();
    let period = (period_us * CYCLES_PER_US) as i64;
    // The first may have been on the bus before the watch began.
    let whole = starts.len() as u64 >= COUNT - 1;
    Ok(Range::of(starts.windows(2).map(|pair| (pair[1] - pair[0]) as i64 - period)).filter(|_| whole))
}

/// How two channels kept the periods of full tables.
#[derive(Clone, Copy, Debug)]
pub struct Tables {
    /// Start of each frame minus the time at which it was due, counted from its entry's first: how long other frames kept it
    /// waiting.
    pub late: Range,
    /// Frames that crossed the buses.
    pub frames: usize,
    /// Frames in which a modifier's byte is wrong.
    pub wrong: usize,
}

/// Fills every periodic entry of both channels, which are on separate buses, with frames of eight bytes that have a counter and a
/// checksum, and watches for this long. Each entry's period is 13 µs longer than the previous one's, so that all of them meet.
/// `None` if an entry left out a frame.
pub fn periodic_tables(rig: &mut Rig, shortest_us: u64, watch_us: u64) -> Result<Option<Tables>, RigError> {
    let period_us = |slot: usize| shortest_us + 13 * slot as u64;
    let modifiers = [
        Modifier::Counter { byte: 0, low_bit: 0, bits: 4 },
        Modifier::Checksum { byte: 7, algorithm: Checksum::Xor },
    ];
    let id = |slot: usize| 0x100 + slot as u32;
    for slot in 0..rig.periodic_slots() {
        for channel in Channel::ALL {
            let frame = Frame::from_bus(Id::standard_truncated(id(slot)), false, 8, [0; 8]);
            let modifiers = modifiers.into_iter().collect();
            let period_ticks = (period_us(slot) * TICKS_PER_US) as u32;
            let entry = Periodic { frame, period_ticks, count: 0, modifiers };
            rig.ask(Command::SetPeriodic { channel, slot: slot as u8, entry: Some(entry) })?;
        }
    }
    rig.watch();
    rig.run_for(watch_us * CYCLES_PER_US)?;
    let watched = rig.take_watched();
    let (mut late, mut frames, mut wrong) = (Vec::new(), 0, 0);
    for channel in Channel::ALL {
        for slot in 0..rig.periodic_slots() {
            let own = |frame: &&BusFrame| {
                frame.sender == Member::Controller(channel.index())
                    && frame.error.is_none()
                    && frame.frame.id().raw() == id(slot)
            };
            let crossed: Vec<&BusFrame> = watched[channel.index()].iter().filter(own).collect();
            // The watch may begin and end between two frames.
            if (crossed.len() as u64) < watch_us / period_us(slot) - 1 {
                return Ok(None);
            }
            frames += crossed.len();
            let period = period_us(slot) * CYCLES_PER_US;
            // None is sent early, so the least late one shows when they were due.
            let phases = crossed.iter().zip(0..).map(|(frame, n)| frame.start as i64 - (n * period) as i64);
            let due = phases.clone().min().unwrap_or(0);
            late.extend(phases.map(|phase| phase - due));
            let data = |frame: &BusFrame| frame.frame.padded_data();
            wrong += crossed.iter().filter(|frame| data(frame)[7] != data(frame)[0]).count();
            wrong += crossed.windows(2).filter(|two| (data(two[0])[0] + 1) % 16 != data(two[1])[0]).count();
        }
    }
    Ok(Range::of(late.into_iter()).map(|late| Tables { late, frames, wrong }))
}

fn frame(id: u32) -> Frame {
    Frame::from_bus(Id::standard_truncated(id), false, 2, [0xA5, 0x5A, 0, 0, 0, 0, 0, 0])
}
