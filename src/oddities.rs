//! Hardware that did not do as its manual says: counted where it happens, recorded among the failures.
//!
//! None of this is expected of a sound chip. Where it happens nevertheless, the firmware goes on, and a user who asks the device for its
//! failures learns of it.

use core::fmt::{self, Display, Formatter};

use cantap_wire::CHANNELS;

use crate::TICK_HZ;

/// What is new is recorded no more often than this: chips that go wrong do so again and again.
const RECORD_EVERY_TICKS: u32 = TICK_HZ;

/// What one channel's controller did. Counters run from the start and wrap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ChannelOddities {
    /// Times that its receive FIFO did not release its frames, or repeated them.
    pub drains_given_up: u32,
    /// Times that its error interrupt came more often than a bus can have errors.
    pub error_storms: u32,
    /// Times that a mailbox went on saying that it had finished.
    pub mailboxes_stuck: u32,
}

/// What the USB controller did. Counters run from the start and wrap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct UsbOddities {
    /// Words in the receive FIFO that say what cannot be.
    pub words_dropped: u32,
    /// Flags that were waited for and did not come in time.
    pub waits_given_up: u32,
}

/// All of it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Oddities {
    /// The CAN controllers.
    pub channels: [ChannelOddities; CHANNELS],
    /// The USB controller.
    pub usb: UsbOddities,
}

impl Display for Oddities {
    /// Says what happened, for a developer.
    fn fmt(&self, out: &mut Formatter) -> fmt::Result {
        write!(out, "hardware:")?;
        let mut separator = " ";
        let mut say = |count: u32, what: fmt::Arguments| {
            if count == 0 {
                return Ok(());
            }
            write!(out, "{separator}{what} ({count})")?;
            separator = ", ";
            Ok(())
        };
        for (number, channel) in (1..).zip(&self.channels) {
            say(channel.drains_given_up, format_args!("CAN{number}'s FIFO releases no frame"))?;
            say(channel.error_storms, format_args!("CAN{number}'s error interrupt does not end"))?;
            say(channel.mailboxes_stuck, format_args!("CAN{number}'s mailbox stays finished"))?;
        }
        say(self.usb.words_dropped, format_args!("USB words not believed"))?;
        say(self.usb.waits_given_up, format_args!("USB flags too late"))
    }
}

/// Decides when to record what happened.
pub struct Watch {
    recorded: Oddities,
    /// The stamp timer when something was last recorded.
    at: Option<u32>,
}

impl Watch {
    /// Nothing has been recorded.
    pub const fn new() -> Self {
        const NONE: ChannelOddities =
            ChannelOddities { drains_given_up: 0, error_storms: 0, mailboxes_stuck: 0 };
        let usb = UsbOddities { words_dropped: 0, waits_given_up: 0 };
        Self { recorded: Oddities { channels: [NONE; CHANNELS], usb }, at: None }
    }

    /// Whether what has happened so far is to be recorded now. Call it every millisecond.
    pub fn is_due(&mut self, oddities: Oddities, now: u32) -> bool {
        let rests = self.at.is_some_and(|at| now.wrapping_sub(at) < RECORD_EVERY_TICKS);
        if rests {
            return false;
        }
        self.at = None;
        if oddities == self.recorded {
            return false;
        }
        self.recorded = oddities;
        self.at = Some(now);
        true
    }
}

impl Default for Watch {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(words_dropped: u32) -> Oddities {
        Oddities { usb: UsbOddities { words_dropped, ..UsbOddities::default() }, ..Oddities::default() }
    }

    #[test]
    fn what_is_new_is_recorded_at_once_but_only_once_a_second() {
        let mut watch = Watch::new();
        let mut recorded = Vec::new();
        for ms in 0..3000 {
            let happened = if ms < 10 { 0 } else { ms.min(1500) };
            if watch.is_due(words(happened), ms * (TICK_HZ / 1000)) {
                recorded.push((ms, happened));
            }
        }
        assert_eq!(recorded, [(10, 10), (1010, 1010), (2010, 1500)]);
    }

    #[test]
    fn the_text_says_what_happened_and_how_often() {
        let mut oddities = words(3);
        oddities.channels[1].drains_given_up = 7;
        assert_eq!(
            oddities.to_string(),
            "hardware: CAN2's FIFO releases no frame (7), USB words not believed (3)"
        );
    }
}
