//! The flash interface (RM0090 Rev 21 §3): key unlock, sector erase and programming, with the times they
//! take (DS8626 Rev 10 Table 40, typical values), during which the core cannot fetch and so stalls.

use std::ops::Range;

use crate::Clock;
use crate::cpu::Memory;
use crate::hostile::{Dice, Tardy};
use crate::memory_map::FLASH;

/// What unlocks the control register.
pub const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];
const PG: u32 = 1;
const SER: u32 = 1 << 1;
const MER: u32 = 1 << 2;
const STRT: u32 = 1 << 16;
const LOCK: u32 = 1 << 31;
const EOP: u32 = 1;
const BSY: u32 = 1 << 16;
/// Error of programming: a store of another width than was set up.
pub const PGPERR: u32 = 1 << 6;
/// Error of programming: a store that was not set up.
pub const PGSERR: u32 = 1 << 7;
/// Every error: operation, write protection, alignment and those two.
const ERRORS: u32 = 1 << 1 | 1 << 4 | 1 << 5 | PGPERR | PGSERR;
const PROGRAM_US: u64 = 16;
/// Core cycles that a store to flash is on its way, unless the core waits for it at a barrier. The core's buffer and the bus have no
/// documented bound; this is longer than a program without a barrier takes to read the status and lock the interface.
const STORE_CYCLES: u64 = 48;

/// The sectors: four of 16 KiB, one of 64, seven of 128, with the time that erasing takes, in ms.
fn sector(number: u32) -> Option<(Range<u32>, u64)> {
    let (offset, kib, ms) = match number {
        0..=3 => (number * 16, 16, 250),
        4 => (64, 64, 550),
        5..=11 => (128 * (number - 4), 128, 1000),
        _ => return None,
    };
    let start = FLASH.start + offset * 1024;
    Some((start..start + kib * 1024, ms))
}

/// The wait states that a core clock requires at 2.7 to 3.6 V (RM0090 Rev 21 Table 11): one for each started 30
/// MHz beyond the first.
pub fn least_wait_states(hclk_hz: u64) -> u64 {
    hclk_hz.div_ceil(30_000_000).saturating_sub(1)
}

/// How flash is read (FLASH_ACR, RM0090 Rev 21 §3.9.1).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Access {
    /// LATENCY.
    pub wait_states: u64,
    /// PRFTEN.
    pub prefetch: bool,
    /// ICEN.
    pub instruction_cache: bool,
    /// DCEN.
    pub data_cache: bool,
}

/// The register block, and the memory behind it.
#[derive(Clone, Debug)]
pub struct FlashInterface {
    clock: Clock,
    memory: Memory,
    access: u32,
    keys_given: usize,
    status: u32,
    control: u32,
    options: u32,
    /// Core cycles for which the core now stalls.
    stall: u64,
    /// A store that has not arrived: the interface does not know of it yet and is not busy.
    under_way: Option<Store>,
    /// What the last operation changed, and whether it erased.
    last: Option<(Range<u32>, bool)>,
    now: u64,
    /// Until when the interface is busy, beyond the time for which the core stalls.
    busy_until: u64,
    lateness: Tardy,
    dice: Dice,
}

/// A store to flash.
#[derive(Clone, Copy, Debug)]
struct Store {
    address: u32,
    size: u8,
    value: u32,
    /// When it arrives.
    at: u64,
}

impl FlashInterface {
    /// Locked, as after reset.
    pub fn new(clock: Clock, memory: Memory) -> Self {
        let options = 0x0FFF_AAED;
        Self {
            clock,
            memory,
            access: 0,
            keys_given: 0,
            status: 0,
            control: LOCK,
            options,
            stall: 0,
            under_way: None,
            last: None,
            now: 0,
            busy_until: 0,
            lateness: Tardy::PROMPT,
            dice: Dice::default(),
        }
    }

    /// The same memory after a reset.
    #[must_use]
    pub fn after_reset(&self) -> Self {
        Self {
            lateness: self.lateness,
            dice: self.dice.clone(),
            ..Self::new(self.clock, self.memory.clone())
        }
    }

    /// Makes the interface busy beyond its operations' time.
    pub fn set_lateness(&mut self, lateness: Tardy, dice: Dice) {
        (self.lateness, self.dice) = (lateness, dice);
    }

    /// Ends that: see [`Dice::calm`].
    pub fn calm(&mut self) {
        self.dice.calm();
    }

    /// BSY, beyond the time for which the core stalls.
    fn is_busy(&self) -> bool {
        !self.dice.has_come(self.busy_until, self.now)
    }

