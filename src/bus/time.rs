//! Extends the 32-bit stamp timer to 64 bits without a race.

/// A due time that never comes.
pub const NEVER: u64 = u64::MAX;

/// The device's time. It must see a stamp at least once in half the timer's range (179 s at 12 MHz);
/// the millisecond tick takes care of that.
#[derive(Debug, Default)]
pub struct Timebase {
    latest: u64,
}

impl Timebase {
    /// Time zero.
    pub const fn new() -> Self {
        Self { latest: 0 }
    }

    /// The 64-bit time of a stamp. A stamp slightly older than the latest one is fine: another interrupt
    /// may have read a newer one before this one was handled.
    pub fn extend(&mut self, stamp: u32) -> u64 {
        let ahead = stamp.wrapping_sub(self.latest as u32) as i32;
        let time = self.latest.wrapping_add_signed(i64::from(ahead));
        if ahead > 0 {
            self.latest = time;
        }
        time
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_goes_on_over_a_wrap_and_old_stamps_stay_old() {
        let mut time = Timebase::new();
        assert_eq!(time.extend(0x7000_0000), 0x7000_0000);
        assert_eq!(time.extend(0xE000_0000), 0xE000_0000);
        assert_eq!(time.extend(5), 0x1_0000_0005);
        assert_eq!(time.extend(0xFFFF_FFFF), 0xFFFF_FFFF);
        assert_eq!(time.extend(6), 0x1_0000_0006);
    }
}
