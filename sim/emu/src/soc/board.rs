//! The peripherals themselves, and what happens to them as time goes on.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::exti::Exti;
use super::flash::{self, FlashInterface};
use super::odd::{OddAccess, Oddity};
use super::rcc::{Clocks, Crystal, Rcc, ResetCause};
use super::small::{Adc, Crc, Gpio, Storage, Watchdog};
use super::timer::Timer;
use super::transmit_pins::{self, Driven, TransmitPins};
use crate::bus::Wire;
use crate::can::CanPair;
use crate::cpu::Memories;
use crate::hostile::{Dice, Hostile};
use crate::rom;
use crate::timing::Speeds;
use crate::{Clock, Peripheral};

/// GPIO ports A to I.
pub(super) const PORTS: usize = 9;
/// TIM2 to TIM7: bits of the counter and interrupt number (RM0090 Rev 21 Table 61).
pub(super) const TIMERS: [(u32, u16); 6] = [(32, 28), (16, 29), (16, 30), (32, 50), (16, 54), (16, 55)];
/// The default receive pins of the buses: PB8 and PB12.
pub const RECEIVE_PINS: [(usize, u32); 2] = [(1, 8), (1, 12)];
/// Interrupt numbers of CAN1 and CAN2: transmit, FIFO 0, FIFO 1, status change and error.
pub const CAN_IRQS: [[u16; 4]; 2] = [[19, 20, 21, 22], [63, 64, 65, 66]];

/// TIM2 and TIM4 in [`TIMERS`], and TIM2's number among TIM4's internal triggers (RM0090, "TIMx internal trigger connection").
const TIM2: usize = 0;
const TIM4: usize = 2;
const TIM2_TO_TIM4: u32 = 1;
/// The one trigger output of another peripheral that is wired: OTG_FS's start of frame, as TIM2_OR.ITR1_RMP has it (RM0090, TIM2_OR).
const OTG_FS_SOF: u32 = 2;

pub(super) struct Device {
    pub(super) range: Range<u32>,
    pub(super) irq: u16,
    pub(super) model: Arc<Mutex<dyn Peripheral + Send>>,
}

