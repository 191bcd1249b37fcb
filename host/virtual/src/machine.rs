//! The virtual device's time: buses, interrupts, alarm, millisecond tick and USB, one event after the other.

use std::cell::RefCell;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use cantap_firmware::bus::capture::Capture;
use cantap_firmware::bus::gateway::Lane;
use cantap_firmware::bus::queue::RecordQueue;
use cantap_firmware::bus::transmit::TxQueue;
use cantap_firmware::port::command::Identity;
use cantap_firmware::port::session::{self, Session};
use cantap_firmware::ports::Clock;
use cantap_wire::{CHANNELS, Channel};
use heapless::String;

use super::board::{
    Ending, FRAME_NS, Filters, ModelClock, TICK_PHASE_NS, VirtualBoard, VirtualChip, VirtualPort,
};
use super::controller::{ControlSide, Controller, TrafficSide};
use super::edges::VirtualMeter;
use super::flash::Flash;
use super::nodes;
use super::options::Options;
use crate::simbus::{Node, Schedule, SimBus, Traffic};

const MS_NS: u64 = 1_000_000;
/// How many times per millisecond USB is served.
const USB_POLLS_PER_MS: u32 = 4;

/// What the simulated bus knows and no device can: how many frames a channel really received.
#[derive(Debug, Default)]
pub struct Witness {
    heard: [AtomicU64; CHANNELS],
    driven: [AtomicU64; CHANNELS],
}

/// See [`Witness`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BusActivity {
    /// Frames that ended well on each channel's bus while it was open, and that its filters let pass.
    pub frames: [u64; CHANNELS],
    /// Times that each channel's controller put a dominant level on its bus: frames that it began to send, acknowledged, or
    /// destroyed by an error flag.
    pub driven: [u64; CHANNELS],
}

impl Witness {
    /// The counts now.
    pub fn activity(&self) -> BusActivity {
        let read =
            |counts: &[AtomicU64; CHANNELS]| counts.each_ref().map(|count| count.load(Ordering::Acquire));
        BusActivity { frames: read(&self.heard), driven: read(&self.driven) }
    }
}

/// The memory that the firmware gets at its start.
pub struct Memory {
    records: RecordQueue,
    transmit: [TxQueue; CHANNELS],
    lanes: [Lane; CHANNELS],
    session: session::Memory,
}

impl Memory {
    /// As after power-on.
    #[expect(clippy::large_stack_arrays, reason = "a computer's stack has room for them")]
    pub fn new() -> Box<Self> {
        Box::new(Self {
            records: RecordQueue::new(),
            transmit: [const { TxQueue::new() }; CHANNELS],
            lanes: [const { Lane::new() }; CHANNELS],
            session: session::Memory::new(),
        })
    }
}

/// No host finds a port as soon as its device has started. A real one takes a hundred times as long.
const ENUMERATED_AFTER_NS: u64 = 2 * MS_NS;

/// What outlives the firmware.
pub struct World {
    port: VirtualPort,
    buses: [SimBus; CHANNELS],
    loops: [SimBus; CHANNELS],
    joined: bool,
    witness: Arc<Witness>,
    flash: Flash,
    serial: String<24>,
    name: &'static str,
    crystal_ppm: f64,
    now_ns: u64,
}

impl World {
    pub fn new(options: &mut Options, port: VirtualPort, witness: Arc<Witness>) -> Self {
        let silent = || SimBus::new(None, Traffic::new(Schedule::Silent), 0);
        Self {
            port,
            buses: [options.bus(0), options.bus(1)],
            loops: [silent(), silent()],
            joined: options.joined,
            witness,
            flash: Flash::new(options.settings.clone()),
            // This cannot fail: longer ones are refused.
            serial: String::try_from(options.serial.as_str()).unwrap_or_default(),
            name: nodes::board(options.car),
            crystal_ppm: options.crystal_ppm,
            now_ns: 0,
        }
    }
}

