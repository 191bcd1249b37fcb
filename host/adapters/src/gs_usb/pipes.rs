//! What the driver needs of USB.

use std::time::Duration;

use crate::source::Piece;

/// Two pipes and vendor requests: another one in tests.
pub(super) trait Usb: Send {
    /// Whether its firmware is known to return a frame only once it was on the bus.
    fn confirms(&self) -> bool {
        false
    }
    /// A request with data for the adapter.
    fn control_out(&mut self, request: u8, value: u16, data: &[u8]) -> Result<(), String>;
    /// A request that it answers in time.
    fn control_in(&mut self, request: u8, value: u16, len: u16, within: Duration) -> Result<Vec<u8>, String>;
    /// The next transfer from it, if one comes in time. An error is its end.
    fn next(&mut self, wait: Duration) -> Result<Option<Piece<Vec<u8>>>, String>;
    /// Begins a transfer to it. Returns false if too many are waiting.
    fn write(&mut self, bytes: Vec<u8>) -> Result<bool, String>;
}
