//! The rules for every database, whatever file it comes from.

use std::collections::{HashMap, HashSet};

use super::fault::{DatabaseError, Fault, FaultKind, MAX_SWITCHES};
use super::model::{Database, Message, Signal, ValueKind};
use cantap_trace::clean;

/// The longest message: J1939's transport protocol carries 1785 bytes.
pub const MAX_BYTES: u16 = 1785;

/// Makes a database from messages. Those with a fault that would make values wrong are left out with a warning; if nothing is
/// left and something was wrong, it is an error.
pub fn finish(file: &str, messages: Vec<Message>, mut faults: Vec<Fault>) -> Result<Database, DatabaseError> {
    // What was not understood may have been all of its messages.
    let is_without_messages = messages.is_empty();
    let mut usable = Vec::with_capacity(messages.len());
    for mut message in messages {
        let before = faults.len();
        check_message(&mut message, &mut faults);
        if faults[before..].iter().all(|fault| fault.kind.is_warning()) {
            usable.push(message);
        }
    }
    check_ids(&usable, &mut faults);
    faults.sort_by_key(|fault| fault.line);
    let is_serious = |fault: &Fault| {
        !fault.kind.is_warning()
            || matches!(fault.kind, FaultKind::LeftOut(_))
            || is_without_messages && matches!(fault.kind, FaultKind::Ignored(_))
    };
    if usable.is_empty() && faults.iter().any(is_serious) {
        faults.retain(is_serious);
        for fault in &mut faults {
            if let FaultKind::LeftOut(kind) = &fault.kind {
                fault.kind = (**kind).clone();
            }
        }
        return Err(DatabaseError::Faulty { file: file.to_owned(), faults });
    }
    for fault in faults.iter_mut().filter(|fault| !fault.kind.is_warning()) {
        fault.kind = FaultKind::LeftOut(fault.kind.clone().into());
    }
    let mut database =
        Database { file: file.to_owned(), messages: usable, buses: Vec::new(), warnings: faults };
    tidy(&mut database);
    Ok(database)
}

/// Like [`finish`], for files that our own reader defines: whatever makes values wrong is an error.
pub fn finish_strictly(
    file: &str,
    messages: Vec<Message>,
    faults: Vec<Fault>,
) -> Result<Database, DatabaseError> {
    let mut database = finish(file, messages, faults)?;
    let is_left_out = |fault: &Fault| matches!(fault.kind, FaultKind::LeftOut(_));
    if database.warnings.iter().any(is_left_out) {
        let mut faults = std::mem::take(&mut database.warnings);
        faults.retain(is_left_out);
        for fault in &mut faults {
            if let FaultKind::LeftOut(kind) = &fault.kind {
                fault.kind = (**kind).clone();
            }
        }
        return Err(DatabaseError::Faulty { file: file.to_owned(), faults });
    }
    Ok(database)
}

/// Makes texts safe for a terminal, and numbers signals with the same name in one frame.
fn tidy(database: &mut Database) {
    for message in &mut database.messages {
        clean::make(&mut message.name, clean::line);
        clean::make(&mut message.description, clean::lines);
        for pdu in message.container.iter_mut().flat_map(|container| &mut container.pdus) {
            clean::make(&mut pdu.name, clean::line);
            clean::make(&mut pdu.description, clean::lines);
        }
        for signal in &mut message.signals {
            clean::make(&mut signal.name, clean::line);
            if let Some(pdu) = &mut signal.contained {
                clean::make(&mut pdu.name, clean::line);
            }
            clean::make(&mut signal.unit, clean::line);
            clean::make(&mut signal.description, clean::lines);
            signal.values.clean();
        }
        number_twins(message);
    }
}

/// Numbers signals with the same name that one frame may carry together.
fn number_twins(message: &mut Message) {
    let mut by_name: HashMap<_, Vec<usize>> = HashMap::new();
    for (place, signal) in message.signals.iter().enumerate() {
        let pdu = signal.contained.as_ref().map(|pdu| pdu.place);
        by_name.entry((pdu, &signal.name)).or_default().push(place);
    }
    let mut numbers = Vec::new();
    for places in by_name.into_values().filter(|places| places.len() > 1) {
        for (at, &place) in places.iter().enumerate() {
            let meets = |other: &&usize| meet(&message.signals[**other], &message.signals[place]);
            numbers.push((place, places[..at].iter().filter(meets).count() as u16));
        }
    }
    for (place, twins_before) in numbers {
        message.signals[place].twins_before = twins_before;
    }
}

/// Whether one frame may carry both. Signals for different values of one multiplexer never occur together.
fn meet(one: &Signal, other: &Signal) -> bool {
    match (&one.multiplexed, &other.multiplexed) {
        (Some(one), Some(other)) if one.switch == other.switch => {
            let overlap = |a: &std::ops::RangeInclusive<u64>| {
                other.values.iter().any(|b| a.start() <= b.end() && b.start() <= a.end())
            };
            one.values.iter().any(overlap)
        }
        _ => true,
    }
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
        let pdu = signal.contained.as_ref().map(|pdu| pdu.place);
        if !names.insert((pdu, signal.name.as_str())) {
            report(signal, FaultKind::DuplicateSignal);
        }
        let length_fits = match signal.kind {
            ValueKind::Half => signal.length == 16,
            ValueKind::Single => signal.length <= 32,
            ValueKind::Unsigned
            | ValueKind::Signed
            | ValueKind::SignMagnitude
            | ValueKind::OnesComplement
            | ValueKind::Double => true,
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
        let length = message.room_of(signal);
        let needed = signal.bytes_needed();
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

/// The signal's multiplexer, if the chain of multiplexers from it is too long or has no end.
fn switch_cycle<'a>(signals: &'a [Signal], signal: &'a Signal) -> Option<&'a Signal> {
    let first = &signals[signal.multiplexed.as_ref()?.switch];
    let mut at = first;
    for _ in 0..MAX_SWITCHES {
        at = &signals[at.multiplexed.as_ref()?.switch];
    }
    Some(first)
}
