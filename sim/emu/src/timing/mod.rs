//! What the core waits for in addition to its own work: flash, the bridges to the peripherals, the pipeline.
//! This module knows addresses and times of accesses, and nothing about the program that makes them.
//!
//! There are two bounds, because not everything that a real chip does has been published. [`Bound::Best`] is a
//! core that never waits. [`Bound::Worst`] charges what the manuals say, and where they leave something open,
//! the most they allow; `docs/emulator.md` lists each figure with its source. A real chip lies between the two.

mod flash;
mod speeds;
mod system_bus;

use std::fmt;
use std::str::FromStr;

use flash::FlashReads;
pub use speeds::Speeds;
use system_bus::SystemBus;

/// Cycles that a taken branch costs beyond rsemu's two for refilling the pipeline: the refill takes one to three (ARM
/// DDI 0439D §3.3.1).
const LONGEST_REFILL: u64 = 1;
/// A literal's load may have to wait a cycle for the fetch unit (DDI 0439D §3.3.2).
const FETCH_CONTENTION: u64 = 1;
/// Where in flash the vectors are: 16 of the core and 82 of the chip (RM0090 Rev 21 Table 61).
const VECTORS: std::ops::Range<u32> = 0..4 * (16 + 82);

/// How long memories and buses keep the core waiting.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Bound {
    /// Not at all.
    #[default]
    Best,
    /// As long as the manuals allow.
    Worst,
}

impl Bound {
    /// Both, the best first.
    pub const ALL: [Self; 2] = [Self::Best, Self::Worst];
}

impl fmt::Display for Bound {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Best => "best",
            Self::Worst => "worst",
        })
    }
}

impl FromStr for Bound {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let bound = Self::ALL.into_iter().find(|bound| bound.to_string() == text);
        bound.ok_or_else(|| "give best or worst".to_owned())
    }
}

/// Cycles that one step of the core waited, by cause.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Waits {
    /// For instructions and vectors from flash.
    pub fetch: u64,
    /// For data from flash, mostly literals.
    pub data: u64,
    /// For peripherals, and for writes to them still under way.
    pub bus: u64,
    /// For the pipeline after a branch.
    pub refill: u64,
}

impl Waits {
    /// All of them.
    pub fn total(&self) -> u64 {
        self.fetch + self.data + self.bus + self.refill
    }
}

/// A write that the core has finished but the peripheral has not seen yet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Posted {
    /// When it reaches the peripheral.
    pub at: u64,
    /// The register.
    pub address: u32,
    /// Bytes: 1, 2 or 4.
    pub size: u8,
    /// What is written.
    pub value: u32,
}

/// The state of [`Bound::Worst`]: which cycle everything has reached. [`Self::begin`] and [`Self::end`] enclose a
/// step of the core; accesses in between are reported as they happen.
#[derive(Debug, Default)]
pub struct Delays {
    speeds: Speeds,
    flash: FlashReads,
    bus: SystemBus,
    posted: Option<Posted>,
    /// When the step began.
    from: u64,
    waits: Waits,
    /// The address after the last instruction; `None` where no fetch counts as a jump.
    next: Option<u32>,
    /// The last halfword fetched.
    halfword: u16,
}

impl Delays {
    /// The state after reset.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adopts the program's settings.
    pub fn set_speeds(&mut self, speeds: Speeds) {
        self.speeds = speeds;
    }

    /// A step of the core begins at cycle `now`.
    pub fn begin(&mut self, now: u64) {
        self.from = now;
        self.waits = Waits::default();
    }

    /// What the step waited for.
    pub fn end(&self) -> Waits {
        self.waits
    }

    fn now(&self) -> u64 {
        self.from + self.waits.total()
    }

    /// The core fetches half a word of instructions from flash, `offset` bytes from its start.
    pub fn fetch(&mut self, offset: u32, halfword: u16) {
        let jump = self.next.is_some_and(|next| next != offset);
        if jump {
            self.waits.refill += LONGEST_REFILL;
        }
        self.next = Some(offset.wrapping_add(2));
        self.waits.fetch += self.flash.fetch(offset, jump, self.now(), &self.speeds);
        // DSB and DMB wait until the write buffer is empty (DDI 0439D §3.5).
        if self.halfword == 0xF3BF && matches!(halfword & 0xFFF0, 0x8F40 | 0x8F50) {
            self.drain();
        }
        self.halfword = halfword;
    }

    /// The core reads data from flash.
    pub fn read_flash(&mut self, offset: u32) {
        if VECTORS.contains(&offset) {
            return self.fetch_vector();
        }
        self.waits.data += FETCH_CONTENTION;
        self.waits.data += self.flash.read(offset, self.now(), &self.speeds);
    }

    /// The core reads system memory, which is flash that no cache holds. Returns when the value is taken.
    pub fn read_system_memory(&mut self) -> u64 {
        self.waits.data += FETCH_CONTENTION + self.flash.read_uncached(self.now(), &self.speeds);
        self.now()
    }

    /// Exception entry is a memory barrier (DDI 0439D §3.5). Vector and handler are fetched while registers are stacked
    /// (§3.9.1), but it is not documented how far that hides the wait states: here, not at all.
    fn fetch_vector(&mut self) {
        self.drain();
        self.waits.fetch += self.flash.read_uncached(self.now(), &self.speeds);
        self.next = None;
    }

    /// The core reads from an address on the system bus. Returns when the value is taken.
    pub fn read_bus(&mut self, address: u32) -> u64 {
        let now = self.now();
        self.waits.bus += self.bus.read(address, now, &self.speeds) - now;
        self.now()
    }

    /// The core writes to memory on the system bus.
    pub fn write_memory(&mut self, address: u32) {
        let now = self.now();
        self.waits.bus += self.bus.write(address, now, &self.speeds).accepted - now;
    }

    /// The core writes to a peripheral. The write is kept until [`Self::take_posted`]; the previous one must have
    /// been taken.
    pub fn write_peripheral(&mut self, address: u32, size: u8, value: u32) {
        let now = self.now();
        let write = self.bus.write(address, now, &self.speeds);
        self.waits.bus += write.accepted - now;
        self.posted = Some(Posted { at: write.done, address, size, value });
    }

    /// When the write under way reaches its peripheral.
    pub fn posted_at(&self) -> Option<u64> {
        self.posted.map(|posted| posted.at)
    }

    /// The write under way, which the caller now makes.
    pub fn take_posted(&mut self) -> Option<Posted> {
        self.posted.take()
    }

    fn drain(&mut self) {
        self.waits.bus += self.bus.free_at().saturating_sub(self.now());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_have_names() {
        assert_eq!(Bound::ALL.map(|bound| bound.to_string().parse()), Bound::ALL.map(Ok));
        assert_eq!("fast".parse::<Bound>(), Err("give best or worst".to_owned()));
    }

    /// In the chip's reset state, with its bridges at the core's clock, nothing waits.
    #[test]
    fn code_without_wait_states_does_not_wait() {
        let mut delays = Delays::new();
        delays.begin(100);
        for offset in (0x200..0x240).step_by(2) {
            delays.fetch(offset, 0xBF00);
        }
        assert_eq!(delays.end(), Waits::default());
    }
}
