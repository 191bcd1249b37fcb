//! Why the firmware failed, in memory that a reset does not change.
//!
//! A panic, a fault or the next start writes the log; it can be read until the chip loses power. After that the memory
//! may hold anything, which the checksum reveals.

use core::fmt::{self, Write};

use cantap_wire::framing::checksum;
use cantap_wire::message::{Failures, MAX_FAILURE_TEXT};

/// The log as it is in memory. Any contents are valid values, but not all are a log.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct FailureLog {
    count: u32,
    len: u32,
    text: [u8; MAX_FAILURE_TEXT],
    checksum: u32,
}

impl FailureLog {
    /// The log's contents; empty if the memory was lost.
    pub fn failures(&self) -> Failures {
        let len = (self.len as usize).min(MAX_FAILURE_TEXT);
        match core::str::from_utf8(&self.text[..len]) {
            // Cannot be too long: it has just been cut.
            Ok(text) if self.checksum == self.sum() => {
                Failures { count: self.count, last: text.try_into().unwrap_or_default() }
            }
            _ => Failures::default(),
        }
    }

    /// Adds a failure, replacing the previous one. Text that does not fit is cut; line ends become spaces.
    pub fn add(&mut self, what: fmt::Arguments) {
        self.count = self.failures().count.wrapping_add(1);
        self.len = 0;
        self.text = [0; MAX_FAILURE_TEXT];
        // Cannot fail: what does not fit is left out.
        let _ = self.write_fmt(what);
        self.checksum = self.sum();
    }

    fn sum(&self) -> u32 {
        let head = self.count.to_le_bytes().into_iter().chain(self.len.to_le_bytes());
        checksum(head.chain(self.text))
    }
}

impl Write for FailureLog {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for letter in text.chars() {
            let letter = if letter == '\n' { ' ' } else { letter };
            let mut bytes = [0; 4];
            let bytes = letter.encode_utf8(&mut bytes).as_bytes();
            let from = self.len as usize;
            let Some(room) = self.text.get_mut(from..from + bytes.len()) else {
                // Nothing may follow the cut.
                return Err(fmt::Error);
            };
            room.copy_from_slice(bytes);
            self.len += bytes.len() as u32;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn memory_of(byte: u8) -> FailureLog {
        let word = u32::from_le_bytes([byte; 4]);
        FailureLog { count: word, len: word, text: [byte; MAX_FAILURE_TEXT], checksum: word }
    }

    #[test]
    fn memory_that_was_lost_holds_no_failure() {
        for byte in 0..=u8::MAX {
            assert_eq!(memory_of(byte).failures(), Failures::default(), "{byte:#04x}");
        }
    }

    #[test]
    fn the_last_failure_is_kept_and_all_are_counted() {
        let mut log = memory_of(0xA5);
        log.add(format_args!("panicked at {}:{}:\n{}", "src/a.rs", 7, "no"));
        assert_eq!(
            log.failures(),
            Failures { count: 1, last: "panicked at src/a.rs:7: no".try_into().unwrap() }
        );
        log.add(format_args!("watchdog"));
        assert_eq!(log.failures(), Failures { count: 2, last: "watchdog".try_into().unwrap() });
    }

    #[test]
    fn a_bit_that_fell_in_a_brown_out_makes_it_no_log() {
        for bit in 0..8 * (8 + 8 + 4) {
            let mut log = memory_of(0);
            log.add(format_args!("watchdog"));
            let (word, mask) = (bit / 32, 1u32 << (bit % 32));
            match word {
                0 => log.count ^= mask,
                1 => log.len ^= mask,
                4 => log.checksum ^= mask,
                at => log.text[(at - 2) * 4 + bit % 32 / 8] ^= 1 << (bit % 8),
            }
            assert_eq!(log.failures(), Failures::default(), "bit {bit}");
        }
    }

    #[test]
    fn a_long_text_is_cut_between_two_letters() {
        let mut log = memory_of(0);
        log.add(format_args!("{}{}", "x".repeat(MAX_FAILURE_TEXT - 1), "ä and more"));
        assert_eq!(log.failures().last.as_str(), "x".repeat(MAX_FAILURE_TEXT - 1));
    }
}
