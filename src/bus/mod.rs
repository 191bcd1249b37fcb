//! The bus side: from the controllers to the record queue, and from what a host requested to the mailboxes.
//!
//! Everything here runs at priority 4 on the board, except the queue's far end and [`sof`]. None of it knows about USB, sessions
//! or commands: those are in [`crate::port`].

pub mod capture;
pub mod checksum;
#[cfg(any(feature = "disturb", not(target_os = "none")))]
pub mod disturb;
pub mod errors;
pub mod filters;
pub mod gateway;
pub mod mailboxes;
mod outgoing;
pub mod periodic;
pub mod queue;
pub mod recorder;
pub mod sof;
pub mod time;
pub mod transmit;
