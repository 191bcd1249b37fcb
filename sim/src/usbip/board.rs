//! The machine with its buses and its cable, and the books of what really crossed.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cantap_wire::{CHANNELS, Frame};

use super::error::Error;
use super::exported::Exported;
use super::urbs::Urbs;
use crate::run::DEFAULT_BITRATE_BPS;
use cantap_emu::Clock;
use cantap_emu::bus::{BitTime, BusFrame, Member, Node, Source};
use cantap_emu::elf::Image;
use cantap_emu::machine::{Machine, Setup};
use cantap_emu::memory_map as map;
use cantap_emu::otg::Otg;
use cantap_emu::traffic::{Kind, Traffic};
use cantap_emu::usb::UsbPort;
use cantap_emu::usb_host::{Counters, Outcome, Request, Timing, UsbHost};

/// Milliseconds that a device may take from plugging in to the end of its first reset, or for the server's first
/// look.
const PATIENCE_MS: u32 = 3000;
/// The simulated nodes that send a channel's traffic and its single frames. Both acknowledge.
const TRAFFIC: usize = 0;
const SINGLE: usize = 1;
/// Seeds that one setting of the traffic may use.
const SEEDS: u64 = 10;

/// What is on the buses of open channels.
#[derive(Clone, Copy, Debug)]
pub struct BusLoad {
    /// Share of the bus, 0 to 100.
    pub percent: f64,
    /// Which frames.
    pub kind: Kind,
    /// Bit rate of the buses; if `None`, the rate at which the channel is opened.
    pub bitrate_bps: Option<u32>,
}

/// The first frames of a source, this many.
struct First(Traffic, u64);

impl Source for First {
    fn next_frame(&mut self, bit: BitTime) -> Option<(u64, Frame)> {
        self.1 = self.1.checked_sub(1)?;
        self.0.next_frame(bit)
    }
}

/// A frame that a controller received or sent.
#[derive(Clone, Copy, Debug)]
pub struct Crossed {
    /// The frame.
    pub frame: Frame,
    /// When its receivers took it, in core cycles.
    pub valid: u64,
}

/// All counters, since the board was made or since a mark.
#[derive(Clone, Copy, Debug)]
pub struct Figures {
    /// Wall-clock time.
    pub at: Instant,
    /// Core cycles.
    pub cycles: u64,
    /// Time spent on emulating.
    pub computing: Duration,
    /// Time for which emulated time stood still because the kernel did not read.
    pub starving: Duration,
    /// Counters of the USB.
    pub usb: Counters,
    /// Resets of the bus.
    pub bus_resets: u64,
    /// Resets of the chip.
    pub chip_resets: u64,
    /// Bits that each controller drove dominant.
    pub dominant_bits: [u64; CHANNELS],
    /// How often each channel was opened.
    pub openings: [u64; CHANNELS],
}

/// The board.
pub struct Board {
    machine: Machine,
    clock: Clock,
    port: Arc<Mutex<UsbPort<Urbs>>>,
    load: BusLoad,
    seed: u64,
    /// Cycles per bit of each open channel.
    open: [Option<u64>; CHANNELS],
    openings: [u64; CHANNELS],
    taken: [Vec<Crossed>; CHANNELS],
    sent: [Vec<Crossed>; CHANNELS],
    computing: Duration,
    starving: Duration,
    marked: Figures,
}

