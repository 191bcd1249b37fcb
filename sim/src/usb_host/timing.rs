//! How patient a host is, and how much it takes at a time.

use super::FRAME;
use crate::CYCLES_PER_US;

/// How a host keeps time.
#[derive(Clone, Copy, Debug)]
pub struct Timing {
    /// From pull-up to reset, in cycles (USB 2.0, TATTDB: at least 100 ms).
    pub debounce: u64,
    /// How long a reset is driven (TDRSTR: at least 10 ms; root ports 50 ms).
    pub reset: u64,
    /// From the end of the reset to the first request (TRSTRCY: 10 ms).
    pub recovery: u64,
    /// How long resume is signalled (TDRSMDN: at least 20 ms).
    pub resume: u64,
    /// After a NAK, until the pipe is tried again.
    pub retry: u64,
    /// How long a control transfer may be answered with NAK (USB 2.0, 9.2.6.1 allows 5 s).
    pub control_timeout: u64,
    /// Reset a second time after the first look at the device, as Linux does. Hosts that do not leave a device with
    /// one chance to get its endpoints right.
    pub second_reset: bool,
    /// Data packets in one frame at most, over all pipes: up to 19 of 64 bytes.
    pub packets_per_frame: u32,
    /// Bytes that a read of the bulk IN pipe asks for: it completes when they are there or with a
    /// packet that is not full. Linux asks for 128 (cdc-acm: two packets), Windows for up to 4096.
    pub read_bytes: usize,
}

impl Default for Timing {
    fn default() -> Self {
        Self {
            debounce: 100 * FRAME,
            reset: 50 * FRAME,
            recovery: 10 * FRAME,
            resume: 20 * FRAME,
            retry: 10 * CYCLES_PER_US,
            control_timeout: 1000 * FRAME,
            second_reset: true,
            packets_per_frame: 19,
            read_bytes: 128,
        }
    }
}

impl Timing {
    /// The shortest times that the standard allows, and debouncing cut short: for tests that plug a
    /// device in hundreds of times.
    pub fn hasty() -> Self {
        Self { debounce: 5 * FRAME, reset: 10 * FRAME, recovery: FRAME, ..Self::default() }
    }
}
