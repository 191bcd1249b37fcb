//! The receive pins as edge detectors, for a host that looks for a bit rate: [`EdgeCatcher`] in the pins' interrupts, [`PinMeter`] for
//! commands.
//!
//! A pin keeps its alternate function while it is measured: its input can be read and reaches EXTI in every digital mode (RM0090 Rev 21
//! §8.3.11, "Alternate function configuration": the Schmitt trigger is on, and the level is sampled into IDR). Its controller is off the bus.
//!
//! At 1 Mbit/s edges are a microsecond apart, 144 cycles, which is too little for one interrupt each. So the first edge's interrupt stays
//! and watches the pin until it has been quiet for [`STAY_TICKS`]. It runs below everything that captures or sends, which may interrupt
//! it at any instant: that shows as a jump in time between two samples, and the edge that follows is marked as unsure.

use core::sync::atomic::Ordering::{Acquire, Relaxed, Release};
use core::sync::atomic::{AtomicBool, AtomicU8, AtomicU32};

use cantap_firmware::TICKS_PER_US;
use cantap_firmware::ports::{EDGES_KEPT, EdgeMeter, PinEdge};
use cantap_wire::Channel;
use stm32f4xx_hal::pac;
use stm32f4xx_hal::rcc::{Enable, Rcc};

use super::stamp::StampTimer;
use crate::board::{Port, RECEIVE_PINS, ReceivePin};

/// Within a frame the level stays the same for at most five bits: from 200 kbit/s up, one interrupt sees a whole frame. USB, of a lower
/// priority, waits meanwhile: 6 ms if 256 edges each come just in time.
const STAY_TICKS: u32 = 24 * TICKS_PER_US;
/// Two samples of the pin are some 30 cycles apart at most, 3 ticks. More than this, half of the shortest bit, is an interruption.
const MOST_BLIND_TICKS: u32 = TICKS_PER_US / 2;
/// From an edge to the next sample it takes some 110 cycles at most, in which the edge is written down: less than the shortest bit, so that no
/// other edge can come in between.
const WRITING_TICKS: u32 = TICKS_PER_US - 1;

const DOMINANT: u8 = 1;
const UNSURE: u8 = 2;

/// What the interrupt has written and commands have not yet taken, and what both know about the pin. There is one measurement at a time.
struct Kept {
    at: [AtomicU32; EDGES_KEPT],
    marks: [AtomicU8; EDGES_KEPT],
    /// Edges written, and taken, since the measurement began; both wrap.
    written: AtomicU32,
    taken: AtomicU32,
    /// There was no room left, so the pin's interrupt is off.
    full: AtomicBool,
    /// Edges may have been missed since the last one.
    blind: AtomicBool,
    /// The level after the last edge.
    dominant: AtomicBool,
    /// [`Channel::index`] of the channel being watched.
    channel: AtomicU8,
}

static KEPT: Kept = Kept {
    at: [const { AtomicU32::new(0) }; EDGES_KEPT],
    marks: [const { AtomicU8::new(0) }; EDGES_KEPT],
    written: AtomicU32::new(0),
    taken: AtomicU32::new(0),
    full: AtomicBool::new(false),
    blind: AtomicBool::new(false),
    dominant: AtomicBool::new(false),
    channel: AtomicU8::new(0),
};

impl Kept {
    /// Notes an edge; false if there is no room.
    #[inline]
    fn push(&self, at: u32, dominant: bool, unsure: bool) -> bool {
        let written = self.written.load(Relaxed);
        if written.wrapping_sub(self.taken.load(Acquire)) as usize >= EDGES_KEPT {
            return false;
        }
        let place = written as usize % EDGES_KEPT;
        self.at[place].store(at, Relaxed);
        self.marks[place].store((u8::from(dominant) * DOMINANT) | (u8::from(unsure) * UNSURE), Relaxed);
        self.written.store(written.wrapping_add(1), Release);
        true
    }
}

impl ReceivePin {
    const fn bit(self) -> u32 {
        1 << self.pin
    }

    /// Where to read its level.
    fn level(self) -> Level {
        // SAFETY: the ports' registers exist for the whole program.
        let idr = unsafe {
            match self.port {
                #[cfg(feature = "stm32f4-discovery")]
                Port::D => (*pac::GPIOD::ptr()).idr().as_ptr(),
                Port::B => (*pac::GPIOB::ptr()).idr().as_ptr(),
            }
        };
        Level { idr, bit: self.bit() }
    }

    fn is_dominant(self) -> bool {
        self.level().is_dominant()
    }
}

/// A pin's input, looked up once and read often.
#[derive(Clone, Copy)]
struct Level {
    idr: *const u32,
    bit: u32,
}

impl Level {
    /// Whether the level is dominant: the pin is low.
    #[inline]
    fn is_dominant(self) -> bool {
        // SAFETY: it is an input data register's address, and reading that has no effect.
        unsafe { self.idr.read_volatile() & self.bit == 0 }
    }
}

fn exti() -> &'static pac::exti::RegisterBlock {
    // SAFETY: the registers exist for the whole program, and `PinMeter::new` took the peripheral. RTSR and FTSR are the meter's; IMR
    // is written by the interrupt only while the meter cannot run, and by the meter while the interrupt is off.
    unsafe { &*pac::EXTI::ptr() }
}

/// Unmasks or masks a line's interrupt. What comes while it is masked stays pending.
fn unmask(line: u32, on: bool) {
    exti().imr().modify(|r, w| {
        let others = r.bits() & !line;
        // SAFETY: one bit for each line.
        unsafe { w.bits(if on { others | line } else { others }) }
    });
    // The interrupt may return directly afterwards (Cortex-M4 erratum 838869, see `Bells::open_receive`).
    cortex_m::asm::dsb();
}

