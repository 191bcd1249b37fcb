//! Accesses that no good program makes.

use std::fmt;

/// What is odd about an access.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Oddity {
    /// No model knows the register.
    Unknown,
    /// The peripheral's clock is off: reads are 0, writes are lost.
    Unclocked,
    /// The hardware would not accept the write in its present state.
    Refused,
    /// It leaves flash with fewer wait states than the core's clock needs.
    TooFast,
}

/// An odd access, and how often it happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OddAccess {
    /// What is odd.
    pub oddity: Oddity,
    /// The register's address.
    pub address: u32,
    /// A write, rather than a read.
    pub write: bool,
    /// How often.
    pub count: u64,
}

impl fmt::Display for OddAccess {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kind = if self.write { "write" } else { "read" };
        let reason = match self.oddity {
            Oddity::Unknown => "no model knows it",
            Oddity::Unclocked => "its peripheral's clock is off",
            Oddity::Refused => "the hardware does not accept it now",
            Oddity::TooFast => "flash has too few wait states for the clock",
        };
        write!(f, "{kind} of {:#010x}, {} times: {reason}", self.address, self.count)
    }
}