/// One virtual device with its buses.
pub struct Machine<'q> {
    board: VirtualBoard<'q>,
    session: Session<'q>,
    port: VirtualPort,
    controllers: [Rc<RefCell<Controller>>; CHANNELS],
    /// A bus for each channel; with `joined`, the first serves both.
    buses: [SimBus; CHANNELS],
    /// The bus of a controller in loopback mode.
    loops: [SimBus; CHANNELS],
    joined: bool,
    witness: Arc<Witness>,
    serial: String<24>,
    name: &'static str,
    crystal_ppm: f64,
    /// What was counted in earlier lives of the firmware.
    heard_before: BusActivity,
    now_ns: u64,
    next_usb_ns: u64,
    next_tick_ns: u64,
}

impl<'q> Machine<'q> {
    /// The firmware starts with new memory and nothing open.
    pub fn power_up(memory: &'q mut Memory, world: World) -> Self {
        let World { port, buses, loops, joined, witness, flash, serial, name, crystal_ppm, now_ns } = world;
        let controllers = [(); CHANNELS].map(|()| Rc::new(RefCell::new(Controller::new())));
        let Memory { records, transmit, lanes, session } = memory;
        let (producer, consumer) = records.split();
        let identity = Identity { board: name, serial: serial.clone() };
        let side = |channel: usize| Rc::clone(&controllers[channel]);
        Self {
            board: VirtualBoard {
                capture: Capture::new(producer, transmit, lanes),
                traffic: [TrafficSide(side(0)), TrafficSide(side(1))],
                control: [ControlSide(side(0)), ControlSide(side(1))],
                clock: ModelClock::started_at(now_ns, crystal_ppm),
                filters: Filters([side(0), side(1)]),
                chip: VirtualChip { flash, ending: None },
                meter: VirtualMeter::default(),
            },
            session: Session::new(consumer, identity, session),
            port,
            buses,
            loops,
            joined,
            controllers,
            heard_before: witness.activity(),
            witness,
            serial,
            name,
            crystal_ppm,
            now_ns,
            next_usb_ns: now_ns + ENUMERATED_AFTER_NS,
            next_tick_ns: now_ns + MS_NS,
        }
    }

    /// The firmware is gone; buses, port and flash remain.
    pub fn power_down(self) -> World {
        let Self { board, port, buses, loops, joined, witness, serial, name, crystal_ppm, now_ns, .. } = self;
        // Whatever it had not read is lost with it.
        while port.from_host.take(&mut [0; 64]) > 0 {}
        World {
            port,
            buses,
            loops,
            joined,
            witness,
            flash: board.chip.flash,
            serial,
            name,
            crystal_ppm,
            now_ns,
        }
    }

    /// Connects the device to a USB host whose time is this far ahead of model time; its frames are whole milliseconds
    /// of its time.
    pub fn plug_in(&mut self, usb_ahead_ns: u64) {
        self.board.clock.set_usb_ahead_ns(usb_ahead_ns);
        let phase_ns = (self.now_ns + usb_ahead_ns) % FRAME_NS;
        self.next_tick_ns = self.now_ns + (TICK_PHASE_NS + FRAME_NS - phase_ns) % FRAME_NS;
    }

    pub const fn now_ns(&self) -> u64 {
        self.now_ns
    }

    pub const fn port(&self) -> &VirtualPort {
        &self.port
    }

    /// Whether, and how, the firmware has ended.
    pub const fn ending(&self) -> Option<Ending> {
        self.board.chip.ending
    }

    /// Lets model time pass up to `until_ns`.
    pub fn advance(&mut self, until_ns: u64) {
        loop {
            let mut next_ns = self.next_usb_ns.min(self.next_tick_ns).min(self.board.clock.alarm_ns());
            for index in 0..2 * CHANNELS {
                let now_ns = self.now_ns;
                next_ns = next_ns.min(self.with_bus(index, |bus, nodes| bus.next_event_ns(now_ns, nodes)));
            }
            if next_ns > until_ns {
                self.now_ns = until_ns;
                self.board.clock.set(until_ns);
                return;
            }
            self.now_ns = next_ns.max(self.now_ns);
            self.board.clock.set(self.now_ns);
            self.step();
        }
    }

