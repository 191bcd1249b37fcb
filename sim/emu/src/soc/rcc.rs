//! Reset and clock control (RM0090 Rev 21 §7): the crystal and the PLL take time to start, what is in use cannot
//! be switched off or changed, and the clock tree is worked out from what the firmware sets.

use crate::Clock;

/// Internal oscillator.
const HSI_HZ: u64 = 16_000_000;

/// How long a good crystal takes to start, in µs: DS8626, "HSE 4-26 MHz oscillator characteristics", typical.
pub const CRYSTAL_START_US: u64 = 2_000;
/// How long the PLL takes to lock, in µs: DS8626, "Main PLL characteristics", the longest at 192 MHz.
const PLL_LOCK_US: u64 = 200;

const CR: usize = 0x00;
const PLLCFGR: usize = 0x04;
const CFGR: usize = 0x08;
const AHB1RSTR: usize = 0x10;
const APB2RSTR: usize = 0x24;
const AHB1ENR: usize = 0x30;
const APB2ENR: usize = 0x44;
const BDCR: usize = 0x70;
const CSR: usize = 0x74;
/// Bytes up to and including PLLI2SCFGR.
const LEN: usize = 0x88;

/// CR: each oscillator's enable bit, with its ready bit one above.
const HSION: u32 = 1;
const HSEON: u32 = 1 << 16;
const PLLON: u32 = 1 << 24;
const PLLI2SON: u32 = 1 << 26;
const CR_ENABLES: u32 = HSION | HSEON | PLLON | PLLI2SON;
/// PLLCFGR: the PLL runs from the crystal.
const PLLSRC: u32 = 1 << 22;
/// CFGR: the requested source of the system clock; two bits above it, the actual one: 0 HSI, 1 HSE, 2 PLL.
const SW: u32 = 3;
const SWS: u32 = SW << 2;
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

/// The board's crystal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Crystal {
    /// Its frequency.
    pub hz: u64,
    /// How long it takes to start, in µs; `None` if it is broken.
    pub start_us: Option<u64>,
}

/// The register block.
#[derive(Clone, Debug)]
pub struct Rcc {
    registers: [u32; LEN / 4],
    clock: Clock,
    crystal: Crystal,
    /// When the crystal and the PLL are ready: `None` if they are off or have no clock.
    hse_ready_at: Option<u64>,
    pll_ready_at: Option<u64>,
}

impl Rcc {
    /// The state after a reset by `cause`, with the board's crystal.
    pub fn new(clock: Clock, crystal: Crystal, cause: ResetCause) -> Self {
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
        Self { registers, clock, crystal, hse_ready_at: None, pll_ready_at: None }
    }

    /// Reads a register; `None` where there is none. It shows the state at the last [`Self::settle`].
    pub fn read(&self, offset: u32) -> Option<u32> {
        self.registers.get(offset as usize / 4).copied()
    }

    /// Updates the flags of oscillators that are ready by `now`, and switches over to them if requested. Returns whether
    /// the system clock changed.
    pub fn settle(&mut self, now: u64) -> bool {
        let cr = self.registers[CR / 4];
        let ready = |at: Option<u64>| at.is_some_and(|at| at <= now);
        let mut running = cr & (HSION | PLLI2SON);
        running |= if ready(self.hse_ready_at) { HSEON } else { 0 };
        running |= if ready(self.pll_ready_at) { PLLON } else { 0 };
        self.registers[CR / 4] = cr & !(CR_ENABLES << 1) | running << 1;
        let cfgr = self.registers[CFGR / 4];
        let source = [HSION, HSEON, PLLON, 0][(cfgr & SW) as usize];
        if running & source == 0 || cfgr >> 2 & SW == cfgr & SW {
            return false;
        }
        self.registers[CFGR / 4] = cfgr & !SWS | (cfgr & SW) << 2;
        true
    }

    /// The enable bits in CR that the system clock depends on: these cannot be cleared (RCC_CR).
    fn in_use(&self) -> u32 {
        let source = if self.registers[PLLCFGR / 4] & PLLSRC == 0 { HSION } else { HSEON };
        match self.registers[CFGR / 4] >> 2 & SW {
            0 => HSION,
            1 => HSEON,
            _ => PLLON | source,
        }
    }

