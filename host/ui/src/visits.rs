//! Who comes to the server, and what they do there, for whoever runs it.

use std::sync::Arc;

use cantap::wire::message::Role;

/// Something that a visitor did.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Visit {
    /// A page is open.
    Came(Role),
    /// It has gone.
    Left,
    /// A request was not answered, with the reason.
    Refused(String),
    /// What a page asked for was done.
    Asked(String),
    /// What a page asked for was not done, with the reason.
    NotDone(String),
    /// A page was too slow for so many records, which are a loss in its trace.
    Missed(u64),
}

/// Gets the visitor's name, which ends in its address. It is called from the threads that serve, and must not wait.
pub type Visits = Arc<dyn Fn(&str, Visit) + Send + Sync>;

/// A page that is let in.
#[derive(Clone, Debug)]
pub struct Visitor {
    /// Its name in messages.
    pub name: String,
    /// The most that it may do.
    pub role: Role,
}