    /// An operation has begun that stalls the core for this long.
    fn stall_for(&mut self, cycles: u64) {
        self.stall += cycles;
        self.busy_until = self.dice.due(self.lateness, self.now + self.stall);
    }

    /// The supply fails during the last operation: of the bits that it was to change, some have not. `word` gives random ones.
    pub fn cut_short(&mut self, mut word: impl FnMut() -> u32) {
        let Some((range, erases)) = self.last.take() else { return };
        for address in range.step_by(4) {
            let Some(now) = self.memory.word(address) else { continue };
            let left = if erases { now & word() } else { now | word() };
            self.memory.write(address, &left.to_le_bytes());
        }
    }

    /// How the program has set up reading.
    pub fn access(&self) -> Access {
        let set = |bit: u32| self.access >> bit & 1 != 0;
        Access {
            wait_states: (self.access & 7).into(),
            prefetch: set(8),
            instruction_cache: set(9),
            data_cache: set(10),
        }
    }

    /// Reads a register; `None` where there is none.
    pub fn read(&self, offset: u32) -> Option<u32> {
        Some(match offset {
            0x00 => self.access,
            0x04 | 0x08 => 0,
            0x0C => self.status | if self.is_busy() { BSY } else { 0 },
            0x10 => self.control,
            0x14 => self.options,
            _ => return None,
        })
    }

    /// Writes a register; `None` where there is none.
    pub fn write(&mut self, offset: u32, value: u32) -> Option<()> {
        match offset {
            0x00 => self.access = value,
            0x04 => self.take_key(value),
            0x08 => {}
            0x0C => self.status &= !(value & 0xF3),
            0x10 if self.control & LOCK != 0 || self.is_busy() => {}
            0x10 => {
                self.control = value & !STRT;
                if value & STRT != 0 {
                    self.erase();
                }
                if value & LOCK != 0 {
                    self.keys_given = 0;
                }
            }
            0x14 => self.options = value,
            _ => return None,
        }
        Some(())
    }

    /// A wrong or unexpected key locks the register until the next reset (RM0090, "Unlocking the
    /// Flash control register").
    fn take_key(&mut self, key: u32) {
        if self.control & LOCK == 0 {
            self.control |= LOCK;
            self.keys_given = usize::MAX;
        } else if KEYS.get(self.keys_given) == Some(&key) {
            self.keys_given += 1;
            if self.keys_given == KEYS.len() {
                self.control &= !LOCK;
            }
        } else {
            self.keys_given = usize::MAX;
        }
    }

    /// Whether an error that nobody has cleared keeps the interface from working. The manual does not mention this; users of
    /// the chip report it, and ST's own drivers clear the flags first.
    fn is_stuck(&self) -> bool {
        self.status & ERRORS != 0
    }

    /// Sets an error's flag, as a failed access does.
    pub fn leave_error(&mut self, error: u32) {
        self.status |= error;
    }

    fn erase(&mut self) {
        if self.is_stuck() {
            return;
        }
        let sectors = match self.control & (SER | MER) {
            SER => (self.control >> 3 & 15)..(self.control >> 3 & 15) + 1,
            MER => 0..12,
            _ => {
                self.status |= PGSERR;
                return;
            }
        };
        for number in sectors {
            let Some((range, ms)) = sector(number) else {
                self.status |= PGSERR;
                return;
            };
            self.memory.write(range.start, &vec![0xFF; range.len()]);
            self.last = Some((range, true));
            self.stall_for(self.clock.ms(ms));
        }
        self.status |= EOP;
    }

    /// The core stores to flash. The store arrives later; any earlier one has arrived by now.
    pub fn store(&mut self, address: u32, size: u8, value: u32, now: u64) {
        self.now = now;
        self.arrive();
        self.under_way = Some(Store { address, size, value, at: now + STORE_CYCLES });
    }

    /// When a store arrives.
    pub fn next_event(&self) -> Option<u64> {
        self.under_way.map(|store| store.at)
    }

    /// Lets a store arrive if its time has come.
    pub fn advance(&mut self, now: u64) {
        self.now = now;
        if self.next_event().is_some_and(|at| at <= now) {
            self.arrive();
        }
    }

    /// Lets a store arrive: the core waits for it.
    pub fn arrive(&mut self) {
        if let Some(Store { address, size, value, .. }) = self.under_way.take() {
            self.program(address, size, value);
        }
    }

