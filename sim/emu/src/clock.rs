//! The unit of a machine's time.

/// How many core cycles a second has, once the firmware has set up the chip's clocks. All times of a machine are in these cycles;
/// the few microseconds before that are counted in the same unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Clock {
    hz: u64,
}

impl Clock {
    /// A core clock in Hz: a multiple of 12 MHz, so that a bit of full-speed USB is a whole number of cycles.
    ///
    /// # Panics
    /// If it is not.
    pub const fn new(hz: u64) -> Self {
        Self::checked(hz).expect("a multiple of 12 MHz")
    }

    /// The same; `None` if it is none that this unit can be.
    pub const fn checked(hz: u64) -> Option<Self> {
        if hz > 0 && hz.is_multiple_of(12_000_000) { Some(Self { hz }) } else { None }
    }

    /// Cycles in a second.
    pub const fn hz(self) -> u64 {
        self.hz
    }

    /// Cycles in this many microseconds.
    pub const fn us(self, us: u64) -> u64 {
        us * (self.hz / 1_000_000)
    }

    /// Cycles in this many milliseconds.
    pub const fn ms(self, ms: u64) -> u64 {
        self.us(1000 * ms)
    }

    /// Cycles as microseconds.
    pub const fn to_us(self, cycles: u64) -> f64 {
        cycles as f64 / self.us(1) as f64
    }

    /// Cycles of a bit of full-speed USB.
    pub(crate) const fn usb_bit(self) -> u64 {
        self.hz / 12_000_000
    }

    /// Cycles of a frame of full-speed USB.
    pub(crate) const fn usb_frame(self) -> u64 {
        self.ms(1)
    }
}
