//! Events as JSON, for programs: one object per event.

use std::borrow::Cow;
use std::fmt::Write as _;

use cantap_trace::Seconds;

use crate::{Event, Field, Party, Value};

impl Event {
    /// Appends the event as an object in one line, without the line's end. The keys are those of `docs/protocols.md`.
    pub fn push_json(&self, out: &mut String) {
        let event = self;
        // Written by hand, so that times keep every digit. Writing to a String cannot fail.
        let _ = write!(
            out,
            "{{\"time_s\":{},\"start_s\":{},\"channel\":{},\"protocol\":\"{}\",\"kind\":\"{}\"",
            Seconds(event.time_ns),
            Seconds(event.start_ns),
            event.channel,
            event.protocol.name(),
            event.kind.name()
        );
        push_party(out, ",\"from\":", event.from);
        push_party(out, ",\"to\":", event.to);
        out.push_str(",\"title\":");
        push_text(out, &event.title);
        out.push_str(",\"fields\":");
        event.push_fields_json(out);
        if event.fields.iter().any(|field| field.text.is_some()) {
            out.push_str(",\"texts\":{");
            push_members(out, &event.fields, |field| field.text.as_deref(), push_text);
            out.push('}');
        }
        let unit = |field: &Field| !field.unit.is_empty();
        if event.fields.iter().any(unit) {
            out.push_str(",\"units\":{");
            push_members(out, &event.fields, |field| unit(field).then_some(&*field.unit), push_text);
            out.push('}');
        }
        if let Some(response_ns) = event.response_ns {
            out.push_str(",\"response_ms\":");
            push_real(out, response_ns as f64 / 1e6);
        }
        out.push_str(",\"data\":");
        push_bytes(out, &event.data);
        let _ = write!(out, ",\"frames\":{}", event.frames);
        if let Some(trouble) = &event.trouble {
            let _ = write!(out, ",\"trouble\":\"{}\",\"trouble_text\":", trouble.code());
            push_text(out, &trouble.to_string());
        }
        if event.frames_lost {
            out.push_str(",\"frames_lost\":true");
        }
        out.push('}');
    }

    /// Appends its fields as an object: what [`Self::push_json`] has under `fields`.
    pub fn push_fields_json(&self, out: &mut String) {
        out.push('{');
        push_members(out, &self.fields, |field| Some(&field.value), push_value);
        out.push('}');
    }
}

impl From<&Value> for serde_json::Value {
    /// As in [`Event::push_json`].
    fn from(value: &Value) -> Self {
        match value {
            Value::Number(number) => (*number).into(),
            Value::Hex(number, _) => (*number).into(),
            Value::Real(number) => (*number).into(),
            Value::Missing => Self::Null,
            Value::Text(text) => (&**text).into(),
            Value::Bytes(bytes) => {
                let mut text = String::new();
                push_digits(&mut text, bytes);
                text.into()
            }
        }
    }
}

