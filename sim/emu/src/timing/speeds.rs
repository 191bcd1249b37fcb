//! The settings that waiting times depend on.

/// The settings made by the program that affect timing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Speeds {
    /// Wait states of flash (FLASH_ACR.LATENCY).
    pub wait_states: u64,
    /// Whether the next line of instructions is read ahead (PRFTEN).
    pub prefetch: bool,
    /// Whether the instruction cache is on (ICEN).
    pub instruction_cache: bool,
    /// Whether the data cache is on (DCEN).
    pub data_cache: bool,
    /// Core cycles of a clock of APB1.
    pub apb1: u64,
    /// Core cycles of a clock of APB2.
    pub apb2: u64,
}

impl Default for Speeds {
    /// As after reset (RM0090 Rev 21 §3.9.1, §7.3.3).
    fn default() -> Self {
        Self {
            wait_states: 0,
            prefetch: false,
            instruction_cache: false,
            data_cache: false,
            apb1: 1,
            apb2: 1,
        }
    }
}