    /// Whether the system clock comes from the crystal.
    pub fn needs_crystal(&self) -> bool {
        self.in_use() & HSEON != 0
    }

    /// The crystal is another from now on: one that has stopped, or that starts again.
    pub fn exchange_crystal(&mut self, crystal: Crystal, now: u64) {
        self.crystal = crystal;
        let wanted = self.registers[CR / 4] & HSEON != 0;
        self.hse_ready_at = crystal.start_us.filter(|_| wanted).map(|us| now + self.clock.us(us));
    }

    fn switch_oscillators(&mut self, value: u32, now: u64) {
        let before = self.registers[CR / 4];
        let value = value | before & self.in_use();
        if value & HSEON == 0 {
            self.hse_ready_at = None;
        } else if before & HSEON == 0 {
            self.hse_ready_at = self.crystal.start_us.map(|us| now + self.clock.us(us));
        }
        if value & PLLON == 0 {
            self.pll_ready_at = None;
        } else if before & PLLON == 0 {
            let from_crystal = self.registers[PLLCFGR / 4] & PLLSRC != 0;
            let source_at = if from_crystal { self.hse_ready_at } else { Some(now) };
            self.pll_ready_at = source_at.map(|at| at.max(now) + self.clock.us(PLL_LOCK_US));
        }
        // The calibration is set by the factory.
        self.registers[CR / 4] = value & !0xFF00 | before & 0xFF00;
    }

    /// Writes a register; `None` where there is none, or if it does not accept the value now.
    pub fn write(&mut self, offset: u32, value: u32, now: u64) -> Option<()> {
        self.settle(now);
        let at = offset as usize;
        match at {
            CR => self.switch_oscillators(value, now),
            // The PLL's factors can be written only while it is off (RCC_PLLCFGR).
            PLLCFGR if self.registers[CR / 4] & PLLON != 0 => return None,
            _ => self.store(at, value)?,
        }
        self.settle(now);
        Some(())
    }

