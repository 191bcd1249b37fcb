//! Fault confinement: the error counters and what follows from them (ISO 11898-1, "fault
//! confinement"; RM0090 Rev 21 §32.7.6 for what bxCAN shows of it).

use cantap_can::BusErrorKind;

/// Counter value from which the warning flag is set.
const WARNING: u16 = 96;
/// Counter value above which a node is error-passive.
const PASSIVE: u16 = 127;
/// Transmit counter value above which a node is bus-off.
const BUS_OFF: u16 = 255;
/// What a receive counter above [`PASSIVE`] becomes after a good frame.
const AFTER_GOOD_FRAME: u16 = 120;

/// A node's two error counters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ErrorCounters {
    transmit: u16,
    receive: u16,
}

impl ErrorCounters {
    /// The transmit error counter, as its 8-bit register shows it.
    pub fn transmit(&self) -> u8 {
        self.transmit.min(255) as u8
    }

    /// The receive error counter, as its 8-bit register shows it.
    pub fn receive(&self) -> u8 {
        self.receive.min(255) as u8
    }

    /// Whether a counter reached 96.
    pub fn warning(&self) -> bool {
        self.transmit >= WARNING || self.receive >= WARNING
    }

    /// Whether a counter passed 127: error flags are then recessive.
    pub fn passive(&self) -> bool {
        self.transmit > PASSIVE || self.receive > PASSIVE
    }

    /// Whether the transmit counter passed 255.
    pub fn bus_off(&self) -> bool {
        self.transmit > BUS_OFF
    }

    /// A transmission failed. `flag_seen`: another node's dominant bits were seen during the error flag.
    /// An error-passive sender that only misses an acknowledgement does not count further, so a lone
    /// node never goes bus-off.
    pub fn transmit_error(&mut self, kind: BusErrorKind, flag_seen: bool) {
        if kind == BusErrorKind::Acknowledgment && self.passive() && !flag_seen {
            return;
        }
        self.transmit = (self.transmit + 8).min(BUS_OFF + 1);
    }

    /// A receiver saw an error. `first`: it saw it before others, so that the first bit after its error
    /// flag was dominant, which adds eight. An error-passive receiver stops counting.
    pub fn receive_error(&mut self, first: bool) {
        for step in [1, if first { 8 } else { 0 }] {
            if self.receive <= PASSIVE {
                self.receive += step;
            }
        }
    }

    /// A frame was sent.
    pub fn sent(&mut self) {
        self.transmit = self.transmit.saturating_sub(1);
    }

    /// A frame was received.
    pub fn received(&mut self) {
        self.receive = if self.receive > PASSIVE { AFTER_GOOD_FRAME } else { self.receive.saturating_sub(1) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sender_is_warned_at_96_passive_at_128_and_off_at_256() {
        let mut counters = ErrorCounters::default();
        let mut seen = Vec::new();
        for _ in 0..32 {
            counters.transmit_error(BusErrorKind::BitDominant, true);
            seen.push((counters.warning(), counters.passive(), counters.bus_off()));
        }
        assert_eq!(seen.iter().position(|s| s.0), Some(11));
        assert_eq!(seen.iter().position(|s| s.1), Some(15));
        assert_eq!(seen.iter().position(|s| s.2), Some(31));
    }

    #[test]
    fn a_lone_sender_stays_error_passive() {
        let mut counters = ErrorCounters::default();
        for _ in 0..1000 {
            counters.transmit_error(BusErrorKind::Acknowledgment, false);
        }
        assert_eq!((counters.transmit(), counters.passive(), counters.bus_off()), (128, true, false));
    }

    #[test]
    fn a_passive_receiver_returns_to_120_with_one_good_frame() {
        let mut counters = ErrorCounters::default();
        for _ in 0..40 {
            counters.receive_error(true);
        }
        assert!(counters.passive());
        counters.received();
        assert_eq!(counters.receive(), 120);
        counters.received();
        assert_eq!(counters.receive(), 119);
    }
}
