//! Reset and clock control (RM0090 Rev 21 §7): oscillators are ready at once, and the clock tree is
//! worked out from what the firmware sets.

/// Internal oscillator.
const HSI_HZ: u64 = 16_000_000;

const CR: usize = 0x00;
const PLLCFGR: usize = 0x04;
const CFGR: usize = 0x08;
const AHB1RSTR: usize = 0x10;
const APB2RSTR: usize = 0x24;
const BDCR: usize = 0x70;
const CSR: usize = 0x74;
/// Bytes up to and with PLLI2SCFGR.
const LEN: usize = 0x88;

/// CR: each oscillator's enable bit, with its ready bit one above.
const CR_ENABLES: u32 = 1 | 1 << 16 | 1 << 24 | 1 << 26;
/// CSR: the software reset flag, the independent watchdog's, and the one that clears them all.
const SOFTWARE_RESET: u32 = 1 << 28;
const WATCHDOG_RESET: u32 = 1 << 29;
const POWER_ON_RESET: u32 = 1 << 27 | 1 << 25;
const PIN_RESET: u32 = 1 << 26;
const REMOVE_FLAGS: u32 = 1 << 24;
const RESET_FLAGS: u32 = 0xFE << 24;

/// Why the chip was last reset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ResetCause {
    /// Power came on.
    PowerOn,
    /// The firmware asked for it.
    Software,
    /// The independent watchdog was not fed.
    Watchdog,
}

/// Frequencies of the clock tree.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Clocks {
    /// System clock in Hz.
    pub sysclk_hz: u64,
    /// AHB's and the core's clock in Hz.
    pub hclk_hz: u64,
    /// APB1's clock in Hz: CAN, TIM2 to TIM7.
    pub pclk1_hz: u64,
    /// APB2's clock in Hz.
    pub pclk2_hz: u64,
    /// The 48 MHz clock of USB in Hz, 0 if the PLL is off.
    pub usb_hz: u64,
    /// Core cycles of an APB1 clock.
    pub cycles_per_pclk1: u64,
    /// Core cycles of a clock of the timers on APB1.
    pub cycles_per_timer_clock: u64,
}

/// The register block.
#[derive(Clone, Debug)]
pub struct Rcc {
    registers: [u32; LEN / 4],
    hse_hz: u64,
}

impl Rcc {
    /// After `cause`, with a crystal of `hse_hz`.
    pub fn new(hse_hz: u64, cause: ResetCause) -> Self {
        let mut registers = [0; LEN / 4];
        registers[CR / 4] = 0x83;
        registers[PLLCFGR / 4] = 0x2400_3010;
        registers[CSR / 4] = PIN_RESET
            | match cause {
                ResetCause::PowerOn => POWER_ON_RESET,
                ResetCause::Software => SOFTWARE_RESET,
                ResetCause::Watchdog => WATCHDOG_RESET,
            };
        registers[0x84 / 4] = 0x2000_3000;
        Self { registers, hse_hz }
    }

    /// Reads a register; `None` where there is none.
    pub fn read(&self, offset: u32) -> Option<u32> {
        self.registers.get(offset as usize / 4).copied()
    }

    /// Writes a register; `None` where there is none.
    pub fn write(&mut self, offset: u32, value: u32) -> Option<()> {
        let at = offset as usize;
        let register = self.registers.get_mut(at / 4)?;
        *register = match at {
            CR => value & !(CR_ENABLES << 1) | (value & CR_ENABLES) << 1 | value & 0xFF00,
            // The switch follows at once.
            CFGR => value & !0xC | (value & 3) << 2,
            BDCR => value & !2 | (value & 1) << 1,
            CSR => {
                let flags = if value & REMOVE_FLAGS != 0 { 0 } else { *register & RESET_FLAGS };
                flags | value & 1 | (value & 1) << 1
            }
            _ => value,
        };
        Some(())
    }

    /// Whether bit `bit` of the enable register at `offset` is set.
    pub fn enabled(&self, offset: u32, bit: u32) -> bool {
        self.registers[offset as usize / 4] >> bit & 1 != 0
    }

    /// Whether a write to `offset` goes to a peripheral reset register.
    pub fn is_reset_register(offset: u32) -> bool {
        (AHB1RSTR..=APB2RSTR).contains(&(offset as usize))
    }

    /// The clock tree as it is set.
    pub fn clocks(&self) -> Clocks {
        let pll = self.registers[PLLCFGR / 4];
        let field = |at: u32, bits: u32| u64::from(pll >> at & ((1 << bits) - 1));
        let (m, n, p, q) = (field(0, 6), field(6, 9), 2 * (field(16, 2) + 1), field(24, 4));
        let source = if pll >> 22 & 1 != 0 { self.hse_hz } else { HSI_HZ };
        let vco = (source * n).checked_div(m).unwrap_or(0);
        let pll_on = self.registers[CR / 4] >> 24 & 1 != 0;
        let cfgr = self.registers[CFGR / 4];
        let sysclk_hz = match cfgr & 3 {
            0 => HSI_HZ,
            1 => self.hse_hz,
            _ => vco / p,
        };
        let ahb = match cfgr >> 4 & 15 {
            code @ 8..=11 => 2 << (code - 8),
            code @ 12..=15 => 64 << (code - 12),
            _ => 1,
        };
        let apb = |at: u32| match cfgr >> at & 7 {
            code @ 4..=7 => 2u64 << (code - 4),
            _ => 1,
        };
        let (apb1, apb2) = (apb(10), apb(13));
        let hclk_hz = sysclk_hz / ahb;
        Clocks {
            sysclk_hz,
            hclk_hz,
            pclk1_hz: hclk_hz / apb1,
            pclk2_hz: hclk_hz / apb2,
            usb_hz: if pll_on { vco.checked_div(q).unwrap_or(0) } else { 0 },
            cycles_per_pclk1: apb1,
            // Timers run at twice their bus's clock unless that is the core's (§7.2).
            cycles_per_timer_clock: (apb1 / 2).max(1),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_boards_clock_tree_is_worked_out() {
        let mut rcc = Rcc::new(8_000_000, ResetCause::PowerOn);
        // HSE 8 MHz / 4 × 144 / 2 = 144 MHz, / 6 = 48 MHz; APB1 / 4, APB2 / 2.
        rcc.write(PLLCFGR as u32, 4 | 144 << 6 | 1 << 22 | 6 << 24).unwrap();
        rcc.write(CR as u32, 1 | 1 << 16 | 1 << 24).unwrap();
        assert_eq!(rcc.read(CR as u32).unwrap() & 1 << 25, 1 << 25, "the PLL is ready");
        rcc.write(CFGR as u32, 2 | 5 << 10 | 4 << 13).unwrap();
        assert_eq!(rcc.read(CFGR as u32).unwrap() >> 2 & 3, 2, "it is the system clock");
        let clocks = rcc.clocks();
        assert_eq!((clocks.sysclk_hz, clocks.pclk1_hz, clocks.usb_hz), (144_000_000, 36_000_000, 48_000_000));
        assert_eq!((clocks.cycles_per_pclk1, clocks.cycles_per_timer_clock), (4, 2));
    }

    #[test]
    fn reset_flags_stay_until_removed() {
        let mut rcc = Rcc::new(8_000_000, ResetCause::Watchdog);
        assert_ne!(rcc.read(0x74).unwrap() & WATCHDOG_RESET, 0);
        rcc.write(0x74, REMOVE_FLAGS).unwrap();
        assert_eq!(rcc.read(0x74).unwrap() & RESET_FLAGS, 0);
    }
}
