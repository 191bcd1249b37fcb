//! The small peripherals: GPIO ports, the independent watchdog, the ADC as far as temperature and
//! supply voltage need it, the factory values, and blocks that only need storage.

use crate::Clock;

/// A GPIO port (RM0090 Rev 21 §8). Pins in input mode read their external level, high by default.
#[derive(Clone, Debug)]
pub struct Gpio {
    port: usize,
    registers: [u32; 10],
    /// External levels of the pins.
    pub inputs: u16,
}

const MODER: usize = 0;
const IDR: usize = 4;
const ODR: usize = 5;
const BSRR: usize = 6;
const AFRL: usize = 8;

impl Gpio {
    /// Port 0 (A), 1 (B) and so on after reset: the debug port's pins are set up.
    pub fn new(port: usize) -> Self {
        let mut gpio = Self { port, registers: [0; 10], inputs: u16::MAX };
        gpio.reset();
        gpio
    }

    /// Resets the registers; the levels applied to the pins stay.
    pub fn reset(&mut self) {
        self.registers = [0; 10];
        self.registers[MODER] = [0xA800_0000, 0x280].get(self.port).copied().unwrap_or(0);
    }

    /// Reads a register; `None` where there is none.
    pub fn read(&self, offset: u32) -> Option<u32> {
        let at = offset as usize / 4;
        match at {
            IDR => Some((0..16).filter(|pin| self.pin(*pin)).fold(0, |levels, pin| levels | 1 << pin)),
            BSRR => Some(0),
            _ => self.registers.get(at).copied(),
        }
    }

    /// Writes a register; `None` where there is none.
    pub fn write(&mut self, offset: u32, value: u32) -> Option<()> {
        match offset as usize / 4 {
            IDR => {}
            // Setting wins over resetting.
            BSRR => self.registers[ODR] = self.registers[ODR] & !(value >> 16) | value & 0xFFFF,
            at => *self.registers.get_mut(at)? = value,
        }
        Some(())
    }

    /// Whether a pin is connected to the peripheral of an alternate function.
    pub fn is_connected(&self, pin: u32, function: u32) -> bool {
        let [low, high] = [self.registers[AFRL], self.registers[AFRL + 1]];
        let chosen = if pin < 8 { low >> (4 * pin) } else { high >> (4 * (pin - 8)) } & 0xF;
        self.registers[MODER] >> (2 * pin) & 3 == 2 && chosen == function
    }

    /// A pin's level: what it drives if it is an output, what is applied otherwise.
    pub fn pin(&self, pin: u32) -> bool {
        let output = self.registers[MODER] >> (2 * pin) & 3 == 1;
        if output { self.registers[ODR] >> pin & 1 != 0 } else { self.inputs >> pin & 1 != 0 }
    }

    /// Whether a pin is set up as an output, and its level then.
    pub fn output(&self, pin: u32) -> Option<bool> {
        (self.registers[MODER] >> (2 * pin) & 3 == 1).then(|| self.pin(pin))
    }
}

/// The CRC unit: CRC-32 with the polynomial 04C11DB7 over whole words, the highest bit first (RM0090, "CRC calculation unit").
#[derive(Clone, Debug)]
pub struct Crc {
    sum: u32,
    scratch: u32,
}

impl Default for Crc {
    fn default() -> Self {
        Self { sum: u32::MAX, scratch: 0 }
    }
}

impl Crc {
    /// Reads a register; `None` where there is none.
    pub fn read(&self, offset: u32) -> Option<u32> {
        match offset {
            0 => Some(self.sum),
            4 => Some(self.scratch),
            8 => Some(0),
            _ => None,
        }
    }

    /// Writes a register; `None` where there is none.
    pub fn write(&mut self, offset: u32, value: u32) -> Option<()> {
        match offset {
            0 => {
                self.sum = (0..32)
                    .fold(self.sum ^ value, |sum, _| sum << 1 ^ if sum >> 31 == 0 { 0 } else { 0x04C1_1DB7 });
            }
            4 => self.scratch = value & 0xFF,
            8 if value & 1 != 0 => self.sum = u32::MAX,
            8 => {}
            _ => return None,
        }
        Some(())
    }
}

