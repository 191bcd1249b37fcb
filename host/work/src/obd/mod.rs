//! Asking a vehicle by OBD-II: which ECUs answer, by which services, and what their parameters are.
//!
//! A [`Vehicle`] knows what to ask next and what the answers mean. A command asks by a client ([`crate::uds::Client`]), one request after the other; whoever
//! has something else to do meanwhile, such as a live view, by [`Asking`].

mod asking;
mod services;
mod table;
mod vehicle;

use cantap_protocols::{Event, EventKind};

pub use asking::{Asked, Asking, AskingState};
pub use services::Services;
pub use table::{Table, TableRow};
pub use vehicle::Vehicle;

/// Whether an event is an answer, or a broken one.
pub fn is_answer(event: &Event) -> bool {
    matches!(event.kind, EventKind::Exchange | EventKind::Refusal | EventKind::Broken)
}