/// Members of an object, for the fields that have such a value; the second and later fields of a name have a number
/// appended: `did`, `did_2`.
fn push_members<'e, T: ?Sized + 'e>(
    out: &mut String,
    fields: &'e [Field],
    value_of: impl Fn(&'e Field) -> Option<&'e T>,
    push: impl Fn(&mut String, &T),
) {
    let mut comma = "";
    for (at, field) in fields.iter().enumerate() {
        let Some(value) = value_of(field) else { continue };
        out.push_str(comma);
        comma = ",";
        let name: Cow<'_, str> =
            match fields[..at].iter().filter(|earlier| earlier.name == field.name).count() {
                0 => (&*field.name).into(),
                before => format!("{}_{}", field.name, before + 1).into(),
            };
        push_text(out, &name);
        out.push(':');
        push(out, value);
    }
}

fn push_party(out: &mut String, key: &str, party: Party) {
    out.push_str(key);
    if party == Party::Unknown {
        out.push_str("null");
    } else {
        out.push('"');
        party.push_to(out);
        out.push('"');
    }
}

fn push_value(out: &mut String, value: &Value) {
    match value {
        Value::Number(number) => out.push_str(itoa::Buffer::new().format(*number)),
        Value::Hex(number, _) => out.push_str(itoa::Buffer::new().format(*number)),
        Value::Real(number) if number.is_finite() => push_real(out, *number),
        Value::Real(_) | Value::Missing => out.push_str("null"),
        Value::Text(text) => push_text(out, text),
        Value::Bytes(bytes) => push_bytes(out, bytes),
    }
}

/// With the fewest digits from which the same number is read again.
fn push_real(out: &mut String, value: f64) {
    if value.fract() == 0.0 && value.abs() < 1e15 && !(value == 0.0 && value.is_sign_negative()) {
        out.push_str(itoa::Buffer::new().format(value as i64));
    } else {
        let _ = write!(out, "{value}");
    }
}

fn push_bytes(out: &mut String, bytes: &[u8]) {
    out.push('"');
    push_digits(out, bytes);
    out.push('"');
}

/// In hexadecimal, without spaces.
fn push_digits(out: &mut String, bytes: &[u8]) {
    const DIGITS: &[u8; 16] = b"0123456789ABCDEF";
    for byte in bytes {
        out.push(char::from(DIGITS[usize::from(byte >> 4)]));
        out.push(char::from(DIGITS[usize::from(byte & 15)]));
    }
}

fn push_text(out: &mut String, text: &str) {
    if text.bytes().all(|byte| byte >= b' ' && byte != b'"' && byte != b'\\') {
        out.push('"');
        out.push_str(text);
        out.push('"');
    } else {
        let _ = write!(out, "{}", serde_json::Value::from(text));
    }
}

#[cfg(test)]
mod tests {
    use cantap_trace::{TraceEvent, TraceRecord};

    use super::*;
    use crate::{EventKind, Protocol};

    fn object(fields: Vec<Field>) -> serde_json::Value {
        let record =
            TraceRecord { time_ns: 1_500_000_000, device_ns: None, channel: 1, event: TraceEvent::GAP };
        let mut event = Event::new(Protocol::Uds, &record, EventKind::Exchange, "a \"title\"\n");
        event.fields = fields;
        let mut line = String::new();
        event.push_json(&mut line);
        serde_json::from_str(&line).unwrap()
    }

    /// Of two fields with one name, only the second has a text: it is the second's.
    #[test]
    fn texts_and_units_are_those_of_their_field() {
        let object = object(vec![
            Field::number("spn", 1),
            Field::number("spn", 2).meaning(Some("engine \u{1}")),
            Field::real("level", 0.1, "%"),
            Field::real("level", -3.0, ""),
            Field::missing("level").unit("%"),
        ]);
        assert_eq!(object["title"], "a \"title\"\n");
        assert_eq!(object["time_s"], 1.5);
        assert_eq!(object["texts"], serde_json::json!({ "spn_2": "engine \u{1}" }));
        assert_eq!(object["units"], serde_json::json!({ "level": "%", "level_3": "%" }));
        let fields =
            serde_json::json!({ "spn": 1, "spn_2": 2, "level": 0.1, "level_2": -3, "level_3": null });
        assert_eq!(object["fields"], fields);
    }

    #[test]
    fn numbers_are_read_as_they_were() {
        for value in [0.0, -0.0, 1e15, -1e14, 1e300, 5e-324, 0.1 + 0.2, 100.0] {
            let mut text = String::new();
            push_real(&mut text, value);
            assert_eq!(text.parse::<f64>().map(f64::to_bits), Ok(value.to_bits()), "{text}");
        }
    }

    /// The line and the object of `serde_json` say the same.
    #[test]
    fn both_forms_of_a_value_agree() {
        for value in [
            Value::Number(-5),
            Value::Hex(u64::MAX, 16),
            Value::Real(0.1),
            Value::Real(f64::NAN),
            Value::Missing,
            Value::Text("a \"b\"\n".into()),
            Value::Bytes(vec![0x0A, 0xF1].into()),
        ] {
            let mut text = String::new();
            push_value(&mut text, &value);
            let read: serde_json::Value = serde_json::from_str(&text).unwrap();
            assert_eq!(read, serde_json::Value::from(&value));
        }
    }
}
