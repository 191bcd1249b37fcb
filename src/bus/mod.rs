//! The side of the buses: from the controllers to the record queue, and from what a host asked for to the mailboxes.
//!
//! Everything here runs at priority 4 on the board, except the queue's far end and [`sof`]. None of it knows of USB, sessions or
//! commands: that is [`crate::port`].

pub mod capture;
pub mod checksum;
pub mod errors;
pub mod filters;
pub mod mailboxes;
pub mod periodic;
pub mod queue;
pub mod recorder;
pub mod sof;
pub mod time;
pub mod transmit;
