//! For programs: one object per event.

use std::io::{self, Write};

use cantap_protocols::{Event, Field, Party, Value};

use crate::commands::decode::Seconds;

/// Writes the object.
pub(super) fn write(out: &mut impl Write, event: &Event) -> io::Result<()> {
    // Written by hand, as in decode, so that times keep every digit.
    write!(
        out,
        "{{\"time_s\":{},\"start_s\":{},\"channel\":{},\"protocol\":\"{}\",\"kind\":\"{}\"",
        Seconds(event.time_ns),
        Seconds(event.start_ns),
        event.channel,
        event.protocol,
        event.kind
    )?;
    for (key, party) in [("from", event.from), ("to", event.to)] {
        match party {
            Party::Unknown => write!(out, ",\"{key}\":null")?,
            party => write!(out, ",\"{key}\":\"{party}\"")?,
        }
    }
    out.write_all(b",\"title\":")?;
    serde_json::to_writer(&mut *out, &event.title)?;
    out.write_all(b",\"fields\":{")?;
    members(out, &event.fields, |out, field| value(out, &field.value))?;
    out.write_all(b"}")?;
    let with_text: Vec<_> = event.fields.iter().filter(|field| field.text.is_some()).cloned().collect();
    if !with_text.is_empty() {
        out.write_all(b",\"texts\":{")?;
        members(out, &with_text, |out, field| {
            Ok(serde_json::to_writer(out, field.text.as_deref().unwrap_or_default())?)
        })?;
        out.write_all(b"}")?;
    }
    let with_unit: Vec<_> = event.fields.iter().filter(|field| !field.unit.is_empty()).cloned().collect();
    if !with_unit.is_empty() {
        out.write_all(b",\"units\":{")?;
        members(out, &with_unit, |out, field| Ok(serde_json::to_writer(out, field.unit.as_ref())?))?;
        out.write_all(b"}")?;
    }
    if let Some(response_ns) = event.response_ns {
        write!(out, ",\"response_ms\":{}", response_ns as f64 / 1e6)?;
    }
    out.write_all(b",\"data\":\"")?;
    event.data.iter().try_for_each(|byte| write!(out, "{byte:02X}"))?;
    write!(out, "\",\"frames\":{}", event.frames)?;
    if let Some(trouble) = &event.trouble {
        write!(out, ",\"trouble\":\"{}\",\"trouble_text\":", trouble.code())?;
        serde_json::to_writer(&mut *out, &trouble.to_string())?;
    }
    if event.frames_lost {
        out.write_all(b",\"frames_lost\":true")?;
    }
    out.write_all(b"}\n")
}

/// Members of an object; the second and later ones with the same name have a number appended: `did`, `did_2`.
fn members<W: Write>(
    out: &mut W,
    fields: &[Field],
    mut write_value: impl FnMut(&mut W, &Field) -> io::Result<()>,
) -> io::Result<()> {
    for (at, field) in fields.iter().enumerate() {
        if at > 0 {
            out.write_all(b",")?;
        }
        match fields[..at].iter().filter(|earlier| earlier.name == field.name).count() {
            0 => serde_json::to_writer(&mut *out, &field.name)?,
            before => serde_json::to_writer(&mut *out, &format!("{}_{}", field.name, before + 1))?,
        }
        out.write_all(b":")?;
        write_value(out, field)?;
    }
    Ok(())
}

fn value<W: Write>(out: &mut W, value: &Value) -> io::Result<()> {
    match value {
        Value::Number(number) => write!(out, "{number}"),
        Value::Hex(number, _) => write!(out, "{number}"),
        Value::Real(number) if number.is_finite() => write!(out, "{number}"),
        Value::Real(_) | Value::Missing => out.write_all(b"null"),
        Value::Text(text) => Ok(serde_json::to_writer(out, text)?),
        Value::Bytes(bytes) => {
            out.write_all(b"\"")?;
            bytes.iter().try_for_each(|byte| write!(out, "{byte:02X}"))?;
            out.write_all(b"\"")
        }
    }
}
