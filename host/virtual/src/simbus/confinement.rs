//! Fault confinement: a controller's error counters, and what follows from them (ISO 11898-1:2015, 12.1.4).

use cantap_wire::record::{BusErrorKind, ErrorState};

/// Error counters at which fault confinement changes.
const PASSIVE: u16 = 128;
const BUS_OFF: u16 = 256;
/// Bits that a controller waits in bus-off: 128 times 11 recessive ones.
const RECOVERY_BITS: u64 = 128 * 11;

/// The error counters of a controller that takes part in a bus.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ErrorCounters {
    transmit: u16,
    receive: u16,
    /// When waiting in bus-off ends, in nanoseconds of the bus's time, once it has begun.
    recovers_at_ns: Option<u64>,
}

impl ErrorCounters {
    /// Those of a controller that was just started.
    pub const NEW: Self = Self { transmit: 0, receive: 0, recovers_at_ns: None };

    /// The transmit and the receive error counter; in bus-off the first is 255.
    pub fn values(&self) -> (u8, u8) {
        let byte = |count: u16| u8::try_from(count).unwrap_or(u8::MAX);
        (byte(self.transmit), byte(self.receive))
    }

    /// The state that follows from them.
    pub fn state(&self) -> ErrorState {
        if self.transmit >= BUS_OFF {
            return ErrorState::BusOff;
        }
        let (transmit, receive) = self.values();
        ErrorState::of_counters(transmit, receive)
    }

    /// A frame of the controller's own was sent.
    pub const fn count_sent(&mut self) {
        self.transmit = self.transmit.saturating_sub(1);
    }

    /// A frame of others was received.
    pub const fn count_received(&mut self) {
        self.receive = if self.receive > PASSIVE - 1 { PASSIVE - 9 } else { self.receive.saturating_sub(1) };
    }

    /// A frame was destroyed: one that the controller was sending, or one that it was receiving.
    pub fn count_error(&mut self, kind: BusErrorKind, own: bool) {
        match own {
            // A passive sender without an acknowledgement does not count any further (12.1.4.2).
            true if kind == BusErrorKind::Acknowledgment && self.transmit >= PASSIVE => {}
            true => self.transmit = (self.transmit + 8).min(BUS_OFF),
            false => self.receive = (self.receive + 1).min(PASSIVE),
        }
    }

    /// When bus-off ends that has begun at `now_ns` or before; none if the controller is not bus-off.
    pub fn recovers_at_ns(&mut self, now_ns: u64, bitrate_bps: u32) -> Option<u64> {
        if self.state() != ErrorState::BusOff {
            return None;
        }
        let wait_ns = RECOVERY_BITS * 1_000_000_000 / u64::from(bitrate_bps.max(1));
        Some(*self.recovers_at_ns.get_or_insert(now_ns + wait_ns))
    }

    /// Ends bus-off if its time has come; returns whether it has.
    pub fn recover(&mut self, now_ns: u64, bitrate_bps: u32) -> bool {
        let is_over = self.recovers_at_ns(now_ns, bitrate_bps).is_some_and(|at_ns| now_ns >= at_ns);
        if is_over {
            *self = Self::default();
        }
        is_over
    }

    /// The wait that ends bus-off begins anew.
    pub const fn restart_recovery(&mut self) {
        self.recovers_at_ns = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_transmitter_goes_through_all_states_and_recovers_after_its_bits() {
        let mut counters = ErrorCounters::default();
        let mut states = Vec::new();
        for errors in 1..=32 {
            counters.count_error(BusErrorKind::BitDominant, true);
            if states.last().is_none_or(|(_, state)| *state != counters.state()) {
                states.push((errors, counters.state()));
            }
        }
        assert_eq!(
            states,
            [
                (1, ErrorState::Active),
                (12, ErrorState::Warning),
                (16, ErrorState::Passive),
                (32, ErrorState::BusOff)
            ]
        );
        assert_eq!(counters.values(), (255, 0));
        assert!(!counters.recover(1000, 500_000));
        assert_eq!(counters.recovers_at_ns(2000, 500_000), Some(1000 + 1408 * 2000));
        assert!(!counters.recover(1000 + 1408 * 2000 - 1, 500_000));
        assert!(counters.recover(1000 + 1408 * 2000, 500_000));
        assert_eq!(counters, ErrorCounters::default());
    }

    #[test]
    fn a_receiver_is_never_bus_off_and_a_sender_without_acknowledgement_stays_passive() {
        let mut counters = ErrorCounters::default();
        for _ in 0..1000 {
            counters.count_error(BusErrorKind::Stuff, false);
            counters.count_error(BusErrorKind::Acknowledgment, true);
        }
        assert_eq!((counters.state(), counters.values()), (ErrorState::Passive, (128, 128)));
        counters.count_received();
        assert_eq!(counters.values(), (128, 119));
        counters.count_sent();
        assert_eq!((counters.state(), counters.values()), (ErrorState::Warning, (127, 119)));
    }
}
