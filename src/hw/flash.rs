//! The last sector of the flash, for what is saved over a power cycle (RM0090, "Embedded flash memory
//! interface").
//!
//! Erasing and programming stop every instruction fetch from flash: 16 µs for a word, which the receive FIFOs
//! bear, up to 2 s for the sector, which they do not (STM32F405 data sheet, "Flash memory programming").

use cantap_firmware::saved::Sector;
use stm32f4xx_hal::pac::FLASH;

/// Sector 11: the last of the first mebibyte. `memory.x` leaves it out of the firmware's memory.
const SECTOR: u8 = 11;
const START: *const u32 = 0x080E_0000 as *const u32;
const WORDS: usize = 128 * 1024 / 4;
/// RM0090, "Unlocking the Flash control register".
const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];

/// The sector.
pub struct LastSector(FLASH);

impl LastSector {
    /// Takes the flash interface; the clock setup is done with it.
    pub const fn new(flash: FLASH) -> Self {
        Self(flash)
    }

    /// Unlocks the flash, does something, waits for its end, locks the flash.
    fn unlocked(&mut self, act: impl FnOnce(&FLASH)) {
        for key in KEYS {
            // SAFETY: the two keys, in their order.
            self.0.keyr().write(|w| unsafe { w.bits(key) });
        }
        act(&self.0);
        while self.0.sr().read().bsy().bit() {}
        self.0.cr().modify(|_, w| w.pg().clear_bit().ser().clear_bit().lock().set_bit());
        // What was read before is not there any more.
        self.0.acr().modify(|_, w| w.dcen().clear_bit());
        self.0.acr().modify(|_, w| w.dcrst().set_bit());
        self.0.acr().modify(|_, w| w.dcrst().clear_bit().dcen().set_bit());
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
        self.unlocked(|flash| {
            flash.cr().modify(|_, w| w.psize().psize32().pg().set_bit());
            // SAFETY: inside the sector, which nobody holds a reference to, because `self` is exclusive.
            unsafe { START.cast_mut().add(index).write_volatile(word) };
        });
        // SAFETY: as above. Volatile, because the compiler does not see that the memory changed.
        unsafe { START.add(index).read_volatile() == word }
    }

    fn erase(&mut self) -> bool {
        self.unlocked(|flash| {
            // SAFETY: the chip has this sector.
            flash.cr().modify(|_, w| unsafe { w.psize().psize32().ser().set_bit().snb().bits(SECTOR) });
            flash.cr().modify(|_, w| w.strt().set_bit());
        });
        // SAFETY: the first word of the sector; volatile, because the compiler does not see that it changed.
        unsafe { START.read_volatile() == cantap_firmware::saved::ERASED }
    }
}
