//! Which signals of a message are wanted.

use arrow_array::RecordBatch;
use cantap_signals::{Message, Selection};

use crate::error::Error;

/// What was chosen, if anything was.
pub fn selection(signals: &[String]) -> Result<Option<Selection>, Error> {
    Ok(if signals.is_empty() { None } else { Some(Selection::new(signals)?) })
}

/// The columns for time, channel and identifier, and those of the chosen signals.
pub fn only(batch: &RecordBatch, message: &Message, chosen: &Selection) -> RecordBatch {
    // Three for every frame; then one for each signal, and one for its texts if it has any.
    let mut at = 3;
    let mut kept: Vec<_> = (0..at).collect();
    for signal in &message.signals {
        let columns = at..at + if signal.values.is_empty() { 1 } else { 2 };
        at = columns.end;
        if chosen.matches(message, signal) {
            kept.extend(columns);
        }
    }
    // This cannot fail: all of these exist.
    batch.project(&kept).unwrap_or_else(|_| batch.clone())
}
