//! One run of the command: traffic on the buses, a capture over USB, and the figures. Everything in it
//! depends only on the options, except how long it took.

use std::time::{Duration, Instant};

use crate::board::{self, CAPTURE_IRQS, CLOCK};
use cantap_wire::{CHANNELS, Channel, Frame};
use serde_json::{Value, json};

use crate::capture::{Losses, Stamps};
use crate::rig::{MS, Rig, RigError};
use crate::{CYCLES_PER_SECOND, CYCLES_PER_US};
use cantap_emu::bus::Source;
use cantap_emu::bus::bits::bus_bits;
use cantap_emu::elf::Image;
use cantap_emu::machine::{Machine, Setup};
use cantap_emu::probe::Task;
use cantap_emu::profile::Table;
use cantap_emu::soc::OddAccess;
use cantap_emu::timing::Bound;
use cantap_emu::trace::Trace;
use cantap_emu::traffic::{Bursts, Kind, Script, Traffic};
use cantap_emu::usb_host::Timing;

/// The fastest bit rate of classical CAN, in bit/s.
pub const DEFAULT_BITRATE_BPS: u32 = 1_000_000;
/// The first 16 exceptions are the core's own.
const FIRST_INTERRUPT: u16 = 16;
/// The device may take this long to empty its queue after the traffic has ended.
const DRAIN: u64 = 5 * CYCLES_PER_SECOND;
/// Quiet time before the traffic begins and after it ends.
const MARGIN: u64 = 2 * MS;

/// What is on the buses.
#[derive(Clone, Debug)]
pub enum Load {
    /// Seeded frames of a kind, at a load in per cent.
    Frames {
        /// Which.
        kind: Kind,
        /// 0 to 100; 100 is back to back.
        percent: f64,
    },
    /// Seeded frames of a kind in bursts.
    Bursts {
        /// Which.
        kind: Kind,
        /// Frames in a burst, back to back.
        frames: u32,
        /// From burst to burst, in core cycles.
        period: u64,
    },
    /// Recorded frames for each channel, at times in core cycles after the first.
    Replay([Vec<(u64, Frame)>; CHANNELS]),
}

/// How to run.
#[derive(Clone, Debug)]
pub struct Options {
    /// Emulated seconds of traffic.
    pub seconds: f64,
    /// The traffic.
    pub load: Load,
    /// Channels that are captured and carry traffic.
    pub channels: Vec<Channel>,
    /// Bit rate of both buses, in bit/s. If `None`, a run uses [`DEFAULT_BITRATE_BPS`], and a device that
    /// serves another program's host uses the rate at which that host opens the channel.
    pub bitrate_bps: Option<u32>,
    /// The host stops reading for this long, in the middle of the run.
    pub stall: Option<Duration>,
    /// Seed of the traffic.
    pub seed: u64,
    /// The USB host's timing.
    pub timing: Timing,
    /// How long memories and buses keep the core waiting.
    pub bound: Bound,
    /// Whether to record a picture of the run.
    pub trace: bool,
    /// Whether to record where the core's cycles go.
    pub profile: bool,
}

impl Default for Options {
    /// One second of the worst traffic on both channels.
    fn default() -> Self {
        Self {
            seconds: 1.0,
            load: Load::Frames { kind: Kind::Std0, percent: 100.0 },
            channels: Channel::ALL.to_vec(),
            bitrate_bps: None,
            stall: None,
            seed: 1,
            timing: Timing::new(CLOCK),
            bound: Bound::default(),
            trace: false,
            profile: false,
        }
    }
}

/// One channel's figures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChannelReport {
    /// Which.
    pub channel: Channel,
    /// Frames on the bus while the channel was open.
    pub sent: u64,
    /// Frames that the host received.
    pub delivered: u64,
    /// Frames counted lost, by stage.
    pub lost: Losses,
    /// Frames per second on the bus.
    pub frames_per_s: f64,
    /// Bus load in per cent, from exact frame lengths.
    pub bus_load_pct: f64,
}

/// The result of a run.
#[derive(Debug)]
pub struct Report {
    /// Emulated seconds of traffic.
    pub seconds: f64,
    /// How long memories and buses kept the core waiting.
    pub bound: Bound,
    /// Each captured channel.
    pub channels: Vec<ChannelReport>,
    /// Bytes over USB per frame delivered, including everything else.
    pub wire_bytes_per_frame: f64,
    /// Size of the device's record queue.
    pub queue_bytes: u32,
    /// The most bytes that were in it.
    pub queue_high_water_bytes: u32,
    /// How late stamps were.
    pub stamps: Stamps,
    /// The longest time for which the stamping interrupt was masked, in nanoseconds.
    pub masked_ns_max: f64,
    /// Share of the traffic's time in which the core was not asleep.
    pub cpu_load_pct: f64,
    /// Cycles in the receive interrupts per frame.
    pub isr_cycles_per_frame: f64,
    /// Seconds that the emulation took per emulated second of traffic.
    pub host_s_per_emulated_s: f64,
    /// How much of the traffic's time each exception that ran took.
    pub tasks: Vec<Task>,
    /// Where the cycles went, as a table, if it was asked for.
    pub profile: Option<String>,
    /// What broke the law of counting.
    pub faults: Vec<String>,
    /// Accesses to registers that no model knows, or that the hardware would not accept.
    pub odd_accesses: Vec<OddAccess>,
    /// Whether every frame was delivered in order and bit for bit, or counted lost where it is missing.
    pub ok: bool,
}

