//! How the core's bus reaches the peripherals: which one answers at an address, whether its clock is on, and what a write to the clock
//! controller does to the others.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::board::{Awaited, Board, PORTS, TIMERS, power, syscfg};
use super::flash;
use super::odd::Oddity;
use super::rcc::Rcc;
use super::small::{self, Adc};
use crate::cpu::Bus;
use crate::memory_map as map;
use crate::timing::Speeds;

const TIM4_BASE: u32 = 0x4000_0800;
const CAN1_BASE: u32 = 0x4000_6400;
const GPIO_BASE: u32 = 0x4002_0000;
/// A peripheral's registers are in a block of this size, or a multiple.
const BLOCK: u32 = 0x400;

/// For how many cycles of the slower bus a peripheral cannot be reached after its clock was switched on: one until the store
/// arrives, plus what ES0182 gives for APB, one and the bus's divider.
const CLOCK_ENABLE_CYCLES: u64 = 4;

impl Board {
    /// The enable bit of the peripheral at `address`, as register offset and bit; `None` if it needs
    /// no clock or is not known.
    fn clock_gate(address: u32) -> Option<(u32, u32)> {
        match address {
            0x4000_0000..0x4000_1800 => Some((0x40, (address - 0x4000_0000) / BLOCK)),
            0x4000_6400..0x4000_6800 => Some((0x40, 25)),
            0x4000_6800..0x4000_6C00 => Some((0x40, 26)),
            0x4000_7000..0x4000_7400 => Some((0x40, 28)),
            0x4001_2000..0x4001_2400 => Some((0x44, 8)),
            0x4001_3800..0x4001_3C00 => Some((0x44, 14)),
            0x4002_0000..0x4002_2400 => Some((0x30, (address - GPIO_BASE) / BLOCK)),
            0x4002_3000..0x4002_3400 => Some((0x30, 12)),
            0x5000_0000..0x5004_0000 => Some((0x34, 7)),
            _ => None,
        }
    }

    fn clocked(&self, address: u32, now: u64) -> bool {
        let Some((register, bit)) = Self::clock_gate(address) else { return true };
        let comes = self.awaited.is_some_and(|awaited| {
            awaited.register == register && awaited.bits >> bit & 1 != 0 && now < awaited.until
        });
        self.rcc.enabled(register, bit) && !comes
    }

    /// After a write to the clock controller: notes which clocks it switched on.
    fn await_clocks(&mut self, register: u32, before: u32, now: u64) {
        let bits = self.rcc.read(register).unwrap_or(0) & !before;
        if Rcc::is_enable_register(register) && bits != 0 {
            let until = now + CLOCK_ENABLE_CYCLES * self.rcc.clocks().cycles_per_pclk1;
            self.awaited = Some(Awaited { register, bits, until });
        }
    }

    fn note(&mut self, oddity: Oddity, address: u32, write: bool) {
        *self.odd.entry((oddity, address, write)).or_default() += 1;
    }

    fn read(&mut self, address: u32, size: u8, now: u64) -> u32 {
        if map::SYSTEM_MEMORY.contains(&address) {
            return small::factory_values(address, size);
        }
        if !self.clocked(address, now) {
            self.note(Oddity::Unclocked, address, false);
            return 0;
        }
        if let Some(device) = self.devices.iter().find(|device| device.range.contains(&address)) {
            self.reached = Some(device.irq);
            let mut model = device.lock();
            let value = model.read(address - device.range.start, size, now);
            let trigger = model.take_trigger();
            drop(model);
            self.trigger(trigger, now);
            return value;
        }
        let Some(word) = self.read_register(address & !3, now) else {
            self.note(Oddity::Unknown, address & !3, false);
            return 0;
        };
        let value = word >> (8 * (address & 3));
        if size == 4 { value } else { value & ((1 << (8 * size)) - 1) }
    }

    fn read_register(&mut self, address: u32, now: u64) -> Option<u32> {
        let offset = address % BLOCK;
        match address - offset {
            TIM4_BASE => {
                self.advance_buses(now);
                let value = self.timers[block(address, 0x4000_0000)].read(offset, now);
                self.follow_driven_pins(now);
                value
            }
            0x4000_0000..=0x4000_1400 => self.timers[block(address, 0x4000_0000)].read(offset, now),
            0x4000_3000 => self.watchdog.read(offset),
            CAN1_BASE | 0x4000_6800 => {
                self.advance_buses(now);
                self.can.read(address - CAN1_BASE, now)
            }
            0x4000_7000 => self.power.read(offset),
            0x4001_2000 => self.adc.read(offset),
            0x4001_3800 => self.syscfg.read(offset),
            0x4001_3C00 => {
                self.advance_buses(now);
                self.exti.read(offset)
            }
            GPIO_BASE..=0x4002_2000 => {
                self.advance_buses(now);
                self.ports[block(address, GPIO_BASE)].read(offset)
            }
            0x4002_3000 => self.crc.read(offset),
            0x4002_3800 => {
                self.awaited = None;
                if self.rcc.settle(now) {
                    self.advance(now);
                    self.follow_clocks(now);
                    self.check_wait_states(address & !3, false);
                }
                self.rcc.read(offset)
            }
            0x4002_3C00 => {
                self.flash.advance(now);
                self.flash.read(offset)
            }
            0xE004_2000 => self.dbgmcu.read(offset),
            _ => None,
        }
    }

