//! The last sector of the flash, for what is kept over a power cycle (RM0090, "Embedded flash memory
//! interface").
//!
//! Erasing and programming stop every instruction fetch from flash: 16 µs for a word, which the receive FIFOs
//! can bear, and up to 2 s for the sector, which they cannot (STM32F405 data sheet, "Flash memory
//! programming").
//!
//! An error flag stays until it is cleared, and while one is set the interface accepts nothing: users of the chip report
//! this, and ST's drivers clear the flags before each operation. So does this one, no matter what set them.

use cantap_firmware::TICKS_PER_MS;
use cantap_firmware::saved::Sector;
use stm32f4xx_hal::pac::FLASH;

use super::clocks;
use super::stamp::StampTimer;

/// Sector 11: the last of the first mebibyte. `memory.x` leaves it out of the firmware's memory.
const SECTOR: u8 = 11;
const START: *const u32 = 0x080E_0000 as *const u32;
const WORDS: usize = 128 * 1024 / 4;
/// RM0090, "Unlocking the Flash control register".
const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];

/// Erasing the sector takes 2 s at most, programming a word 100 µs (data sheet, as above). A flash that is busy for longer does not end, and
/// must be given up before the watchdog bites.
const ERASE_TICKS: u32 = 2_200 * TICKS_PER_MS;
const PROGRAM_TICKS: u32 = 10 * TICKS_PER_MS;
/// The first of these as a number of reads at 16 MHz, each with its loop at least 5 cycles: before there is a timer.
const MOST_READS: u32 = 2_200 * (clocks::HSI_HZ / 1_000 / 5);

/// Locks the control register, which another program may have left open, and clears any error flags left behind.
pub fn lock(flash: &FLASH) {
    let mut reads = MOST_READS;
    while is_busy(flash) && reads > 0 {
        reads -= 1;
    }
    clear_flags(flash);
    flash.cr().write(|w| w.lock().set_bit());
}

fn is_busy(flash: &FLASH) -> bool {
    flash.sr().read().bsy().bit()
}

fn clear_flags(flash: &FLASH) {
    flash.sr().write(|w| {
        w.eop().clear().operr().clear().wrperr().clear().pgaerr().clear().pgperr().clear().pgserr().clear()
    });
}

/// Whether the last operation reported no error.
fn went_well(flash: &FLASH) -> bool {
    let sr = flash.sr().read();
    !(sr.operr().is_active()
        || sr.wrperr().is_active()
        || sr.pgaerr().is_active()
        || sr.pgperr().is_active()
        || sr.pgserr().is_active())
}

/// The sector.
pub struct LastSector(FLASH, StampTimer);

impl LastSector {
    /// Takes the flash interface, which the clock setup no longer needs.
    pub const fn new(flash: FLASH, timer: StampTimer) -> Self {
        Self(flash, timer)
    }

    /// Waits for the end of an operation; returns whether it came within this time.
    fn wait(&self, most_ticks: u32) -> bool {
        let from = self.1.now();
        while is_busy(&self.0) {
            if self.1.now().wrapping_sub(from) > most_ticks {
                return false;
            }
        }
        true
    }

    /// Unlocks the flash, runs `act`, waits until it is done, locks the flash. Returns whether it succeeded within `most_ticks`.
    fn unlocked(&mut self, most_ticks: u32, act: impl FnOnce(&FLASH)) -> bool {
        // Every operation is waited for, so this is one that was given up.
        if is_busy(&self.0) {
            return false;
        }
        // Keys written when the register is not locked would lock it until the next reset. It is locked by `lock` at the start, and at
        // the end of this function, unless the flash was busy then.
        if self.0.cr().read().lock().bit() {
            for key in KEYS {
                // SAFETY: the two keys, in their order.
                self.0.keyr().write(|w| unsafe { w.bits(key) });
            }
        }
        clear_flags(&self.0);
        act(&self.0);
        // A store may still be on its way, and the flash not busy yet.
        cortex_m::asm::dsb();
        let went_well = self.wait(most_ticks) && went_well(&self.0);
        self.0.cr().modify(|_, w| w.pg().clear_bit().ser().clear_bit().lock().set_bit());
        // The data cache, where it is used (`clocks`), may hold what was there before.
        if self.0.acr().read().dcen().bit() {
            self.0.acr().modify(|_, w| w.dcen().clear_bit());
            self.0.acr().modify(|_, w| w.dcrst().set_bit());
            self.0.acr().modify(|_, w| w.dcrst().clear_bit().dcen().set_bit());
        }
        went_well
    }
}

impl Sector for LastSector {
    fn words(&self) -> &[u32] {
        // SAFETY: the sector is flash, readable and aligned, and nothing else is there (memory.x). It changes only
        // through `&mut self`.
        unsafe { core::slice::from_raw_parts(START, WORDS) }
    }

    fn program(&mut self, index: usize, word: u32) -> bool {
        if index >= WORDS {
            return false;
        }
        let went_well = self.unlocked(PROGRAM_TICKS, |flash| {
            flash.cr().modify(|_, w| w.psize().psize32().pg().set_bit());
            // SAFETY: inside the sector, which nobody holds a reference to, because `self` is exclusive.
            unsafe { START.cast_mut().add(index).write_volatile(word) };
        });
        // SAFETY: as above. Volatile, because the compiler does not see that the memory changed.
        went_well && unsafe { START.add(index).read_volatile() == word }
    }

    fn erase(&mut self) -> bool {
        let went_well = self.unlocked(ERASE_TICKS, |flash| {
            // SAFETY: the chip has this sector.
            flash.cr().modify(|_, w| unsafe { w.psize().psize32().ser().set_bit().snb().bits(SECTOR) });
            flash.cr().modify(|_, w| w.strt().set_bit());
        });
        // SAFETY: the first word of the sector; volatile, because the compiler does not see that it changed.
        went_well && unsafe { START.read_volatile() == cantap_firmware::saved::ERASED }
    }
}
