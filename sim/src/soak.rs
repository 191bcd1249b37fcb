//! A long session on one board: both channels full, in turns undisturbed, with a host that stalls, with requests, and with frames replayed
//! by the device itself; every frame is accounted for, and what could creep is measured: memory, stamps, the device's clock.

use cantap_emu::Image;
use cantap_emu::machine::Machine;
use cantap_emu::memory_map as map;
use cantap_emu::traffic::{Kind, Script, Traffic};
use cantap_emu::usb_host::Timing;
use cantap_wire::message::{ChannelConfig, Mode, TxFrame};
use cantap_wire::{Channel, Command, Event, Frame, Reply};
use fastrand::Rng;
use serde_json::{Value, json};

use crate::board::{self, CLOCK};
use crate::capture::{Losses, Stamps};
use crate::rig::{MS, Rig, RigError, timing};
use crate::{CYCLES_PER_SECOND, CYCLES_PER_US};

const MEGABIT: u32 = 1_000_000;
/// How long a turn lasts.
const TURN: u64 = CYCLES_PER_SECOND;
/// Fills memory that is yet unused.
const PAINT: u8 = 0xA5;
/// Device ticks per microsecond.
const TICKS_PER_US: u64 = 12;

/// What a turn does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Turn {
    Capture,
    Stalls,
    Requests,
    Replay,
}

const TURNS: [Turn; 4] = [Turn::Capture, Turn::Stalls, Turn::Requests, Turn::Replay];

/// What a soak found.
#[derive(Debug)]
pub struct Soak {
    /// Emulated seconds.
    pub seconds: f64,
    /// Turns made.
    pub turns: u64,
    /// Frames that crossed both buses, and those delivered.
    pub on_bus: u64,
    /// Frames delivered.
    pub delivered: u64,
    /// Frames counted lost, by stage.
    pub lost: Losses,
    /// Frames that the device was asked to send, and those that it reports as sent.
    pub replayed: (u64, u64),
    /// Requests answered.
    pub requests: u64,
    /// Stamps in the first turn of each kind, and in the last.
    pub stamps: [Stamps; 2],
    /// How far the device's clock went from the truth, in ticks.
    pub drift_ticks: i64,
    /// The most bytes that were in the device's queue.
    pub queue_high_water_bytes: u32,
    /// The most bytes of the stack that were used, after the first turns and at the end.
    pub stack_bytes: [usize; 2],
    /// This program's memory after the first turns and at the end, in KiB; 0 where it cannot be read.
    pub host_kib: [u64; 2],
    /// What was wrong.
    pub faults: Vec<String>,
}

