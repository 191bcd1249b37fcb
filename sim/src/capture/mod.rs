//! The emulator's own host: it speaks the wire protocol ([`session`]) and compares what the device
//! delivers with what really crossed the buses ([`ledger`]). It shares the wire types with the
//! product's host library and nothing else, so that a fault in that library cannot hide here.

pub mod ledger;
pub mod session;

pub use ledger::{Ledger, Losses, Stamps};
pub use session::{Session, SessionEvent};
