//! A database as the text of a DBC file.

use std::fmt::Write as _;

use cantap_signals::{ByteOrder, Database, Message, Signal, ValueKind};

use crate::error::EngineError;

/// The flag that a DBC sets in a 29-bit identifier.
const EXTENDED: u64 = 1 << 31;

/// Refuses a name that a DBC cannot have.
pub fn check_name(name: &str) -> Result<(), EngineError> {
    let is_letter = |character: char| character.is_ascii_alphanumeric() || character == '_';
    let is_name = name.starts_with(|first: char| is_letter(first) && !first.is_ascii_digit())
        && name.chars().all(is_letter);
    if is_name {
        return Ok(());
    }
    let text =
        format!("'{name}' cannot be a name in a DBC; write letters, digits and _, beginning with a letter");
    Err(EngineError::Signal(text))
}

/// The database's text. Signals of contained PDUs are not in it.
pub fn write(database: &Database) -> String {
    let mut out = String::from("VERSION \"\"\n\nNS_ :\n\nBS_:\n\nBU_: Vector__XXX\n\n");
    let mut after = String::new();
    for message in &database.messages {
        // Writing to a String cannot fail.
        let _ = writeln!(out, "BO_ {} {}: {} Vector__XXX", number(message), message.name, message.length);
        for signal in &message.signals {
            write_signal(&mut out, signal);
            write_extras(&mut after, message, signal);
        }
        out.push('\n');
        if !message.description.is_empty() {
            let _ = writeln!(after, "CM_ BO_ {} \"{}\";", number(message), quoted(&message.description));
        }
    }
    out + &after
}

fn number(message: &Message) -> u64 {
    u64::from(message.id.raw()) | if message.id.is_extended() { EXTENDED } else { 0 }
}

fn write_signal(out: &mut String, signal: &Signal) {
    let multiplex = match &signal.multiplexed {
        None => String::new(),
        // Others stand in SG_MUL_VAL_.
        Some(of) => format!(" m{}", of.values.first().map_or(0, |range| *range.start())),
    };
    let switch = match (signal.is_switch, multiplex.is_empty()) {
        (false, _) => "",
        (true, true) => " M",
        (true, false) => "M",
    };
    let _ = writeln!(
        out,
        " SG_ {}{multiplex}{switch} : {}|{}@{}{} ({},{}) [{}|{}] \"{}\" Vector__XXX",
        signal.name,
        signal.start,
        signal.length,
        u8::from(signal.order == ByteOrder::Little),
        if matches!(signal.kind, ValueKind::Unsigned) { '+' } else { '-' },
        signal.factor,
        signal.offset,
        signal.min.unwrap_or(0.0),
        signal.max.unwrap_or(0.0),
        quoted(&signal.unit),
    );
}

fn write_extras(out: &mut String, message: &Message, signal: &Signal) {
    let (id, name) = (number(message), &signal.name);
    if !signal.description.is_empty() {
        let _ = writeln!(out, "CM_ SG_ {id} {name} \"{}\";", quoted(&signal.description));
    }
    if !signal.values.is_empty() {
        let _ = write!(out, "VAL_ {id} {name}");
        for (value, text) in signal.values.iter() {
            let _ = write!(out, " {value} \"{}\"", quoted(text));
        }
        out.push_str(" ;\n");
    }
    let float = match signal.kind {
        ValueKind::Single => 1,
        ValueKind::Double => 2,
        _ => 0,
    };
    if float > 0 {
        let _ = writeln!(out, "SIG_VALTYPE_ {id} {name} : {float};");
    }
    if let Some(of) = &signal.multiplexed
        && let Some(switch) = message.signals.get(of.switch)
    {
        let ranges: Vec<_> =
            of.values.iter().map(|range| format!("{}-{}", range.start(), range.end())).collect();
        let _ = writeln!(out, "SG_MUL_VAL_ {id} {name} {} {};", switch.name, ranges.join(", "));
    }
}

/// A DBC has no way to write a quotation mark in a text.
fn quoted(text: &str) -> String {
    text.replace('"', "'").replace(['\\', '\n', '\r'], " ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_signals::dbc;

    #[test]
    fn a_database_survives_being_written() {
        let text = "BO_ 2566844926 Extended: 8 X\n SG_ Switch M : 0|8@1+ (1,0) [0|3] \"\" X\n SG_ A m0 : 8|16@1- (0.1,-5) [-5|99] \"V\" X\n \
                    SG_ B m1 : 15|16@0+ (1,0) [0|0] \"\" X\n SG_ F m2 : 32|32@1- (1,0) [0|0] \"\" X\n\n\
                    BO_ 100 Plain: 2 X\n SG_ C : 0|4@1+ (1,0) [0|0] \"\" X\n\nCM_ SG_ 100 C \"what it is\";\n\
                    VAL_ 100 C 1 \"one\" 2 \"two\" ;\nSIG_VALTYPE_ 2566844926 F : 1;\n";
        let original = dbc::parse("a.dbc", text.as_bytes()).unwrap();
        let written = write(&original);
        let again = dbc::parse("a.dbc", written.as_bytes()).unwrap();
        let plain = |database: &Database| {
            let mut messages = database.messages.clone();
            for message in &mut messages {
                message.line = 0;
                message.signals.iter_mut().for_each(|signal| signal.line = 0);
            }
            messages
        };
        assert_eq!(plain(&again), plain(&original), "{written}");
        assert_eq!(again.warnings, []);
    }
}