impl Device {
    /// If another holder of the lock panicked, the state it left is as good as any other.
    pub(super) fn lock(&self) -> MutexGuard<'_, dyn Peripheral + Send + 'static> {
        self.model.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Everything on the chip except core and memories, and what is wired to it.
pub struct Board {
    /// Reset and clock control.
    pub rcc: Rcc,
    /// The CAN controllers.
    pub can: CanPair,
    /// The CAN buses: with two, each controller has its own; joined, both are on the first.
    pub wires: [Wire; 2],
    pub(super) ports: Vec<Gpio>,
    pub(super) flash: FlashInterface,
    pub(super) timers: [Timer; 6],
    pub(super) watchdog: Watchdog,
    pub(super) adc: Adc,
    pub(super) power: Storage,
    pub(super) syscfg: Storage,
    pub(super) exti: Exti,
    /// The receive pin of each bus: port (0 for A) and pin.
    pub(super) receive_pins: [(usize, u32); 2],
    pub(super) crc: Crc,
    pub(super) dbgmcu: Storage,
    pub(super) devices: Vec<Device>,
    /// Interrupt of the attached device that was last accessed, until it is taken.
    pub(super) reached: Option<u16>,
    pub(super) odd: BTreeMap<(Oddity, u32, bool), u64>,
    pub(super) clock: Clock,
    pub(super) crystal: Crystal,
    /// What the boot pins put into SYSCFG_MEMRMP on a reset of SYSCFG.
    pub(super) boot_mode: u32,
    /// A peripheral whose clock was just switched on and that does not respond yet.
    pub(super) awaited: Option<Awaited>,
    /// What a controller's TX pin may do.
    pub(super) transmit_pins: TransmitPins,
    driven: [Driven; 2],
    /// Core cycles for which each controller's pin has driven its bus without the controller, and since when it does.
    pulses: [(u64, Option<u64>); 2],
    frames_cut: u64,
}

/// A clock that was just switched on (ES0182, "Delay after an RCC peripheral clock enabling").
#[derive(Clone, Copy, Debug)]
pub(super) struct Awaited {
    /// The enable register's offset, and the bits that were set.
    pub(super) register: u32,
    pub(super) bits: u32,
    /// When the peripherals can be reached, unless the program waits properly before then: by a barrier, or by reading back.
    pub(super) until: u64,
}

impl Board {
    /// A chip after power-on, with the board's crystal.
    pub fn new(memories: &Memories, clock: Clock, crystal: Crystal) -> Self {
        Self {
            rcc: Rcc::new(clock, crystal, ResetCause::PowerOn),
            can: CanPair::default(),
            wires: [Wire::new(&[0]), Wire::new(&[1])],
            ports: (0..PORTS).map(Gpio::new).collect(),
            flash: FlashInterface::new(clock, memories.flash.clone()),
            timers: TIMERS.map(|(bits, _)| Timer::new(bits)),
            watchdog: Watchdog::new(clock),
            adc: Adc::default(),
            power: power(),
            syscfg: syscfg(rom::FLASH),
            exti: Exti::default(),
            receive_pins: RECEIVE_PINS,
            crc: Crc::default(),
            dbgmcu: dbgmcu(),
            devices: Vec::new(),
            reached: None,
            odd: BTreeMap::new(),
            clock,
            crystal,
            boot_mode: rom::FLASH,
            awaited: None,
            transmit_pins: TransmitPins::default(),
            driven: [Driven::default(); 2],
            pulses: [(0, None); 2],
            frames_cut: 0,
        }
    }

    /// Makes the chip as `hostile` has it; attached devices are their owner's.
    pub fn set_hostile(&mut self, hostile: &Hostile) {
        self.can.set_hostile(hostile, self.clock);
        self.transmit_pins.set_hostile(hostile, self.clock);
        self.flash.set_lateness(hostile.flash_busy, Dice::new(hostile.seed, 3, self.clock));
    }

    /// From now on it is prompt and true.
    pub fn calm(&mut self) {
        self.can.calm();
        self.flash.calm();
        self.transmit_pins.calm();
        self.follow_transmit_pins();
    }

    /// The crystal stops, or starts again. Returns whether the chip has lost its clock by that: the controllers are deaf and silent then,
    /// apart from a bit that stays on the bus, until a reset puts the chip on its own oscillator. The clock security system, which would
    /// do so at once, is not modelled.
    pub fn set_crystal(&mut self, crystal: Crystal, now: u64) -> bool {
        self.advance(now);
        let stands_still = crystal.start_us.is_none() && self.rcc.needs_crystal();
        self.crystal = crystal;
        self.rcc.exchange_crystal(crystal, now);
        if stands_still {
            for controller in 0..2 {
                if self.can.controllers[controller].is_sending() {
                    self.transmit_pins.clock_stops(controller);
                }
                self.can.reset(controller);
            }
            self.follow_transmit_pins();
        }
        stands_still
    }

    /// Lets the buses follow the TX pins, after a change of the pins, the clocks or the controllers.
    pub(super) fn follow_transmit_pins(&mut self) {
        for (controller, held) in self.transmit_pins.follow(&self.ports, &self.rcc).into_iter().enumerate() {
            let Some(held) = held else { continue };
            self.can.controllers[controller].drove(held.into());
            if let Some(wire) = self.wires.iter_mut().find(|wire| wire.controllers().contains(&controller)) {
                wire.hold_dominant(held, &mut self.can);
            }
        }
    }

    /// Lets the buses follow what outputs and TIM4 do to the TX pins, from cycle `at` on.
    pub(super) fn follow_driven_pins(&mut self, at: u64) {
        let driven = transmit_pins::driven(&self.ports, &self.timers[TIM4]);
        let before = std::mem::replace(&mut self.driven, driven);
        for (controller, (now, before)) in driven.into_iter().zip(before).enumerate() {
            if now == before {
                continue;
            }
            let (total, since) = &mut self.pulses[controller];
            match (*since, now.dominant) {
                (None, true) => *since = Some(at),
                (Some(from), false) => {
                    *total += at - from;
                    *since = None;
                }
                _ => {}
            }
            // A level that begins or ends with the connection belongs to it: the controller is off the pin first, and back last.
            if let Some(wire) = self.wires.iter_mut().find(|wire| wire.controllers().contains(&controller)) {
                if now.cut {
                    wire.cut(controller, true, at, &mut self.can);
                }
                wire.drive(now.dominant, at, &mut self.can);
                if !now.cut {
                    wire.cut(controller, false, at, &mut self.can);
                }
            }
        }
    }

    /// Whether controller `n`'s TX pin drives its bus dominant now, as an output or for a timer.
    pub fn drives(&self, n: usize) -> bool {
        self.driven[n].dominant
    }

    /// Core cycles for which controller `n`'s TX pin has driven its bus dominant without the controller, in levels that are over: as an
    /// output, or for a timer.
    pub fn driven_cycles(&self, n: usize) -> u64 {
        self.pulses[n].0
    }

    /// Frames that were on a bus when the chip was reset. In the model they end all the same; a real one would be an error on the bus.
    pub fn frames_cut(&self) -> u64 {
        self.frames_cut
    }

    /// How long a cycle is.
    pub fn clock(&self) -> Clock {
        self.clock
    }

    /// Connects the buses to pins other than [`RECEIVE_PINS`]: port (0 for A) and pin of each controller's RX.
    pub fn receive_at(&mut self, pins: [(usize, u32); 2]) {
        self.receive_pins = pins;
    }

    /// Whether an edge of controller `n`'s receive pin would interrupt.
    pub fn watches(&self, n: usize) -> bool {
        let (port, pin) = self.receive_pins[n];
        self.exti.watches(pin) && self.exti_port(pin) == port
    }

    /// The port that an EXTI line is connected to.
    fn exti_port(&self, line: u32) -> usize {
        let sources = self.syscfg.read(8 + line / 4 * 4).unwrap_or(0);
        (sources >> (line % 4 * 4) & 0xF) as usize
    }

    /// Lets the buses' edges up to now reach the pins and what is connected to them.
    fn advance_pins(&mut self, now: u64) {
        for wire in 0..self.wires.len() {
            while let Some(edge) = self.wires[wire].pass_edge(now) {
                for n in 0..self.wires[wire].controllers().len() {
                    let (port, pin) = self.receive_pins[self.wires[wire].controllers()[n]];
                    let inputs = &mut self.ports[port].inputs;
                    *inputs = *inputs & !(1 << pin) | u16::from(!edge.dominant) << pin;
                    if self.exti_port(pin) == port {
                        self.exti.edge(pin, !edge.dominant);
                    }
                }
            }
        }
    }

    /// Puts a device at a range of addresses, with an interrupt line.
    pub fn attach(&mut self, range: Range<u32>, irq: u16, model: Arc<Mutex<dyn Peripheral + Send>>) {
        self.devices.push(Device { range, irq, model });
    }

    /// A system reset: everything except the memories and the buses, whose nodes continue.
    pub fn reset(&mut self, cause: ResetCause, now: u64) {
        self.advance(now);
        self.frames_cut += self.can.controllers.iter().filter(|one| one.is_sending()).count() as u64;
        self.rcc = Rcc::new(self.clock, self.crystal, cause);
        self.awaited = None;
        // The jumper for the ROM bootloader, if any, has been removed.
        self.boot_mode = rom::FLASH;
        self.ports.iter_mut().for_each(Gpio::reset);
        self.flash = self.flash.after_reset();
        for timer in &mut self.timers {
            *timer = timer.after_reset();
        }
        self.watchdog = Watchdog::new(self.clock);
        self.adc = Adc::default();
        self.power = power();
        self.syscfg = syscfg(self.boot_mode);
        self.exti = Exti::default();
        self.crc = Crc::default();
        for controller in 0..2 {
            self.can.reset(controller);
        }
        for device in &self.devices {
            device.lock().reset(now);
        }
        self.follow_clocks(now);
        self.follow_transmit_pins();
        self.follow_driven_pins(now);
    }

    /// The level of pin `pin` of port `port` (0 for A) if it is an output. For LEDs.
    pub fn output_pin(&self, port: usize, pin: u32) -> Option<bool> {
        self.ports.get(port)?.output(pin)
    }

    /// A GPIO port's registers as they read: port 0 is A. Shows how pins are set up.
    pub fn port(&self, port: usize) -> Option<&Gpio> {
        self.ports.get(port)
    }

    /// What is at address 0, by SYSCFG_MEMRMP: flash unless [`rom::SYSTEM_MEMORY`].
    pub fn memory_at_zero(&self) -> u32 {
        self.syscfg.read(0).unwrap_or(0) & 3
    }

    /// The debug component's control register.
    pub fn debug_control(&self) -> u32 {
        self.dbgmcu.read(4).unwrap_or(0)
    }

    /// Whether a barrier executed by the core matters now: a peripheral's clock was just switched on, or a store to flash is on its
    /// way.
    pub fn awaits_barrier(&self) -> bool {
        self.awaited.is_some() || self.flash.next_event().is_some()
    }

    /// The core executed a barrier: what it wrote has arrived.
    pub fn barrier(&mut self) {
        self.awaited = None;
        self.flash.arrive();
    }

    /// The supply fails while the flash is at work: see [`FlashInterface::cut_short`].
    pub fn cut_flash_short(&mut self, word: impl FnMut() -> u32) {
        self.flash.cut_short(word);
    }

    /// Leaves an uncleared error in the flash interface.
    pub fn leave_flash_error(&mut self) {
        self.flash.leave_error(flash::PGSERR);
    }

    /// The interrupt of the attached device that the core has accessed since the last call.
    pub fn take_reached(&mut self) -> Option<u16> {
        self.reached.take()
    }

    /// When the watchdog resets the chip, if it runs.
    pub fn watchdog_deadline(&self) -> Option<u64> {
        self.watchdog.deadline()
    }

    /// The core cycle at which TIM2 was at zero, if it has counted since without being written or stopped.
    pub fn tim2_origin(&mut self, now: u64) -> u64 {
        self.timers[0].origin(now)
    }

    /// Every odd access, with how often it happened.
    pub fn odd_accesses(&self) -> Vec<OddAccess> {
        let access = |(key, count): (&(Oddity, u32, bool), &u64)| OddAccess {
            oddity: key.0,
            address: key.1,
            write: key.2,
            count: *count,
        };
        self.odd.iter().map(access).collect()
    }

    /// Holds both buses dominant, or releases them.
    pub fn hold_buses_dominant(&mut self, hold: bool) {
        for wire in &mut self.wires {
            wire.hold_dominant(hold, &mut self.can);
        }
    }

    /// The clock tree as the program has set it up.
    pub fn clocks(&self) -> Clocks {
        self.rcc.clocks()
    }

    /// The settings made by the program that affect the core's timing.
    pub fn speeds(&self) -> Speeds {
        let clocks = self.rcc.clocks();
        let access = self.flash.access();
        Speeds {
            wait_states: access.wait_states,
            prefetch: access.prefetch,
            instruction_cache: access.instruction_cache,
            data_cache: access.data_cache,
            apb1: clocks.hclk_hz / clocks.pclk1_hz.max(1),
            apb2: clocks.hclk_hz / clocks.pclk2_hz.max(1),
        }
    }

    /// Core cycles for which the core must now stall.
    pub fn take_stall(&mut self) -> u64 {
        self.flash.take_stall()
    }

    /// The levels of the interrupt lines; bit n is interrupt n.
    pub fn lines(&self) -> u128 {
        let mut lines = 0u128;
        let mut set = |irq: u16, level: bool| lines |= u128::from(level) << irq;
        for (n, irqs) in CAN_IRQS.iter().enumerate() {
            for (irq, level) in irqs.iter().zip(self.can.irqs(n)) {
                set(*irq, level);
            }
        }
        for ((_, irq), timer) in TIMERS.iter().zip(&self.timers) {
            set(*irq, timer.irq());
        }
        for device in &self.devices {
            set(device.irq, device.lock().irq());
        }
        lines | self.exti.lines()
    }

    /// When [`Self::advance`] must be called next.
    pub fn next_event(&self) -> Option<u64> {
        let wires = self.wires.iter().filter_map(|wire| wire.next_event(&self.can));
        let timers = self.timers.iter().filter_map(Timer::next_event);
        let devices = self.devices.iter().filter_map(|device| device.lock().next_event());
        // If nobody is watching, edges need not be on time.
        let watched = |wire: &&Wire| wire.controllers().iter().any(|n| self.watches(*n));
        let edges = self.wires.iter().filter(watched).filter_map(Wire::next_edge);
        wires
            .chain(edges)
            .chain(timers)
            .chain(devices)
            .chain(self.can.next_event())
            .chain(self.watchdog.deadline())
            .chain(self.flash.next_event())
            .min()
    }

    /// Processes everything that is due at or before `now`.
    pub fn advance(&mut self, now: u64) {
        self.advance_buses(now);
        self.flash.advance(now);
        self.advance_timers(now);
        let mut trigger = None;
        for device in &self.devices {
            let mut device = device.lock();
            if device.next_event().is_some_and(|due| due <= now) {
                device.advance(now);
            }
            trigger = device.take_trigger().or(trigger);
        }
        self.trigger(trigger, now);
    }

    /// Counts up to `now`; what an output does meanwhile reaches its pin at its cycle.
    fn advance_timers(&mut self, now: u64) {
        // Otherwise only a register that is written changes a pin.
        let mut may_drive = self.timers[TIM4].is_counting();
        for timer in &mut self.timers {
            timer.advance(now);
        }
        if let Some(at) = self.timers[TIM2].take_trigger() {
            self.timers[TIM4].internal_trigger(TIM2_TO_TIM4, at);
            may_drive = true;
        }
        if may_drive {
            self.follow_driven_pins(now);
        }
    }

    /// A device's trigger output pulsed at a cycle no later than `now`.
    pub(super) fn trigger(&mut self, at: Option<u64>, now: u64) {
        if let Some(at) = at {
            self.timers[0].remapped_trigger(OTG_FS_SOF, at, now);
        }
    }

    pub(super) fn advance_buses(&mut self, now: u64) {
        self.can.advance(now);
        for wire in &mut self.wires {
            wire.advance(now, &mut self.can);
        }
        self.advance_pins(now);
    }

    /// Passes the clock tree on to the peripherals whose timing depends on it.
    pub(super) fn follow_clocks(&mut self, now: u64) {
        let clocks = self.rcc.clocks();
        for controller in &mut self.can.controllers {
            controller.set_cycles_per_clock(clocks.cycles_per_pclk1);
        }
        for timer in &mut self.timers {
            timer.set_cycles_per_clock(clocks.cycles_per_timer_clock, now);
        }
    }
}

/// Power control: the regulator is always ready (VOSRDY).
pub(super) fn power() -> Storage {
    Storage::new(2, &[(1, 1 << 14)])
}

/// System configuration: MEMRMP shows what the boot pins selected (RM0090, SYSCFG_MEMRMP).
pub(super) fn syscfg(boot_mode: u32) -> Storage {
    let mut syscfg = Storage::new(9, &[]);
    syscfg.write(0, boot_mode).expect("there are nine registers");
    syscfg
}

/// The debug component: IDCODE of an STM32F405 (RM0090 Rev 21 §38.6.1).
fn dbgmcu() -> Storage {
    Storage::new(4, &[(0, 0x1007_6413)])
}