impl Board {
    /// A board with `image`, and the cable out.
    pub fn new(image: Image, setup: Setup) -> Self {
        let clock = setup.clock;
        let mut machine = Machine::new(image, setup);
        let timing = Timing { recovery: Timing::new(clock).recovery, ..Timing::hasty(clock) };
        let port = Arc::new(Mutex::new(UsbPort::with_driver(timing, Urbs::new())));
        machine.attach(map::OTG_FS, map::OTG_FS_IRQ, Arc::clone(&port) as _);
        for wire in &mut machine.board().wires {
            wire.add(Node::new(BitTime::of_rate(DEFAULT_BITRATE_BPS, clock)));
            wire.add(Node::new(BitTime::of_rate(DEFAULT_BITRATE_BPS, clock)));
        }
        let nothing = Figures {
            at: Instant::now(),
            cycles: 0,
            computing: Duration::ZERO,
            starving: Duration::ZERO,
            usb: Counters::default(),
            bus_resets: 0,
            chip_resets: 0,
            dominant_bits: [0; CHANNELS],
            openings: [0; CHANNELS],
        };
        Self {
            machine,
            clock,
            port,
            load: BusLoad { percent: 0.0, kind: Kind::Mix, bitrate_bps: None },
            seed: 1,
            open: [None; CHANNELS],
            openings: [0; CHANNELS],
            taken: Default::default(),
            sent: Default::default(),
            computing: Duration::ZERO,
            starving: Duration::ZERO,
            marked: nothing,
        }
    }

    /// The machine.
    pub fn machine(&self) -> &Machine {
        &self.machine
    }

    /// How long a core cycle is.
    pub const fn clock(&self) -> Clock {
        self.clock
    }

    /// Runs `action` on the host at the far end of the cable, at the present time.
    pub fn with_host<R>(&self, action: impl FnOnce(&mut UsbHost<Urbs>, &mut Otg) -> R) -> R {
        let now = self.machine.now();
        // If a thread panicked while it held the lock, the port's state is as good as any other.
        let mut port: MutexGuard<'_, _> = self.port.lock().unwrap_or_else(PoisonError::into_inner);
        let (host, otg) = port.host(now);
        action(host, otg)
    }

    /// The same, with its driver.
    pub fn with_urbs<R>(&self, action: impl FnOnce(&mut Urbs) -> R) -> R {
        self.with_host(|host, _| action(host.driver()))
    }

    /// Lets emulated time pass.
    pub fn run(&mut self, cycles: u64) -> Result<(), Error> {
        let from = Instant::now();
        self.machine.run_until(self.machine.now() + cycles)?;
        self.computing += from.elapsed();
        self.keep_books();
        self.follow_channels();
        Ok(())
    }

    /// Emulated time stood still for this long.
    pub fn starved(&mut self, time: Duration) {
        self.starving += time;
    }

    fn keep_books(&mut self) {
        for (n, wire) in self.machine.board().wires.iter_mut().enumerate() {
            for BusFrame { frame, valid, taken_by, sender, error, .. } in wire.take_history() {
                let crossed = Crossed { frame, valid };
                if taken_by >> n & 1 != 0 {
                    self.taken[n].push(crossed);
                }
                if sender == Member::Controller(n) && error.is_none() {
                    self.sent[n].push(crossed);
                }
            }
        }
    }

    /// Starts and ends the traffic of channels as they are opened and closed.
    fn follow_channels(&mut self) {
        let now = self.machine.now();
        let mut board = self.machine.board();
        for n in 0..CHANNELS {
            let controller = &board.can.controllers[n];
            let bit = controller.listens().then(|| controller.timing().bit());
            if bit == self.open[n] {
                continue;
            }
            self.open[n] = bit;
            self.openings[n] += u64::from(bit.is_some());
            let BusLoad { percent, kind, bitrate_bps } = self.load;
            let time = match (bitrate_bps, bit) {
                (None, Some(cycles)) => BitTime::of_cycles(cycles),
                (rate, _) => BitTime::of_rate(rate.unwrap_or(DEFAULT_BITRATE_BPS), self.clock),
            };
            let traffic = bit.map(|_| Traffic::new(kind, self.seed + n as u64, percent, now, u64::MAX));
            let source = traffic.map(|traffic| Box::new(traffic) as Box<dyn Source>);
            board.wires[n].node(TRAFFIC).restart(time, source);
            board.wires[n].node(SINGLE).restart(time, None);
        }
    }

    /// Sets the traffic for channels that are opened from now on.
    pub fn set_load(&mut self, load: BusLoad) {
        self.load = load;
        self.seed += SEEDS;
    }

