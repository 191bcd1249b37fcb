//! The whole way from frames to events.

mod dialects;
mod exchanges;
mod pairs;

use cantap_trace::{TraceEvent, TraceRecord};

use super::*;
use crate::EventKind;
use crate::testing::{self, at, hex};

fn diagnostics() -> Diagnostics {
    Diagnostics::new(&[], true)
}

fn event_lines(frames: &[(f64, &str)]) -> Vec<String> {
    testing::event_lines(diagnostics(), frames)
}

fn events(records: &[TraceRecord]) -> Vec<Event> {
    testing::events(diagnostics(), records)
}
