//! What the core reaches over its buses.

use crate::timing::Speeds;

/// Everything the core can reach that is not memory. The addresses are absolute.
pub trait Bus: Send + Sync {
    /// Reads 1, 2 or 4 bytes; `None` is a bus fault.
    fn read(&self, address: u32, size: u8, now: u64) -> Option<u32>;
    /// Writes 1, 2 or 4 bytes; `None` is a bus fault.
    fn write(&self, address: u32, size: u8, value: u32, now: u64) -> Option<()>;
    /// The settings made by the program that affect timing.
    fn speeds(&self) -> Speeds;
}