    /// A store arrives: programs, if that was set up. Bits only go from 1 to 0.
    fn program(&mut self, address: u32, size: u8, value: u32) {
        let parallelism = 1 << (self.control >> 8 & 3);
        if self.control & PG == 0 || self.control & LOCK != 0 || self.is_stuck() || self.is_busy() {
            self.status |= PGSERR;
            return;
        }
        if u32::from(size) != parallelism {
            self.status |= PGPERR;
            return;
        }
        let mut bytes = [0; 4];
        let bytes = &mut bytes[..size.into()];
        self.memory.read(address, bytes);
        for (byte, new) in bytes.iter_mut().zip(value.to_le_bytes()) {
            *byte &= new;
        }
        self.memory.write(address, bytes);
        self.last = Some((address..address + u32::from(size), false));
        self.stall_for(self.clock.us(PROGRAM_US));
        self.status |= EOP;
    }

    /// Takes the number of core cycles for which the core is to stall.
    pub fn take_stall(&mut self) -> u64 {
        std::mem::take(&mut self.stall)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cpu::Memories;

    const CLOCK: Clock = Clock::new(144_000_000);

    fn unlocked() -> (FlashInterface, Memory) {
        let memory = Memories::new().flash;
        let mut flash = FlashInterface::new(CLOCK, memory.clone());
        for key in KEYS {
            flash.write(0x04, key).unwrap();
        }
        assert_eq!(flash.read(0x10).unwrap() & LOCK, 0);
        (flash, memory)
    }

    #[test]
    fn a_word_is_programmed_and_its_sector_erased() {
        let (mut flash, memory) = unlocked();
        let address = 0x080E_0000;
        flash.write(0x10, PG | 2 << 8).unwrap();
        flash.program(address, 4, 0x1234_5678);
        assert_eq!(memory.word(address), Some(0x1234_5678));
        flash.program(address, 4, 0xFFFF_0000);
        assert_eq!(memory.word(address), Some(0x1234_0000), "bits only fall");
        flash.write(0x10, SER | 11 << 3 | STRT).unwrap();
        assert_eq!(memory.word(address), Some(u32::MAX));
        assert_eq!(flash.read(0x0C).unwrap(), EOP);
        assert_eq!(flash.take_stall(), CLOCK.us(2 * 16 + 1_000_000));
    }

    #[test]
    fn who_does_not_wait_for_a_store_finds_the_interface_idle_and_loses_it_by_locking() {
        let address = 0x080E_0000;
        for waits in [true, false] {
            let (mut flash, memory) = unlocked();
            flash.write(0x10, PG | 2 << 8).unwrap();
            flash.store(address, 4, 0, 100);
            if waits {
                flash.arrive();
            }
            assert_eq!(flash.read(0x0C).unwrap(), if waits { EOP } else { 0 });
            flash.write(0x10, LOCK).unwrap();
            flash.advance(100 + STORE_CYCLES);
            assert_eq!(memory.word(address), Some(if waits { 0 } else { u32::MAX }));
            assert_eq!(flash.read(0x0C).unwrap() & PGSERR != 0, !waits);
        }
    }

    #[test]
    fn nothing_is_programmed_while_locked() {
        let memory = Memories::new().flash;
        let mut flash = FlashInterface::new(CLOCK, memory.clone());
        flash.write(0x10, PG | 2 << 8).unwrap();
        flash.program(FLASH.start, 4, 0);
        assert_eq!(memory.word(FLASH.start), Some(u32::MAX));
        assert_ne!(flash.read(0x0C).unwrap() & PGSERR, 0);
        flash.write(0x0C, PGSERR).unwrap();
        flash.write(0x04, 1).unwrap();
        for key in KEYS {
            flash.write(0x04, key).unwrap();
        }
        assert_ne!(flash.read(0x10).unwrap() & LOCK, 0, "a wrong key locks until reset");
    }

    #[test]
    fn an_error_that_nobody_clears_blocks_whatever_follows() {
        let (mut flash, memory) = unlocked();
        let address = 0x080E_0000;
        flash.leave_error(PGPERR);
        flash.write(0x10, PG | 2 << 8).unwrap();
        flash.program(address, 4, 0);
        flash.write(0x10, SER | 11 << 3 | STRT).unwrap();
        assert_eq!((memory.word(address), flash.take_stall()), (Some(u32::MAX), 0));
        flash.write(0x0C, PGPERR | PGSERR).unwrap();
        flash.write(0x10, PG | 2 << 8).unwrap();
        flash.program(address, 4, 0);
        assert_eq!(memory.word(address), Some(0));
    }

    #[test]
    fn a_key_that_is_not_wanted_locks_until_reset() {
        let (mut flash, _) = unlocked();
        for key in KEYS {
            flash.write(0x04, key).unwrap();
        }
        assert_ne!(flash.read(0x10).unwrap() & LOCK, 0);
    }
}
