//! Events from several frames, in the forms of decoded frames.

use std::io::{self, Write};

use cantap_protocols::{Event, Field, Party, Value, naming};
use cantap_trace::Interface;

use super::csv::Cells;
use cantap_trace::Seconds;

/// The fields by their names in columns, followed by those that every event has.
fn fields(event: &Event) -> Vec<Field> {
    let own = naming::fields(event);
    let own = own.into_iter().map(|(name, field)| Field { name: name.into(), ..field.clone() });
    let mut fields: Vec<_> = own.collect();
    fields.push(Field::text("kind", event.kind.name()));
    fields.extend(event.response_ns.map(|ns| Field::real("response_ms", ns as f64 / 1e6, "")));
    fields.extend(event.trouble.map(|trouble| Field::text("trouble", trouble.code())));
    fields.extend(event.frames_lost.then(|| Field::number("frames_lost", 1)));
    fields
}

/// Names, units and values of an event, each a number as text; `None` for an own field that is not a number.
pub fn numbers(event: &Event) -> impl Iterator<Item = (String, String, Option<String>)> {
    let protocol = event.protocol;
    let own = event.fields.len();
    fields(event).into_iter().enumerate().filter_map(move |(place, field)| {
        let Field { name, value, unit, .. } = field;
        let number = match value {
            Value::Number(number) => Some(number.to_string()),
            Value::Hex(number, _) => Some(number.to_string()),
            Value::Real(number) if number.is_finite() => Some(number.to_string()),
            // The kind and the fault are texts in every event.
            _ if place >= own => return None,
            _ => None,
        };
        Some((format!("{protocol}.{name}"), unit.into_owned(), number))
    })
}

/// The identifier or node that sent it; empty if unknown.
fn sender(event: &Event) -> String {
    if event.from == Party::Unknown { String::new() } else { event.from.to_string() }
}

/// As in `cantap conversations`.
pub fn text(out: &mut impl Write, event: &Event) -> io::Result<()> {
    writeln!(out, "({}) {} {event}", Seconds(event.time_ns), Interface(event.channel))
}

/// A line per field; texts are in the last column.
pub fn csv(out: &mut impl Write, event: &Event, cells: Cells) -> io::Result<()> {
    for field in fields(event) {
        let number = match &field.value {
            Value::Number(_) | Value::Real(_) => field.value.to_string(),
            Value::Hex(number, _) => number.to_string(),
            Value::Text(_) | Value::Bytes(_) | Value::Missing => String::new(),
        };
        write!(
            out,
            "{},{},{},{},{}.{},{number},{},{}\r\n",
            Seconds(event.time_ns),
            event.channel,
            sender(event),
            cells.field(&event.title),
            event.protocol,
            field.name,
            cells.field(&field.unit),
            cells.field(&field.text_for_tables().unwrap_or_default())
        )?;
    }
    Ok(())
}

/// An object; with `details` each value is an object too.
pub fn json(out: &mut impl Write, event: &Event, details: bool) -> io::Result<()> {
    let mut signals = serde_json::Map::new();
    for Field { name, value, unit, text } in fields(event) {
        let value = serde_json::Value::from(&value);
        let value = if details {
            let mut object = serde_json::json!({ "value": value });
            if !unit.is_empty() {
                object["unit"] = unit.into_owned().into();
            }
            if let Some(text) = text {
                object["text"] = text.into_owned().into();
            }
            object
        } else {
            value
        };
        signals.insert(format!("{}.{name}", event.protocol), value);
    }
    let party = |party: Party| if party == Party::Unknown { None } else { Some(party.to_string()) };
    let rest = serde_json::json!({
        "id": sender(event), "message": event.title, "protocol": event.protocol.name(),
        "from": party(event.from), "to": party(event.to), "signals": signals,
    });
    // The time is written by hand, to keep all its digits.
    let rest = rest.to_string();
    writeln!(out, "{{\"time_s\":{},\"channel\":{},{}", Seconds(event.time_ns), event.channel, &rest[1..])
}
