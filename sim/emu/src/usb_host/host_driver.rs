//! What the bus needs from the device's driver: the emulator's own operating system ([`super::CdcDriver`]), or
//! another, such as a real kernel's behind a socket.

use super::counters::Counters;
use crate::otg::{InReply, OutReply};

/// A transaction that a driver wants on the bus.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Token {
    /// A SETUP packet, to endpoint 0.
    Setup([u8; 8]),
    /// An IN token.
    In {
        /// The endpoint it addresses.
        endpoint: u8,
        /// On a bulk pipe.
        bulk: bool,
    },
    /// An OUT packet.
    Out {
        /// The endpoint it is for.
        endpoint: u8,
        /// DATA1 rather than DATA0.
        data1: bool,
        /// Its bytes.
        bytes: Vec<u8>,
    },
}

/// Chooses transactions and judges answers. The bus decides when they take place and whether they fit.
pub trait HostDriver {
    /// The device is gone: everything under way ends. What was delivered stays readable.
    fn detach(&mut self);
    /// The device address that transactions go to.
    fn address(&self) -> u8;
    /// The port's reset is over. `second_wanted` is [`super::Timing::second_reset`].
    fn after_reset(&mut self, second_wanted: bool);
    /// Frames begin again after a silence, which must not count as a delay.
    fn restart_clock(&mut self) {}
    /// A frame begins.
    fn start_frame(&mut self);
    /// The next transaction. `room` says whether the frame may carry another data packet on the bulk pipes.
    fn choose(&mut self, room: bool) -> Option<Token>;
    /// A pipe answered NAK: the others go first.
    fn defer(&mut self, endpoint: u8, input: bool);
    /// Whether there is anything to try again.
    fn any_deferred(&self) -> bool;
    /// All pipes get their turn again.
    fn clear_deferred(&mut self);
    /// The answer to the SETUP or OUT packet that [`Self::choose`] last returned; `pipe` is the length of a bulk
    /// packet.
    fn answered_out(&mut self, pipe: Option<usize>, reply: OutReply, counters: &mut Counters);
    /// The answer to the IN token that [`Self::choose`] last returned. `read_bytes` is [`super::Timing::read_bytes`].
    fn answered_in(
        &mut self,
        endpoint: u8,
        bulk: bool,
        reply: InReply,
        read_bytes: usize,
        counters: &mut Counters,
    );
    /// Whether the device is to be reset. Cleared by the call.
    fn take_reset_request(&mut self) -> bool;
    /// The milliseconds of silence requested. Cleared by the call.
    fn take_pause(&mut self) -> Option<u64>;
    /// Ends a transfer that takes longer than `limit` cycles.
    fn check_time(&mut self, _now: u64, _limit: u64) {}
}
