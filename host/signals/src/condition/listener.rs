//! Names whose values come from several frames together, such as `uds.sid` for a request and its response.
//!
//! Code that puts frames together provides a [`Listener`]. The condition is then also evaluated for each of its events.

use std::fmt;

use cantap_trace::TraceRecord;

/// One event, as a condition queries it. `None` if it has no such name.
pub trait ConditionEvent {
    /// The event's channel, from 1.
    fn channel(&self) -> u8;

    /// Whether this record's frame completed it.
    fn is_completed_by(&self, record: &TraceRecord) -> bool;

    /// Whether it has a value of this name, if the name is one that it could have.
    fn has(&self, name: &str) -> Option<bool>;

    /// Passes the numbers of this name: several if it occurs several times.
    fn numbers(&self, name: &str, out: &mut dyn FnMut(f64));

    /// Whether one of the values of this name is this text, or has it as a name, ignoring case.
    fn is_text(&self, name: &str, text: &str) -> Option<bool>;

    /// A description on one line, for people.
    fn describe(&self) -> String;
}

/// Puts frames together.
pub trait Listener: fmt::Debug + Send + Sync {
    /// Whether the name is one that its events may have. It is called for all names of the condition before any record is taken.
    fn knows(&mut self, name: &str) -> bool;

    /// Takes a record and passes on the events that end with it.
    fn take(&mut self, record: &TraceRecord, report: &mut dyn FnMut(&dyn ConditionEvent));

    /// A new listener for the same names that has taken nothing yet.
    fn fresh(&self) -> Box<dyn Listener>;
}

/// A listener and its results.
#[derive(Debug)]
pub(super) struct Listening {
    pub listener: Box<dyn Listener>,
    /// The condition's names that belong to it, and whether any event has had them.
    pub names: Vec<(String, bool)>,
    /// The events of the last record for which the condition held.
    pub matched: Vec<String>,
}

impl Clone for Listening {
    fn clone(&self) -> Self {
        Self { listener: self.listener.fresh(), names: self.names.clone(), matched: Vec::new() }
    }
}

/// A listener without any names: for conditions about frames and signals alone.
#[derive(Debug)]
pub(super) struct Deaf;

impl Listener for Deaf {
    fn knows(&mut self, _: &str) -> bool {
        false
    }

    fn take(&mut self, _: &TraceRecord, _: &mut dyn FnMut(&dyn ConditionEvent)) {}

    fn fresh(&self) -> Box<dyn Listener> {
        Box::new(Self)
    }
}
