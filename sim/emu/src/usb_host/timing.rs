//! How patient a host is, and how much it takes at a time.

use crate::Clock;

/// How a host keeps time.
#[derive(Clone, Copy, Debug)]
pub struct Timing {
    /// How long a cycle is.
    pub clock: Clock,
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
    /// Reset a second time after the first look at the device, as Linux does. Hosts that do not give a device only
    /// one chance to get its endpoints right.
    pub second_reset: bool,
    /// Most data packets in one frame, over all pipes: up to 19 of 64 bytes.
    pub packets_per_frame: u32,
    /// Bytes that a read of the bulk IN pipe asks for: it completes when they have arrived, or with
    /// a packet that is not full. Linux asks for 128 (cdc-acm: two packets), Windows for up to
    /// 4096.
    pub read_bytes: usize,
    /// How much faster the board's crystal runs than this host's, in parts per million: its frames are then longer by that much
    /// in board cycles.
    pub board_ppm: f64,
    /// How far a start of frame may be from its ideal time, in board cycles; the same for the same frame on every board. USB 2.0
    /// (7.1.12) allows a full-speed host ±500 ns from one to the next.
    pub sof_jitter: u64,
    /// Behind a high-speed hub: the least time from one control or bulk transaction to the next. There a transaction is split into
    /// one part that starts it and one that fetches its result, in different microframes. 0 on a root port.
    pub split: u64,
}

impl Timing {
    /// As patient as Linux.
    pub fn new(clock: Clock) -> Self {
        Self {
            clock,
            debounce: clock.ms(100),
            reset: clock.ms(50),
            recovery: clock.ms(10),
            resume: clock.ms(20),
            retry: clock.us(10),
            control_timeout: clock.ms(1000),
            second_reset: true,
            packets_per_frame: 19,
            read_bytes: 128,
            board_ppm: 0.0,
            sof_jitter: 0,
            split: 0,
        }
    }

    /// The board cycle at which frame `number` starts. Frame 0 starts with the board's power-on, on every board, so
    /// boards that are switched on together are on one controller.
    pub fn frame_start(&self, number: u64) -> u64 {
        let place = number as f64 * self.frame_cycles();
        let jitter = self.sof_jitter as f64 * (2.0 * even(number) - 1.0);
        (place + jitter).max(0.0) as u64
    }

    /// The first frame whose ideal start is at or after a board cycle.
    pub fn frame_after(&self, cycle: u64) -> u64 {
        (cycle as f64 / self.frame_cycles()).ceil() as u64
    }

    /// Board cycles of a frame.
    fn frame_cycles(&self) -> f64 {
        self.clock.usb_frame() as f64 * self.board_rate()
    }

    /// Board cycles during one cycle of a board with an exact crystal.
    pub fn board_rate(&self) -> f64 {
        1.0 + self.board_ppm * 1e-6
    }

    /// The shortest times that the standard allows, with debouncing cut short: for tests that plug
    /// in a device hundreds of times.
    pub fn hasty(clock: Clock) -> Self {
        Self { debounce: clock.ms(5), reset: clock.ms(10), recovery: clock.ms(1), ..Self::new(clock) }
    }

    /// Behind a high-speed hub, with a host that begins a transaction only once it has fetched the previous one, so
    /// that each takes this many microframes. Hubs have room for more than one; a host that uses it is faster.
    #[must_use]
    pub fn behind_hub(self, microframes: u32) -> Self {
        Self { split: u64::from(microframes) * (self.clock.usb_frame() / 8), ..self }
    }
}

/// A number from 0 to 1 that looks random and is always the same for the same `number` (SplitMix64's mixing function).
fn even(number: u64) -> f64 {
    let mut bits = number.wrapping_add(0x9E37_79B9_7F4A_7C15);
    bits = (bits ^ bits >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    bits = (bits ^ bits >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
    (bits ^ bits >> 31) as f64 / u64::MAX as f64
}