/// Runs `image` and captures from it.
pub fn run(image: Image, options: &Options) -> Result<(Report, Option<(Machine, Trace)>), RigError> {
    let bitrate_bps = options.bitrate_bps.unwrap_or(DEFAULT_BITRATE_BPS);
    let setup = Setup { bound: options.bound, ..board::setup_for(&image) };
    let mut rig = Rig::new(image, setup, options.timing);
    let hello = rig.connect()?;
    for channel in &options.channels {
        rig.listen(*channel, bitrate_bps)?;
    }
    let from = rig.now() + MARGIN;
    let length = (options.seconds * CYCLES_PER_SECOND as f64) as u64;
    for channel in &options.channels {
        rig.add_traffic(*channel, bitrate_bps, options.source(*channel, from, from, from + length));
    }
    rig.run_for(from - rig.now())?;

    let bytes_before = rig.session.bytes();
    rig.machine.reset_probe();
    if options.trace {
        rig.machine.start_trace();
    }
    if options.profile {
        rig.machine.start_profile();
    }
    let wall = Instant::now();
    if let Some(stall) = options.stall {
        let stall = (stall.as_secs_f64() * CYCLES_PER_SECOND as f64) as u64;
        rig.run_for(length.saturating_sub(stall) / 2)?;
        rig.with_host(|host, _| host.read(false));
        rig.run_for(stall)?;
        rig.with_host(|host, _| host.read(true));
    }
    rig.run_for((from + length).saturating_sub(rig.now()))?;
    let took = wall.elapsed().as_secs_f64();
    let span = rig.now() - from;
    let costs = Costs::of(&rig.machine, span);
    let trace = rig.machine.take_trace();
    let profile = rig.machine.take_profile().map(|profile| {
        let rows = profile.by_function(rig.machine.image());
        let name_of = &|number| rig.machine.task_name(number);
        Table { rows: &rows, name_of, span, least_percent: 0.01 }.to_string()
    });

    // A frame that began before the end of the traffic ends after it.
    rig.run_for(MARGIN)?;
    let drained = rig.drain(DRAIN)?;
    let bytes = rig.session.bytes() - bytes_before;
    let status = rig.status()?;
    for channel in &options.channels {
        rig.close(*channel)?;
    }
    let seconds = span as f64 / CYCLES_PER_SECOND as f64;
    let delivered: u64 = options.channels.iter().map(|channel| rig.ledger.delivered_count(*channel)).sum();
    let mut faults = rig.ledger.faults().to_vec();
    faults.extend(rig.session.corruptions().iter().map(|corruption| format!("on USB: {corruption:?}")));
    if !drained {
        faults.push("the device did not finish sending what it had to send".to_owned());
    }
    let report = Report {
        seconds,
        bound: options.bound,
        channels: options
            .channels
            .iter()
            .map(|channel| channel_report(&rig, *channel, seconds, bitrate_bps))
            .collect(),
        wire_bytes_per_frame: bytes as f64 / delivered.max(1) as f64,
        queue_bytes: hello.queue_bytes,
        queue_high_water_bytes: status.queue_high_water_bytes,
        stamps: rig.ledger.stamps(),
        masked_ns_max: costs.masked_ns,
        cpu_load_pct: costs.load_pct,
        isr_cycles_per_frame: costs.capture_cycles as f64 / delivered.max(1) as f64,
        host_s_per_emulated_s: took / seconds,
        tasks: costs.tasks,
        profile,
        ok: faults.is_empty() && rig.ledger.holds(),
        odd_accesses: rig.machine.board().odd_accesses(),
        faults,
    };
    Ok((report, trace.map(|trace| (rig.machine, trace))))
}

