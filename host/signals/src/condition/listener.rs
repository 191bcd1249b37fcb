//! Names whose values no single frame has: what several frames say together, such as `uds.sid` of a request and its response.
//!
//! Whoever puts frames together hands in a [`Listener`]. The condition is then looked at for each of its events as well.

use std::fmt;

use cantap_trace::TraceRecord;

/// One event, as a condition asks about it. `None` where it has no such name.
pub trait Said {
    /// The channel that it was said on, from 1.
    fn channel(&self) -> u8;

    /// Whether the frame of this record is what completed it.
    fn is_completed_by(&self, record: &TraceRecord) -> bool;

    /// Whether it has a value of this name, if it is one of those that could have.
    fn has(&self, name: &str) -> Option<bool>;

    /// Hands out the numbers of this name: several if it was said several times.
    fn numbers(&self, name: &str, out: &mut dyn FnMut(f64));

    /// Whether one of the values of this name is this text, or stands for it; whatever the case of its letters.
    fn is_text(&self, name: &str, text: &str) -> Option<bool>;

    /// In a line, for people.
    fn describe(&self) -> String;
}

/// Puts frames together.
pub trait Listener: fmt::Debug + Send + Sync {
    /// Whether the name is one of those that its events may have. It will be asked for all that the condition has before it takes a
    /// record.
    fn knows(&mut self, name: &str) -> bool;

    /// Takes a record, and hands out the events that end with it.
    fn take(&mut self, record: &TraceRecord, said: &mut dyn FnMut(&dyn Said));

    /// One that knows the same names and has heard nothing.
    fn fresh(&self) -> Box<dyn Listener>;
}

/// A listener with what became of it.
#[derive(Debug)]
pub(super) struct Listening {
    pub listener: Box<dyn Listener>,
    /// The names that the condition has of it, and whether any event had them.
    pub names: Vec<(String, bool)>,
    /// The events of the last record for which the condition held.
    pub matched: Vec<String>,
}

impl Clone for Listening {
    fn clone(&self) -> Self {
        Self { listener: self.listener.fresh(), names: self.names.clone(), matched: Vec::new() }
    }
}

/// A listener that knows nothing: for conditions about frames and signals alone.
#[derive(Debug)]
pub(super) struct Deaf;

impl Listener for Deaf {
    fn knows(&mut self, _: &str) -> bool {
        false
    }

    fn take(&mut self, _: &TraceRecord, _: &mut dyn FnMut(&dyn Said)) {}

    fn fresh(&self) -> Box<dyn Listener> {
        Box::new(Self)
    }
}