/// The watchdog's own oscillator.
const LSI_HZ: u64 = 32_000;

/// The independent watchdog (RM0090 Rev 21 §21).
#[derive(Clone, Debug)]
pub struct Watchdog {
    clock: Clock,
    prescaler: u32,
    reload: u32,
    unlocked: bool,
    deadline: Option<u64>,
}

impl Watchdog {
    /// A watchdog that has not been started.
    pub fn new(clock: Clock) -> Self {
        Self { clock, prescaler: 0, reload: 0xFFF, unlocked: false, deadline: None }
    }

    /// Reads a register; `None` where there is none.
    pub fn read(&self, offset: u32) -> Option<u32> {
        [0, self.prescaler, self.reload, 0].get(offset as usize / 4).copied()
    }

    /// Writes a register; `None` where there is none.
    pub fn write(&mut self, offset: u32, value: u32, now: u64) -> Option<()> {
        match (offset, value & 0xFFFF) {
            (0x00, 0xCCCC) => self.feed(now),
            (0x00, 0xAAAA) if self.deadline.is_some() => self.feed(now),
            (0x00, key) => self.unlocked = key == 0x5555,
            (0x04, value) if self.unlocked => self.prescaler = value & 7,
            (0x08, value) if self.unlocked => self.reload = value & 0xFFF,
            (0x04 | 0x08, _) => {}
            _ => return None,
        }
        Some(())
    }

    fn feed(&mut self, now: u64) {
        let ticks = (4 << self.prescaler.min(6)) * (u64::from(self.reload) + 1);
        self.deadline = Some(now + ticks * self.clock.hz() / LSI_HZ);
        self.unlocked = false;
    }

    /// When it will reset the chip unless fed; `None` if it was never started.
    pub fn deadline(&self) -> Option<u64> {
        self.deadline
    }
}

/// Factory values in system memory (DS8626 Rev 10 §6.3.21, RM0090 Rev 21 §39): a unique ID, the flash size,
/// and the ADC's calibration at 3.3 V: the internal reference, the temperature sensor at 30 and 110 °C.
pub const UNIQUE_ID: [u32; 3] = [0x0029_0031, 0x3334_5104, 0x3630_3439];
const FLASH_KIB: u16 = 1024;
const VREFINT_CAL: u16 = 1502;
const TS_CAL1: u16 = 943;
const TS_CAL2: u16 = 1205;

/// Reads the factory values.
pub fn factory_values(address: u32, size: u8) -> u32 {
    let word = match address & !3 {
        at @ 0x1FFF_7A10..=0x1FFF_7A18 => UNIQUE_ID[(at - 0x1FFF_7A10) as usize / 4],
        0x1FFF_7A20 => u32::from(FLASH_KIB) << 16 | 0xFFFF,
        0x1FFF_7A28 => u32::from(VREFINT_CAL) << 16 | 0xFFFF,
        0x1FFF_7A2C => u32::from(TS_CAL2) << 16 | u32::from(TS_CAL1),
        _ => u32::MAX,
    };
    let shifted = word >> (8 * (address & 3));
    if size == 4 { shifted } else { shifted & ((1 << (8 * size)) - 1) }
}

/// ADC1 and the common block (RM0090 Rev 21 §13): regular single conversions of the internal channels, done
/// at once. The chip is at 30 °C and 3.3 V.
#[derive(Clone, Debug, Default)]
pub struct Adc {
    registers: [u32; 20],
    common: u32,
    status: u32,
}

const ADC_CR2: usize = 2;
const ADC_SQR3: usize = 13;
const ADC_DR: usize = 19;
const EOC: u32 = 1 << 1;
const ADON: u32 = 1;
const SWSTART: u32 = 1 << 30;

