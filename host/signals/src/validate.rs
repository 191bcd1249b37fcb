//! What every database must hold to, whatever file it comes from.

use std::collections::{HashMap, HashSet};

use super::fault::MAX_SWITCHES;
use super::fault::{DatabaseError, Fault, FaultKind};
use super::model::{Database, Message, Signal, ValueKind};

/// The longest message: J1939's transport protocol carries 1785 bytes.
pub const MAX_BYTES: u16 = 1785;

/// Makes a database of the messages, unless one of the faults (found before or here) forbids it.
pub fn finish(
    file: &str,
    mut messages: Vec<Message>,
    mut faults: Vec<Fault>,
) -> Result<Database, DatabaseError> {
    for message in &mut messages {
        check_message(message, &mut faults);
    }
    check_ids(&messages, &mut faults);
    faults.sort_by_key(|fault| fault.line);
    if faults.iter().any(|fault| !fault.kind.is_warning()) {
        faults.retain(|fault| !fault.kind.is_warning());
        return Err(DatabaseError::Faulty { file: file.to_owned(), faults });
    }
    Ok(Database { file: file.to_owned(), messages, warnings: faults })
}

fn check_ids(messages: &[Message], faults: &mut Vec<Fault>) {
    let mut seen = HashMap::new();
    for message in messages {
        if let Some(other) = seen.insert(message.id, &message.name) {
            let kind = FaultKind::DuplicateId { id: message.id.to_string(), other: other.clone() };
            faults.push(Fault { line: message.line, symbol: message.name.clone(), kind });
        }
    }
}

fn check_message(message: &mut Message, faults: &mut Vec<Fault>) {
    let mut report = |signal: &Signal, kind| {
        let symbol = format!("{}.{}", message.name, signal.name);
        faults.push(Fault { line: signal.line, symbol, kind });
    };
    let mut names = HashSet::new();
    for signal in &message.signals {
        if !names.insert(signal.name.as_str()) {
            report(signal, FaultKind::DuplicateSignal);
        }
        let length_fits = match signal.kind {
            ValueKind::Half => signal.length == 16,
            ValueKind::Single => signal.length <= 32,
            ValueKind::Unsigned | ValueKind::Signed | ValueKind::SignMagnitude | ValueKind::Double => true,
        };
        if !length_fits {
            report(signal, FaultKind::FloatLength(signal.length));
        }
        let (factor, offset) = (signal.factor, signal.offset);
        if !factor.is_finite() || !offset.is_finite() {
            report(signal, FaultKind::Scale { factor, offset });
        } else if factor == 0.0 {
            report(signal, FaultKind::ZeroFactor);
        }
        let (needed, length) = (signal.bytes_needed(), message.length);
        if needed > length.into() {
            report(signal, FaultKind::OutsideMessage { needed, length });
        }
        if let Some(first) = switch_cycle(&message.signals, signal) {
            report(signal, FaultKind::Multiplexers(first.name.clone()));
        }
    }
    let switches: Vec<_> =
        message.signals.iter().filter_map(|signal| Some(signal.multiplexed.as_ref()?.switch)).collect();
    for switch in switches {
        message.signals[switch].is_switch = true;
    }
}

/// The signal's multiplexer, if following multiplexers from it does not end soon.
fn switch_cycle<'a>(signals: &'a [Signal], signal: &'a Signal) -> Option<&'a Signal> {
    let first = &signals[signal.multiplexed.as_ref()?.switch];
    let mut at = first;
    for _ in 0..MAX_SWITCHES {
        at = &signals[at.multiplexed.as_ref()?.switch];
    }
    Some(first)
}