/// Runs for this many emulated seconds, in whole rounds of turns; `progress` is told of each round.
pub fn run(image: Image, seconds: f64, seed: u64, mut progress: impl FnMut(&str)) -> Result<Soak, RigError> {
    let setup = board::setup_for(&image);
    let machine = Machine::new(image, setup);
    if let Some(ccm) = machine.cpu().memory(map::CCM.start) {
        ccm.write(map::CCM.start, &vec![PAINT; map::CCM.len()]);
    }
    let mut rig = Rig::on(machine, setup, Timing::new(CLOCK));
    rig.connect()?;
    for channel in Channel::ALL {
        rig.add_traffic(channel, MEGABIT, Script::new(Vec::new()));
    }
    let mut soak = Bench { rig, random: Rng::with_seed(seed), replayed: (0, 0), requests: 0 };
    let from = soak.rig.now();
    let until = from + (seconds * CYCLES_PER_SECOND as f64) as u64;
    let (mut first, mut last, mut turns) = (None, Stamps::default(), 0);
    while soak.rig.now() < until {
        for turn in TURNS {
            soak.turn(turn)?;
            turns += 1;
        }
        last = soak.rig.ledger.take_stamps();
        let state = (last, soak.stack_bytes(), resident_kib());
        progress(&format!(
            "{:.0} s: {} frames delivered, {} lost; stamps {} / {} / {} ns; {} KiB",
            soak.rig.now() as f64 / CYCLES_PER_SECOND as f64,
            soak.sum(|rig, channel| rig.ledger.delivered_count(channel)),
            soak.losses().total(),
            last.min,
            last.median,
            last.max,
            state.2
        ));
        first.get_or_insert(state);
        if !soak.rig.ledger.holds() {
            break;
        }
    }
    let (first_stamps, first_stack, first_kib) = first.unwrap_or_default();
    let drift_ticks = soak.drift_ticks()?;
    let queue_high_water_bytes = soak.rig.status()?.queue_high_water_bytes;
    let mut faults = soak.rig.ledger.faults().to_vec();
    if !soak.rig.ledger.holds() && faults.is_empty() {
        faults.push("the books do not balance".to_owned());
    }
    let (asked, sent) = soak.replayed;
    if asked != sent {
        faults.push(format!("{asked} frames were to be replayed, {sent} were sent"));
    }
    faults.extend(soak.rig.session.corruptions().iter().map(|what| format!("on USB: {what:?}")));
    faults.extend(soak.rig.machine.board().odd_accesses().iter().map(|odd| format!("odd access: {odd}")));
    Ok(Soak {
        seconds: (soak.rig.now() - from) as f64 / CYCLES_PER_SECOND as f64,
        turns,
        on_bus: soak.sum(|rig, channel| rig.ledger.on_bus_count(channel)),
        delivered: soak.sum(|rig, channel| rig.ledger.delivered_count(channel)),
        lost: soak.losses(),
        replayed: soak.replayed,
        requests: soak.requests,
        stamps: [first_stamps, last],
        drift_ticks,
        queue_high_water_bytes,
        stack_bytes: [first_stack, soak.stack_bytes()],
        host_kib: [first_kib, resident_kib()],
        faults,
    })
}

struct Bench {
    rig: Rig,
    random: Rng,
    replayed: (u64, u64),
    requests: u64,
}

impl Bench {
    fn turn(&mut self, turn: Turn) -> Result<(), RigError> {
        let bit = cantap_emu::bus::BitTime::of_rate(MEGABIT, CLOCK);
        let from = self.rig.now() + MS;
        let kind = [Kind::Std0, Kind::Mix, Kind::Ext8][self.random.usize(..3)];
        for channel in Channel::ALL {
            let sends = turn == Turn::Replay && channel == Channel::Can1;
            let mode = if sends { Mode::Normal } else { Mode::ListenOnly };
            self.rig.open(channel, ChannelConfig { mode, ..ChannelConfig::listen_only(timing(MEGABIT)?) })?;
            let traffic = Traffic::new(kind, self.random.u64(..), 100.0, from, from + TURN);
            self.rig.change_traffic(channel, bit, Some(Box::new(traffic)));
        }
        match turn {
            Turn::Capture => self.rig.run_for(TURN)?,
            Turn::Stalls => {
                for _ in 0..4 {
                    self.rig.with_host(|host, _| host.read(false));
                    let span = self.random.u64(MS..TURN / 4);
                    self.rig.run_for(span)?;
                    self.rig.with_host(|host, _| host.read(true));
                    self.rig.run_for(TURN / 4 - span)?;
                }
            }
            Turn::Requests => {
                let until = self.rig.now() + TURN;
                while self.rig.now() < until {
                    self.rig.status()?;
                    self.rig.ask(Command::Time)?;
                    self.rig.ask(Command::Registers { channel: Channel::Can2 })?;
                    self.requests += 3;
                }
            }
            Turn::Replay => self.replay(TURN)?,
        }
        self.rig.run_for(2 * MS)?;
        for channel in Channel::ALL {
            self.rig.close(channel)?;
        }
        self.replayed.1 += self.rig.take_events().iter().filter(|(_, event)| is_sent(event)).count() as u64;
        Ok(())
    }

