//! The chip's memories.

use std::sync::Arc;

use rsemu::core::space::RamStore;

use crate::memory_map as map;
use crate::rom;

/// A memory of the chip, shared with code that must change it behind the core's back.
#[derive(Clone, Debug)]
pub struct Memory {
    pub(super) base: u32,
    pub(super) store: Arc<RamStore>,
}

impl Memory {
    fn new(base: u32, len: u32) -> Self {
        Self { base, store: Arc::new(RamStore::new(len.into())) }
    }

    /// Copies bytes out; false if the range is not within the memory.
    pub fn read(&self, address: u32, into: &mut [u8]) -> bool {
        self.offset(address).is_some_and(|offset| self.store.read_at(offset, into).is_ok())
    }

    /// Copies bytes in; false if the range is not within the memory.
    pub fn write(&self, address: u32, bytes: &[u8]) -> bool {
        self.offset(address).is_some_and(|offset| self.store.write_at(offset, bytes).is_ok())
    }

    /// The little-endian word at `address`, if that is within the memory.
    pub fn word(&self, address: u32) -> Option<u32> {
        let mut bytes = [0; 4];
        self.read(address, &mut bytes).then(|| u32::from_le_bytes(bytes))
    }

    fn offset(&self, address: u32) -> Option<u64> {
        Some(address.checked_sub(self.base)?.into())
    }
}

/// The chip's memories, empty: flash reads as erased.
#[derive(Clone, Debug)]
pub struct Memories {
    /// Flash at 0x0800_0000.
    pub flash: Memory,
    /// SRAM at 0x2000_0000.
    pub sram: Memory,
    /// Core-coupled memory at 0x1000_0000.
    pub ccm: Memory,
    /// The ROM bootloader at 0x1FFF_0000.
    pub bootloader: Memory,
}

impl Memories {
    /// All of an STM32F405's memory.
    pub fn new() -> Self {
        let flash = Memory::new(map::FLASH.start, map::FLASH.len() as u32);
        flash.write(map::FLASH.start, &vec![0xFF; map::FLASH.len()]);
        let bootloader = Memory::new(map::BOOTLOADER.start, map::BOOTLOADER.len() as u32);
        bootloader.write(map::BOOTLOADER.start, &rom::contents());
        Self {
            flash,
            sram: Memory::new(map::SRAM.start, map::SRAM.len() as u32),
            ccm: Memory::new(map::CCM.start, map::CCM.len() as u32),
            bootloader,
        }
    }
}

impl Default for Memories {
    fn default() -> Self {
        Self::new()
    }
}