    pub(super) fn write(&mut self, address: u32, size: u8, value: u32, now: u64) {
        if map::FLASH.contains(&address) {
            return self.flash.store(address, size, value, now);
        }
        if !self.clocked(address, now) {
            return self.note(Oddity::Unclocked, address, true);
        }
        if let Some(device) = self.devices.iter().find(|device| device.range.contains(&address)) {
            self.reached = Some(device.irq);
            let mut model = device.lock();
            model.write(address - device.range.start, size, value, now);
            let trigger = model.take_trigger();
            drop(model);
            return self.trigger(trigger, now);
        }
        let register = address & !3;
        let value = if size == 4 {
            value
        } else {
            // Part of a register: the rest stays as it reads.
            let shift = 8 * (address & 3);
            let mask = ((1 << (8 * size)) - 1) << shift;
            self.read_register(register, now).unwrap_or(0) & !mask | value << shift & mask
        };
        if self.write_register(register, value, now).is_none() {
            let known = self.read_register(register, now).is_some();
            self.note(if known { Oddity::Refused } else { Oddity::Unknown }, register, true);
        }
        if map::CLOCKS_AND_FLASH.contains(&register) {
            self.check_wait_states(register, true);
        }
    }

    /// Checks whether flash has the wait states that the core's clock needs, after an access that may have changed either.
    fn check_wait_states(&mut self, register: u32, write: bool) {
        if self.flash.access().wait_states < flash::least_wait_states(self.rcc.clocks().hclk_hz) {
            self.note(Oddity::TooFast, register, write);
        }
    }

    fn write_register(&mut self, address: u32, value: u32, now: u64) -> Option<()> {
        let offset = address % BLOCK;
        match address - offset {
            TIM4_BASE => {
                let done = self.timers[block(address, 0x4000_0000)].write(offset, value, now);
                self.advance_buses(now);
                self.follow_driven_pins(now);
                done
            }
            0x4000_0000..=0x4000_1400 => self.timers[block(address, 0x4000_0000)].write(offset, value, now),
            0x4000_3000 => self.watchdog.write(offset, value, now),
            CAN1_BASE | 0x4000_6800 => {
                self.advance_buses(now);
                self.can.write(address - CAN1_BASE, value, now)
            }
            0x4000_7000 => self.power.write(offset, value),
            0x4001_2000 => self.adc.write(offset, value),
            0x4001_3800 => {
                self.advance_buses(now);
                self.syscfg.write(offset, value)
            }
            0x4001_3C00 => {
                self.advance_buses(now);
                self.exti.write(offset, value)
            }
            GPIO_BASE..=0x4002_2000 => {
                let port = &mut self.ports[block(address, GPIO_BASE)];
                let done = port.write(offset, value);
                self.follow_transmit_pins();
                self.advance_buses(now);
                self.follow_driven_pins(now);
                done
            }
            0x4002_3000 => self.crc.write(offset, value),
            0x4002_3800 => {
                // What runs from the old clocks has run until now.
                self.advance(now);
                let before = self.rcc.read(offset).unwrap_or(0);
                self.rcc.write(offset, value, now)?;
                self.follow_clocks(now);
                self.await_clocks(offset, before, now);
                if Rcc::is_reset_register(offset) {
                    self.reset_peripherals(offset, value, now);
                }
                self.follow_transmit_pins();
                self.follow_driven_pins(now);
                Some(())
            }
            0x4002_3C00 => {
                self.flash.advance(now);
                self.flash.write(offset, value)
            }
            0xE004_2000 => self.dbgmcu.write(offset, value),
            _ => None,
        }
    }

    /// A write to a peripheral reset register of the clock controller.
    fn reset_peripherals(&mut self, offset: u32, value: u32, now: u64) {
        let set = |bit: usize| value >> bit & 1 != 0;
        match offset {
            0x10 => {
                for port in (0..PORTS).filter(|port| set(*port)) {
                    self.ports[port].reset();
                }
            }
            0x14 if set(7) => {
                let otg = self.devices.iter().find(|device| device.range == map::OTG_FS);
                if let Some(otg) = otg {
                    otg.lock().reset(now);
                }
            }
            0x20 => {
                if set(28) {
                    self.power = power();
                }
                for timer in (0..TIMERS.len()).filter(|timer| set(*timer)) {
                    self.timers[timer] = self.timers[timer].after_reset();
                }
                for controller in (0..2).filter(|controller| set(25 + controller)) {
                    self.transmit_pins.controller_reset(controller, &self.ports);
                    self.can.reset(controller);
                }
            }
            0x24 => {
                if set(8) {
                    self.adc = Adc::default();
                }
                if set(14) {
                    self.syscfg = syscfg(self.boot_mode);
                }
            }
            _ => {}
        }
    }
}

fn block(address: u32, base: u32) -> usize {
    ((address - base) / BLOCK) as usize
}

/// The board as the core's bus reaches it.
pub struct SharedBoard(pub Arc<Mutex<Board>>);

impl SharedBoard {
    fn lock(&self) -> MutexGuard<'_, Board> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Bus for SharedBoard {
    fn read(&self, address: u32, size: u8, now: u64) -> Option<u32> {
        Some(self.lock().read(address, size, now))
    }

    fn write(&self, address: u32, size: u8, value: u32, now: u64) -> Option<()> {
        self.lock().write(address, size, value, now);
        Some(())
    }

    fn speeds(&self) -> Speeds {
        self.lock().speeds()
    }
}