    /// Does everything that is due now.
    fn step(&mut self) {
        let now_ns = self.now_ns;
        for index in 0..2 * CHANNELS {
            self.with_bus(index, |bus, nodes| bus.step(now_ns, nodes));
        }
        self.pass_edges();
        self.interrupt();
        if self.board.clock.alarm_ns() <= now_ns {
            self.board.clock.clear_alarm();
            self.board.capture.on_alarm(&mut self.board.traffic, &self.board.clock);
        }
        if self.next_tick_ns <= now_ns {
            self.next_tick_ns += MS_NS;
            for controller in &self.controllers {
                controller.borrow_mut().pass(now_ns);
            }
            self.interrupt();
            self.board.capture.on_tick(&mut self.board.traffic, &self.board.clock);
            self.session.tick(&mut self.board);
        }
        if self.next_usb_ns <= now_ns {
            self.next_usb_ns += MS_NS / u64::from(USB_POLLS_PER_MS);
            self.port.allow(USB_POLLS_PER_MS);
            self.session.poll(&mut self.port, &mut self.board);
        }
    }

    /// Passes the edges of the watched pin to the meter.
    fn pass_edges(&mut self) {
        let watched = self.board.meter.watched().map(|channel| if self.joined { 0 } else { channel.index() });
        for (index, bus) in self.buses.iter_mut().enumerate() {
            bus.watch(watched == Some(index));
            while let Some(edge) = bus.pass_edge(self.now_ns) {
                self.board.meter.edge(self.board.clock.ticks_at(edge.at_ns) as u32, edge.dominant);
            }
        }
    }

    /// Serves the controllers' interrupts immediately.
    fn interrupt(&mut self) {
        let Self { board, controllers, witness, heard_before, .. } = self;
        for channel in Channel::ALL {
            let index = channel.index();
            let (interrupts, heard, driven) = {
                let mut controller = controllers[index].borrow_mut();
                (std::mem::take(&mut controller.interrupts), controller.heard, controller.driven)
            };
            witness.driven[index].store(heard_before.driven[index] + driven, Ordering::Release);
            let entered = board.clock.now();
            if interrupts.receive {
                witness.heard[index].store(heard_before.frames[index] + heard, Ordering::Release);
                board.capture.on_receive(channel, &mut board.traffic, &board.clock, entered);
            }
            if interrupts.transmit {
                board.capture.on_transmit(channel, &mut board.traffic, &board.clock, Some(entered));
            }
            if interrupts.error {
                board.capture.on_error(channel, &mut board.traffic[index], entered);
            }
        }
    }

    /// Calls `act` with a bus and the controllers on it: the two buses, then the two loops.
    fn with_bus<R>(&mut self, index: usize, act: impl FnOnce(&mut SimBus, &mut [&mut dyn Node]) -> R) -> R {
        let Self { buses, loops, controllers, joined, .. } = self;
        let [mut first, mut second] = [0, 1].map(|channel: usize| controllers[channel].borrow_mut());
        let looped = index >= CHANNELS;
        let bus = if looped { &mut loops[index - CHANNELS] } else { &mut buses[index] };
        let on_it = |channel: usize, is_looped: bool| {
            is_looped == looped && (channel == index % CHANNELS || *joined && !looped)
        };
        match (on_it(0, first.is_looped()), on_it(1, second.is_looped())) {
            // With both channels on one wire, the second bus has no nodes.
            (true, true) if index == 1 => act(bus, &mut []),
            (true, true) => act(bus, &mut [&mut *first, &mut *second]),
            (true, false) if !*joined || index != 1 => act(bus, &mut [&mut *first]),
            (false, true) if !*joined || index != 1 => act(bus, &mut [&mut *second]),
            _ => act(bus, &mut []),
        }
    }
}