/// Clears what is pending on a line.
fn acknowledge(line: u32) {
    // SAFETY: one bit for each line; those written as 0 stay.
    exti().pr().write(|w| unsafe { w.bits(line) });
}

/// The interrupts' half.
pub struct EdgeCatcher(StampTimer);

impl EdgeCatcher {
    /// Notes the edge that raised the interrupt, and those that follow closely.
    pub fn catch(&self) {
        let mut at = self.0.now();
        let pin = RECEIVE_PINS[usize::from(KEPT.channel.load(Relaxed)) % RECEIVE_PINS.len()];
        let level = pin.level();
        let mut dominant = level.is_dominant();
        let mut last = KEPT.dominant.load(Relaxed);
        let mut blind = KEPT.blind.load(Relaxed);
        acknowledge(pin.bit());
        loop {
            if dominant == last {
                // The level changed and changed back between two samples.
                blind = true;
            } else if KEPT.push(at, dominant, blind) {
                last = dominant;
                blind = false;
            } else {
                unmask(pin.bit(), false);
                KEPT.full.store(true, Relaxed);
                return;
            }
            let quiet_from = at;
            let mut looked = at;
            let mut allowed = WRITING_TICKS;
            loop {
                dominant = level.is_dominant();
                at = self.0.now();
                blind |= at.wrapping_sub(looked) > allowed;
                looked = at;
                allowed = MOST_BLIND_TICKS;
                if dominant != last {
                    break;
                }
                if at.wrapping_sub(quiet_from) > STAY_TICKS {
                    KEPT.dominant.store(last, Relaxed);
                    KEPT.blind.store(blind, Relaxed);
                    acknowledge(pin.bit());
                    // An edge that came before that is no longer pending.
                    dominant = level.is_dominant();
                    if dominant == last {
                        return;
                    }
                    break;
                }
            }
        }
    }
}

/// Commands' half.
pub struct PinMeter {
    syscfg: pac::SYSCFG,
    watched: Option<ReceivePin>,
}

impl PinMeter {
    /// A meter that watches nothing, and what the interrupts need.
    pub fn new(_: pac::EXTI, syscfg: pac::SYSCFG, timer: StampTimer, rcc: &mut Rcc) -> (Self, EdgeCatcher) {
        // SYSCFG connects lines to ports.
        pac::SYSCFG::enable(rcc);
        (Self { syscfg, watched: None }, EdgeCatcher(timer))
    }

    /// Connects a pin to its EXTI line.
    fn select(&self, pin: ReceivePin) {
        let shift = 4 * u32::from(pin.pin % 4);
        let source = |bits: u32| bits & !(0xF << shift) | (pin.port as u32) << shift;
        let syscfg = &self.syscfg;
        // SAFETY: four bits for each line, whose value is one of the ports.
        unsafe {
            match pin.pin / 4 {
                0 => syscfg.exticr1().modify(|r, w| w.bits(source(r.bits()))),
                1 => syscfg.exticr2().modify(|r, w| w.bits(source(r.bits()))),
                2 => syscfg.exticr3().modify(|r, w| w.bits(source(r.bits()))),
                _ => syscfg.exticr4().modify(|r, w| w.bits(source(r.bits()))),
            }
        };
    }

    /// Watches a pin, starting from its present level.
    fn resume(pin: ReceivePin, blind: bool) {
        KEPT.full.store(false, Relaxed);
        KEPT.blind.store(blind, Relaxed);
        acknowledge(pin.bit());
        KEPT.dominant.store(pin.is_dominant(), Relaxed);
        unmask(pin.bit(), true);
    }
}

impl EdgeMeter for PinMeter {
    fn watch(&mut self, channel: Option<Channel>) {
        let edges = |line: u32| {
            // SAFETY: one bit for each line.
            exti().rtsr().write(|w| unsafe { w.bits(line) });
            // SAFETY: one bit for each line.
            exti().ftsr().write(|w| unsafe { w.bits(line) });
        };
        if let Some(pin) = self.watched.take() {
            unmask(pin.bit(), false);
            edges(0);
        }
        KEPT.written.store(0, Relaxed);
        KEPT.taken.store(0, Relaxed);
        let Some(channel) = channel else { return };
        let pin = RECEIVE_PINS[channel.index()];
        KEPT.channel.store(channel.index() as u8, Relaxed);
        self.watched = Some(pin);
        self.select(pin);
        edges(pin.bit());
        Self::resume(pin, false);
    }

    fn next(&mut self) -> Option<PinEdge> {
        let taken = KEPT.taken.load(Relaxed);
        if taken == KEPT.written.load(Acquire) {
            return None;
        }
        let place = taken as usize % EDGES_KEPT;
        let marks = KEPT.marks[place].load(Relaxed);
        let edge = PinEdge {
            at: KEPT.at[place].load(Relaxed),
            dominant: marks & DOMINANT != 0,
            unsure: marks & UNSURE != 0,
        };
        let taken = taken.wrapping_add(1);
        KEPT.taken.store(taken, Release);
        if KEPT.full.load(Relaxed)
            && taken == KEPT.written.load(Relaxed)
            && let Some(pin) = self.watched
        {
            Self::resume(pin, true);
        }
        Some(edge)
    }

    fn is_dominant(&self) -> bool {
        self.watched.is_some_and(ReceivePin::is_dominant)
    }
}
