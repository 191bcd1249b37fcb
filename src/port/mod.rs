//! The host side: from the record queue to USB, and from a host's requests to their execution.
//!
//! Everything here runs at priority 2 on the board. It reaches what belongs to the buses' tasks only through
//! [`board::Board::with_capture`], which on the board is RTIC's lock.

pub mod answers;
pub mod board;
pub mod command;
pub mod inbox;
pub mod outbox;
pub mod sender;
pub mod session;
pub mod slcan;
