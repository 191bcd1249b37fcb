//! What stands in for ST's bootloader in ROM, and how the chip was started. For what the bootloader leaves behind
//! see [`crate::soc::bootloader`].

use crate::memory_map as map;

/// SYSCFG_MEMRMP: flash, or system memory, at address 0.
pub const FLASH: u32 = 0;
/// As [`FLASH`].
pub const SYSTEM_MEMORY: u32 = 1;

/// How the chip was started.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Start {
    /// Power came on, and the boot pins chose flash.
    #[default]
    PowerOn,
    /// The ROM bootloader has written the program and started it; the jumper that selects the bootloader is still in.
    Bootloader,
}

/// Entry of the bootloader, as in its vector table: an odd address.
pub const ENTRY: u32 = map::BOOTLOADER.start + 0x3DA5;
const STACK: u32 = 0x2000_2D40;
const ENDLESS: u32 = map::BOOTLOADER.start + 0x401;
const RETURN: u32 = map::BOOTLOADER.start + 0x405;
/// Exceptions of the core and of the chip.
const VECTORS: usize = 16 + 82;
const SYSTICK: usize = 15;

/// What stands in for ST's code: its vectors, handlers that simply return for the exceptions it uses, an endless loop for
/// the rest, and an undefined instruction at its entry, which ends a run.
pub fn contents() -> Vec<u8> {
    let mut vectors = [ENDLESS; VECTORS];
    vectors[0] = STACK;
    vectors[1] = ENTRY;
    vectors[SYSTICK] = RETURN;
    vectors[usize::from(map::OTG_FS_IRQ) + 16] = RETURN;
    let mut contents = vec![0xFF; map::BOOTLOADER.len()];
    let mut put = |address: u32, bytes: &[u8]| {
        let at = ((address & !1) - map::BOOTLOADER.start) as usize;
        contents[at..at + bytes.len()].copy_from_slice(bytes);
    };
    put(map::BOOTLOADER.start, &vectors.map(u32::to_le_bytes).concat());
    // B to itself, BX LR, UDF.
    put(ENDLESS, &0xE7FE_u16.to_le_bytes());
    put(RETURN, &0x4770_u16.to_le_bytes());
    put(ENTRY, &0xDE00_u16.to_le_bytes());
    contents
}