    /// The device sends a recorded trace at its own times: half a millisecond apart, ahead of the bus's other frames.
    fn replay(&mut self, length: u64) -> Result<(), RigError> {
        const APART_US: u64 = 500;
        const AT_ONCE: u64 = 8;
        let frame: Frame = "001#1122334455667788".parse().expect("it is a frame");
        let until = self.rig.now() + length - 20 * MS;
        let Reply::Time(mut at) = self.rig.ask(Command::Time)? else { return Ok(()) };
        at += 10_000 * TICKS_PER_US;
        while self.rig.now() < until {
            let frames = (0..AT_ONCE)
                .map(|n| TxFrame { tag: n as u32, frame, at_ticks: Some(at + n * APART_US * TICKS_PER_US) })
                .collect();
            self.rig.ask(Command::Send { channel: Channel::Can1, frames })?;
            self.replayed.0 += AT_ONCE;
            at += AT_ONCE * APART_US * TICKS_PER_US;
            // Stays some milliseconds ahead.
            let origin = self.rig.clock_origin();
            let due = origin + (at - 5_000 * TICKS_PER_US) * CYCLES_PER_US / TICKS_PER_US;
            self.rig.run_for(due.saturating_sub(self.rig.now()))?;
        }
        let end = self.rig.clock_origin() + (at + 5_000 * TICKS_PER_US) * CYCLES_PER_US / TICKS_PER_US;
        self.rig.run_for(end.saturating_sub(self.rig.now()))
    }

    fn sum(&self, of: impl Fn(&Rig, Channel) -> u64) -> u64 {
        Channel::ALL.into_iter().map(|channel| of(&self.rig, channel)).sum()
    }

    fn losses(&self) -> Losses {
        let [one, two] = Channel::ALL.map(|channel| self.rig.ledger.losses(channel));
        Losses {
            controller: one.controller + two.controller,
            queue: one.queue + two.queue,
            link: one.link + two.link,
        }
    }

    /// By how much the device's clock differs from the cycles that have passed since it was at zero, beyond the time that the answer
    /// takes.
    fn drift_ticks(&mut self) -> Result<i64, RigError> {
        let before = self.rig.now();
        let Reply::Time(ticks) = self.rig.ask(Command::Time)? else { return Ok(0) };
        let origin = self.rig.clock_origin();
        let of = |cycle: u64| ((cycle - origin) * TICKS_PER_US / CYCLES_PER_US) as i64;
        let (least, most) = (of(before), of(self.rig.now()));
        Ok((ticks as i64 - most).max(0) + (ticks as i64 - least).min(0))
    }

    /// Bytes of the stack that have ever been used, if it is at the beginning of the core-coupled memory and grows down in it.
    fn stack_bytes(&self) -> usize {
        let cpu = self.rig.machine.cpu();
        let start = cpu.word(map::FLASH.start).unwrap_or(0);
        let mut stack =
            vec![0; start.checked_sub(map::CCM.start).unwrap_or(0).min(map::CCM.len() as u32) as usize];
        if let Some(memory) = cpu.memory(map::CCM.start) {
            memory.read(map::CCM.start, &mut stack);
        }
        stack.iter().position(|byte| *byte != PAINT).map_or(0, |first| stack.len() - first)
    }
}

fn is_sent(event: &Event) -> bool {
    matches!(event, Event::Transmitted { .. })
}

/// This program's resident memory, where the system tells.
fn resident_kib() -> u64 {
    const PAGE_KIB: u64 = 4;
    let statm = std::fs::read_to_string("/proc/self/statm").unwrap_or_default();
    statm.split_whitespace().nth(1).and_then(|pages| pages.parse::<u64>().ok()).unwrap_or(0) * PAGE_KIB
}

impl Soak {
    /// One object for scripts.
    pub fn to_json(&self) -> Value {
        let stamps =
            |stamps: &Stamps| json!({ "min": stamps.min, "median": stamps.median, "max": stamps.max });
        json!({
            "seconds": self.seconds,
            "turns": self.turns,
            "on_bus": self.on_bus,
            "delivered": self.delivered,
            "lost": { "controller": self.lost.controller, "queue": self.lost.queue, "link": self.lost.link },
            "replayed": self.replayed.0,
            "sent": self.replayed.1,
            "requests": self.requests,
            "stamp_latency_ns_first": stamps(&self.stamps[0]),
            "stamp_latency_ns_last": stamps(&self.stamps[1]),
            "drift_ticks": self.drift_ticks,
            "queue_high_water_bytes": self.queue_high_water_bytes,
            "stack_bytes": self.stack_bytes,
            "host_kib": self.host_kib,
            "faults": self.faults,
            "ok": self.faults.is_empty(),
        })
    }
}