    /// Puts this many frames on an open channel's bus, from now on, in place of its traffic.
    pub fn play(&mut self, n: usize, load: BusLoad, count: u64) {
        self.seed += SEEDS;
        let traffic = Traffic::new(load.kind, self.seed, load.percent, self.machine.now(), u64::MAX);
        let time = self.open[n].map_or(BitTime::of_rate(DEFAULT_BITRATE_BPS, self.clock), BitTime::of_cycles);
        let source = Box::new(First(traffic, count));
        self.machine.board().wires[n].node(TRAFFIC).restart(time, Some(source));
    }

    /// A simulated node sends a frame.
    pub fn send(&mut self, n: usize, frame: Frame) {
        let now = self.machine.now();
        self.machine.board().wires[n].node(SINGLE).send_at(now, frame);
    }

    /// Sets whether the simulated nodes acknowledge.
    pub fn acknowledge(&mut self, acknowledge: bool) {
        for wire in &mut self.machine.board().wires {
            wire.node(TRAFFIC).acknowledge(acknowledge);
            wire.node(SINGLE).acknowledge(acknowledge);
        }
    }

    /// Destroys a share of the frames, in per cent.
    pub fn make_noise(&mut self, percent: f64) {
        for wire in &mut self.machine.board().wires {
            wire.make_noise(percent / 100.0, self.seed);
        }
    }

    /// The frames that a channel's controller has received, and those it has sent, since the mark.
    pub fn books(&self, n: usize) -> (&[Crossed], &[Crossed]) {
        (&self.taken[n], &self.sent[n])
    }

    /// Restarts the books and the figures.
    pub fn mark(&mut self) {
        (self.taken, self.sent) = Default::default();
        self.marked = self.totals();
    }

    fn totals(&self) -> Figures {
        let (usb, bus_resets) = self.with_host(|host, _| (host.bus_counters(), host.driver().resets()));
        let board = self.machine.board();
        let dominant_bits = std::array::from_fn(|n| board.can.controllers[n].dominant_bits());
        Figures {
            at: Instant::now(),
            cycles: self.machine.now(),
            computing: self.computing,
            starving: self.starving,
            usb,
            bus_resets,
            chip_resets: self.machine.resets(),
            dominant_bits,
            openings: self.openings,
        }
    }

    /// The figures at the mark, and now.
    pub fn figures(&self) -> (Figures, Figures) {
        (self.marked, self.totals())
    }

    /// Runs while `goes_on` returns true; returns whether it ended in time.
    fn run_while(&mut self, mut goes_on: impl FnMut(&mut Self) -> bool) -> Result<bool, Error> {
        for _ in 0..PATIENCE_MS {
            if !goes_on(self) {
                return Ok(true);
            }
            self.run(self.clock.ms(1))?;
        }
        Ok(false)
    }

    /// Puts the cable in; returns whether a device came up.
    pub fn plug_in(&mut self) -> Result<bool, Error> {
        self.with_host(|host, _| host.plug());
        self.run_while(|board| !board.with_host(|host, _| host.is_running() && host.driver().is_present()))
    }

    /// Pulls the cable out.
    pub fn unplug(&mut self) {
        self.with_host(|host, _| host.unplug());
    }

    /// The server's own look at the device, before any kernel sees it. The cable is out again afterwards.
    pub fn look(&mut self) -> Result<Exported, Error> {
        if !self.plug_in()? {
            return Err(Error::NoDevice);
        }
        let descriptor = |kind: u16, length: u16| Request::new(0x80, 6, kind << 8, 0, length);
        self.with_urbs(|urbs| {
            // First the size of endpoint 0's packets.
            for request in [descriptor(1, 8), descriptor(1, 18), descriptor(2, 255)] {
                urbs.ask(request);
            }
        });
        let mut answers = None;
        self.run_while(|board| {
            answers = board.with_urbs(|urbs| urbs.take_answers(3));
            answers.is_none()
        })?;
        self.unplug();
        self.run(self.clock.ms(10))?;
        let Some([_, Outcome::Done(device), Outcome::Done(configuration)]) = answers.as_deref() else {
            return Err(Error::NoDevice);
        };
        let exported = Exported::new(device, configuration)?;
        self.with_urbs(|urbs| urbs.set_endpoints(exported.endpoints()));
        Ok(exported)
    }
}