impl Options {
    /// The traffic of a channel's bus, from core cycle `from` to `until`. A replay has its first frame at
    /// `origin`.
    pub fn source(&self, channel: Channel, origin: u64, from: u64, until: u64) -> Box<dyn Source> {
        // Two channels with one seed must not carry the same frames.
        let seed = self.seed.wrapping_mul(CHANNELS as u64).wrapping_add(channel.index() as u64);
        match &self.load {
            Load::Frames { kind, percent } => Box::new(Traffic::new(*kind, seed, *percent, from, until)),
            Load::Bursts { kind, frames, period } => {
                Box::new(Bursts::new(*kind, seed, *frames, *period, from, until))
            }
            Load::Replay(logs) => {
                // The log's times are real ones; the board's crystal may count more or fewer cycles in them.
                let place = |at: u64| origin + (at as f64 * self.timing.board_rate()) as u64;
                let frames = logs[channel.index()].iter().map(|(at, frame)| (place(*at), *frame));
                Box::new(Script::new(frames.filter(|(at, _)| (from..until).contains(at)).collect()))
            }
        }
    }
}

fn channel_report(rig: &Rig, channel: Channel, seconds: f64, bitrate_bps: u32) -> ChannelReport {
    let sent = rig.ledger.on_bus_count(channel);
    let bits = rig.bus_bits(channel) as f64;
    ChannelReport {
        channel,
        sent,
        delivered: rig.ledger.delivered_count(channel),
        lost: rig.ledger.losses(channel),
        frames_per_s: sent as f64 / seconds,
        // The last frame may have ended after the end of the traffic.
        bus_load_pct: (100.0 * bits / (seconds * f64::from(bitrate_bps))).min(100.0),
    }
}

/// What the firmware's work cost while there was traffic.
struct Costs {
    masked_ns: f64,
    load_pct: f64,
    capture_cycles: u64,
    tasks: Vec<Task>,
}

impl Costs {
    fn of(machine: &Machine, span: u64) -> Self {
        let probe = machine.probe();
        let capture = CAPTURE_IRQS.iter().flatten();
        Self {
            masked_ns: probe.longest_masked().cycles as f64 * 1000.0 / CYCLES_PER_US as f64,
            load_pct: probe.load_percent(machine.now()),
            capture_cycles: capture.map(|irq| probe.cycles(FIRST_INTERRUPT + irq)).sum(),
            tasks: machine.tasks(span),
        }
    }
}

impl Report {
    /// One object for scripts: the demo's keys, and the emulator's own.
    pub fn to_json(&self) -> Value {
        let channels: Vec<Value> = self
            .channels
            .iter()
            .map(|channel| {
                json!({
                    "channel": channel.channel.number(),
                    "sent": channel.sent,
                    "delivered": channel.delivered,
                    "lost": channel.lost.total(),
                    "frames_per_s": rounded(channel.frames_per_s, 1),
                    "bus_load_pct": rounded(channel.bus_load_pct, 2),
                })
            })
            .collect();
        let lost = |stage: fn(&Losses) -> u64| self.channels.iter().map(|one| stage(&one.lost)).sum::<u64>();
        json!({
            "seconds": rounded(self.seconds, 3),
            "timing": self.bound.to_string(),
            "channels": channels,
            "wire_bytes_per_frame": rounded(self.wire_bytes_per_frame, 3),
            "queue_bytes": self.queue_bytes,
            "queue_high_water_bytes": self.queue_high_water_bytes,
            "lost": {
                "controller": lost(|one| one.controller),
                "queue": lost(|one| one.queue),
                "link": lost(|one| one.link),
                // The emulator's host never drops what it received.
                "host": 0,
            },
            "in_order": self.faults.is_empty(),
            "ok": self.ok,
            "stamp_latency_ns": {
                "min": self.stamps.min,
                "median": self.stamps.median,
                "max": self.stamps.max,
            },
            "masked_ns_max": rounded(self.masked_ns_max, 0),
            "cpu_load_pct": rounded(self.cpu_load_pct, 1),
            "isr_cycles_per_frame": rounded(self.isr_cycles_per_frame, 1),
            "host_s_per_emulated_s": rounded(self.host_s_per_emulated_s, 2),
        })
    }
}

fn rounded(value: f64, digits: i32) -> f64 {
    let factor = 10f64.powi(digits);
    (value * factor).round() / factor
}

/// Recorded frames for each channel: a log's first interface is channel 1, its second channel 2, further ones are
/// left out. Also returns the length of the log in cycles, including its last frame.
pub fn replay(lines: Vec<(u64, String, Frame)>, bitrate_bps: u32) -> (Load, u64) {
    let mut interfaces: Vec<String> = Vec::new();
    let mut channels: [Vec<(u64, Frame)>; CHANNELS] = Default::default();
    let mut length = 0;
    for (at, interface, frame) in lines {
        let n = interfaces.iter().position(|known| *known == interface).unwrap_or_else(|| {
            interfaces.push(interface);
            interfaces.len() - 1
        });
        if let Some(channel) = channels.get_mut(n) {
            let bits = u64::from(bus_bits(&frame));
            length = length.max(at + bits * CYCLES_PER_SECOND / u64::from(bitrate_bps) + MS);
            channel.push((at, frame));
        }
    }
    (Load::Replay(channels), length)
}