    fn store(&mut self, at: usize, value: u32) -> Option<()> {
        let register = self.registers.get_mut(at / 4)?;
        *register = match at {
            CFGR => value & !SWS | *register & SWS,
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

    /// Whether `offset` is a peripheral clock enable register's.
    pub fn is_enable_register(offset: u32) -> bool {
        (AHB1ENR..=APB2ENR).contains(&(offset as usize))
    }

    /// Whether a write to `offset` goes to a peripheral reset register.
    pub fn is_reset_register(offset: u32) -> bool {
        (AHB1RSTR..=APB2RSTR).contains(&(offset as usize))
    }

    /// The clock tree as currently set.
    pub fn clocks(&self) -> Clocks {
        let pll = self.registers[PLLCFGR / 4];
        let field = |at: u32, bits: u32| u64::from(pll >> at & ((1 << bits) - 1));
        let (m, n, p, q) = (field(0, 6), field(6, 9), 2 * (field(16, 2) + 1), field(24, 4));
        let source = if pll & PLLSRC != 0 { self.crystal.hz } else { HSI_HZ };
        let vco = (source * n).checked_div(m).unwrap_or(0);
        let pll_runs = self.registers[CR / 4] & PLLON << 1 != 0;
        let cfgr = self.registers[CFGR / 4];
        let sysclk_hz = match cfgr >> 2 & SW {
            0 => HSI_HZ,
            1 => self.crystal.hz,
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
            usb_hz: if pll_runs { vco.checked_div(q).unwrap_or(0) } else { 0 },
            cycles_per_pclk1: apb1,
            // Timers run at twice their bus's clock unless that is the core's (§7.2).
            cycles_per_timer_clock: (apb1 / 2).max(1),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CRYSTAL: Crystal = Crystal { hz: 8_000_000, start_us: Some(CRYSTAL_START_US) };
    const CLOCK: Clock = Clock::new(144_000_000);
    const CRYSTAL_START: u64 = CLOCK.us(CRYSTAL_START_US);
    const PLL_LOCK: u64 = CLOCK.us(PLL_LOCK_US);
    /// HSE 8 MHz / 4 × 144 / 2 = 144 MHz, / 6 = 48 MHz.
    const FACTORS: u32 = 4 | 144 << 6 | PLLSRC | 6 << 24;

    fn rcc() -> Rcc {
        Rcc::new(CLOCK, CRYSTAL, ResetCause::PowerOn)
    }

    fn reads(rcc: &mut Rcc, register: usize, now: u64) -> u32 {
        rcc.settle(now);
        rcc.read(register as u32).unwrap()
    }

    #[test]
    fn the_boards_clock_tree_is_worked_out() {
        let mut rcc = rcc();
        rcc.write(PLLCFGR as u32, FACTORS, 0).unwrap();
        rcc.write(CR as u32, HSION | HSEON | PLLON, 0).unwrap();
        // APB1 / 4, APB2 / 2.
        rcc.write(CFGR as u32, 2 | 5 << 10 | 4 << 13, 0).unwrap();
        assert_eq!(reads(&mut rcc, CFGR, CRYSTAL_START + PLL_LOCK - 1) & SWS, 0, "it waits for the PLL");
        assert_eq!(rcc.clocks().sysclk_hz, HSI_HZ);
        assert_eq!(reads(&mut rcc, CR, CRYSTAL_START + PLL_LOCK) & PLLON << 1, PLLON << 1);
        assert_eq!(reads(&mut rcc, CFGR, CRYSTAL_START + PLL_LOCK) & SWS, 2 << 2);
        let clocks = rcc.clocks();
        assert_eq!((clocks.sysclk_hz, clocks.pclk1_hz, clocks.usb_hz), (144_000_000, 36_000_000, 48_000_000));
        assert_eq!((clocks.cycles_per_pclk1, clocks.cycles_per_timer_clock), (4, 2));
    }

    #[test]
    fn what_is_in_use_can_neither_be_changed_nor_switched_off() {
        let mut rcc = rcc();
        rcc.write(PLLCFGR as u32, FACTORS, 0).unwrap();
        rcc.write(CR as u32, HSION | HSEON | PLLON, 0).unwrap();
        let now = CRYSTAL_START + PLL_LOCK;
        rcc.write(CFGR as u32, 2, now).unwrap();
        assert_eq!(rcc.write(PLLCFGR as u32, 0, now), None);
        assert_eq!(rcc.read(PLLCFGR as u32), Some(FACTORS));
        rcc.write(CR as u32, 0, now).unwrap();
        assert_eq!(reads(&mut rcc, CR, now) & CR_ENABLES, HSEON | PLLON);
        rcc.write(CR as u32, HSION | HSEON | PLLON, now).unwrap();
        rcc.write(CFGR as u32, 0, now).unwrap();
        rcc.write(CR as u32, HSION, now).unwrap();
        assert_eq!(reads(&mut rcc, CR, now) & CR_ENABLES, HSION);
        rcc.write(PLLCFGR as u32, 0x2400_3010, now).unwrap();
    }

    #[test]
    fn a_broken_crystal_is_never_ready() {
        let mut rcc = Rcc::new(CLOCK, Crystal { start_us: None, ..CRYSTAL }, ResetCause::PowerOn);
        rcc.write(CR as u32, HSION | HSEON, 0).unwrap();
        rcc.write(CFGR as u32, 1, 0).unwrap();
        assert_eq!(reads(&mut rcc, CR, u64::MAX) & HSEON << 1, 0);
        assert_eq!(rcc.clocks().sysclk_hz, HSI_HZ);
    }

    #[test]
    fn reset_flags_stay_until_removed() {
        let mut rcc = Rcc::new(CLOCK, CRYSTAL, ResetCause::Watchdog);
        assert_ne!(rcc.read(0x74).unwrap() & WATCHDOG_RESET, 0);
        rcc.write(0x74, REMOVE_FLAGS, 0).unwrap();
        assert_eq!(rcc.read(0x74).unwrap() & RESET_FLAGS, 0);
    }
}
