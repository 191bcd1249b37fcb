//! How long the firmware's commands and its millisecond tick hold up the tasks that send and drain, at the worst moments there are.
//!
//! These locks raise BASEPRI to the priority of the transmission alarm, TIM2's interrupt: what the probe measures is how long that one
//! is masked. Stamps, taken at a higher priority, are within the lock's time.

use cantap_emu::bus::{BitTime, Node};
use cantap_emu::elf::Image;
use cantap_emu::machine::Setup;
use cantap_emu::timing::Bound;
use cantap_emu::traffic::{Kind, Traffic};
use cantap_emu::usb_host::Timing;
use cantap_wire::message::{ChannelConfig, Filter, FrameKind, Mode, Periodic, Trigger, TxFrame};
use cantap_wire::{Channel, Command, Frame, Id};

use crate::board::{self, CLOCK};
use crate::rig::{MS, Rig, RigError, timing};
use crate::{CYCLES_PER_SECOND, CYCLES_PER_US};

/// TIM2's interrupt: the transmission alarm.
const ALARM_IRQ: u16 = 28;
const MEGABIT: u32 = 1_000_000;
const TICKS_PER_US: u32 = 12;
/// The shortest period that a device takes, in µs.
const SHORTEST_US: u32 = 47;
/// Frames in one request to send.
const AT_ONCE: u32 = 8;

/// The longest lock while something was going on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lock {
    /// What was going on.
    pub during: &'static str,
    /// How long the lock was held, in µs.
    pub longest_us: f64,
    /// Where it ended.
    pub pc: u32,
}

/// Measures the longest lock in each of several situations, with everything full: queues, tables, both buses.
pub fn longest(image: &Image, bound: Bound) -> Result<Vec<Lock>, RigError> {
    let mut locks = Vec::new();
    let mut rig = busy(image, bound)?;
    let mut measure = |rig: &mut Rig, during, act: &mut dyn FnMut(&mut Rig) -> Result<(), RigError>| {
        rig.machine.reset_probe();
        act(rig)?;
        let window = rig.machine.probe().longest_masked();
        locks.push(Lock { during, longest_us: window.cycles as f64 / CYCLES_PER_US as f64, pc: window.pc });
        Ok::<_, RigError>(())
    };
    measure(&mut rig, "status", &mut |rig| rig.status().map(drop))?;
    measure(&mut rig, "filling the tables", &mut fill_tables)?;
    measure(&mut rig, "full tables", &mut |rig| rig.run_for(30 * MS))?;
    measure(&mut rig, "filling the queues", &mut fill_queues)?;
    measure(&mut rig, "an abort", &mut |rig| {
        for channel in Channel::ALL {
            rig.ask(Command::Abort { channel })?;
        }
        rig.run_for(30 * MS)
    })?;
    fill_queues(&mut rig)?;
    measure(&mut rig, "closing both channels", &mut |rig| {
        Channel::ALL.into_iter().try_for_each(|channel| rig.close(channel))
    })?;
    let mut rig = busy(image, bound)?;
    fill_queues(&mut rig)?;
    measure(&mut rig, "a broken bus", &mut |rig| {
        rig.machine.board().hold_buses_dominant(true);
        rig.run_for(30 * MS)?;
        rig.machine.board().hold_buses_dominant(false);
        rig.run_for(10 * MS)
    })?;
    measure(&mut rig, "a new session", &mut |rig| rig.greet().map(drop))?;
    Ok(locks)
}

/// A board with both channels on full buses on which nobody acknowledges but the sender.
fn busy(image: &Image, bound: Bound) -> Result<Rig, RigError> {
    let setup = Setup { bound, watched: 1 << ALARM_IRQ, ..board::setup() };
    let mut rig = Rig::new(image.clone(), setup, Timing::hasty(CLOCK));
    rig.connect()?;
    let config = ChannelConfig {
        mode: Mode::Normal,
        manual_recovery: true,
        ..ChannelConfig::listen_only(timing(MEGABIT)?)
    };
    for channel in Channel::ALL {
        rig.ask(Command::Open { channel, config: Some(config) })?;
        let from = rig.now();
        let traffic = Traffic::new(Kind::Std0, channel.index() as u64, 60.0, from, from + CYCLES_PER_SECOND);
        let wire = &mut rig.machine.board().wires[channel.index()];
        wire.add(Node::new(BitTime::of_rate(MEGABIT, CLOCK)).with_source(traffic));
    }
    rig.run_for(MS)?;
    Ok(rig)
}

fn frame(id: u32) -> Frame {
    Frame::data_frame(Id::standard_truncated(id), &[]).expect("no data is short enough")
}

/// All periodic entries at the shortest period, and all replies to every frame.
fn fill_tables(rig: &mut Rig) -> Result<(), RigError> {
    for channel in Channel::ALL {
        for slot in 0..rig.periodic_slots() as u8 {
            let entry = Periodic {
                frame: frame(0x400 + u32::from(slot)),
                period_ticks: SHORTEST_US * TICKS_PER_US,
                count: 0,
                modifiers: [].into_iter().collect(),
            };
            rig.ask(Command::SetPeriodic { channel, slot, entry: Some(entry) })?;
        }
        let filter = Filter { extended: false, kind: FrameKind::Any, id: 0, mask: 0 };
        let entry = Trigger { filter, reply: frame(0x7F0), count: 0 };
        rig.ask(Command::SetTrigger { channel, slot: 0, entry: Some(entry) })?;
    }
    Ok(())
}

/// Frames until no more fit.
fn fill_queues(rig: &mut Rig) -> Result<(), RigError> {
    for channel in Channel::ALL {
        for first in (0..rig.tx_queue() as u32).step_by(AT_ONCE as usize) {
            let frames = (first..first + AT_ONCE)
                .map(|tag| TxFrame { tag, frame: frame(0x7FF), at_ticks: None })
                .collect();
            if rig.request(Command::Send { channel, frames })?.result.is_err() {
                break;
            }
        }
    }
    Ok(())
}