impl Adc {
    /// Reads a register; `None` where there is none.
    pub fn read(&mut self, offset: u32) -> Option<u32> {
        match offset {
            0x00 => Some(self.status),
            0x4C => {
                self.status &= !EOC;
                Some(self.registers[ADC_DR])
            }
            0x304 => Some(self.common),
            _ => self.registers.get(offset as usize / 4).copied(),
        }
    }

    /// Writes a register; `None` where there is none.
    pub fn write(&mut self, offset: u32, value: u32) -> Option<()> {
        match offset {
            0x00 => self.status &= value,
            0x304 => self.common = value,
            _ => {
                *self.registers.get_mut(offset as usize / 4)? = value & !SWSTART;
                if offset as usize / 4 == ADC_CR2 && value & SWSTART != 0 && value & ADON != 0 {
                    self.convert();
                }
            }
        }
        Some(())
    }

    fn convert(&mut self) {
        // TSVREFE switches the internal channels on.
        let internal = self.common >> 23 & 1 != 0;
        self.registers[ADC_DR] = match self.registers[ADC_SQR3] & 31 {
            16 if internal => TS_CAL1.into(),
            17 if internal => VREFINT_CAL.into(),
            _ => 0,
        };
        self.status |= EOC;
    }
}

/// A block whose registers only store what was written, with bits that always read as 1.
#[derive(Clone, Debug)]
pub struct Storage {
    registers: Vec<u32>,
    ones: &'static [(usize, u32)],
}

impl Storage {
    /// `count` registers that are zero, except for the bits `ones` (register, mask) that stay set.
    pub fn new(count: usize, ones: &'static [(usize, u32)]) -> Self {
        Self { registers: vec![0; count], ones }
    }

    /// Reads a register; `None` where there is none.
    pub fn read(&self, offset: u32) -> Option<u32> {
        let at = offset as usize / 4;
        let ones = self.ones.iter().find(|(register, _)| *register == at).map_or(0, |(_, mask)| *mask);
        Some(self.registers.get(at)? | ones)
    }

    /// Writes a register; `None` where there is none.
    pub fn write(&mut self, offset: u32, value: u32) -> Option<()> {
        *self.registers.get_mut(offset as usize / 4)? = value;
        Some(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pin_drives_its_output_only_as_an_output() {
        let mut port = Gpio::new(2);
        port.write(0x18, 1 << 12).unwrap();
        assert_eq!(port.output(12), None);
        port.write(0x00, 1 << 24).unwrap();
        assert_eq!(port.output(12), Some(true));
        port.write(0x18, 1 << 28).unwrap();
        assert_eq!((port.output(12), port.read(0x10)), (Some(false), Some(0xEFFF)));
    }

    #[test]
    fn the_watchdog_bites_after_its_period_unless_fed() {
        const SECOND: u64 = 144_000_000;
        let mut watchdog = Watchdog::new(Clock::new(SECOND));
        assert_eq!(watchdog.deadline(), None);
        for (offset, value) in [(0, 0xCCCC), (0, 0x5555), (4, 3), (8, 999), (0, 0xAAAA)] {
            watchdog.write(offset, value, 0).unwrap();
        }
        // 32 × 1000 / 32 kHz is a second.
        assert_eq!(watchdog.deadline(), Some(SECOND));
        watchdog.write(0, 0xAAAA, 1000).unwrap();
        assert_eq!(watchdog.deadline(), Some(1000 + SECOND));
    }

    #[test]
    fn the_factory_values_are_where_the_manual_says() {
        assert_eq!(factory_values(0x1FFF_7A10, 4), UNIQUE_ID[0]);
        assert_eq!(factory_values(0x1FFF_7A22, 2), 1024);
        assert_eq!(factory_values(0x1FFF_7A2A, 2), u32::from(VREFINT_CAL));
        assert_eq!(factory_values(0x1FFF_7A2E, 2), u32::from(TS_CAL2));
    }
}
