//! For programs: one object per message.

use std::io::{self, Write};

use cantap_signals::Reading;

use super::decoded::Decoded;
use cantap_trace::Seconds;

/// Writes the object; with `details` each signal is an object too, with its unit and text.
pub fn write(out: &mut impl Write, decoded: &Decoded, details: bool) -> io::Result<()> {
    let Decoded { record, frame, message, values, .. } = decoded;
    // Written by hand: numbers keep every digit, and it is several times faster than building a tree of
    // values.
    write!(
        out,
        "{{\"time_s\":{},\"channel\":{},\"id\":\"{}\",",
        Seconds(record.time_ns),
        record.channel,
        frame.id()
    )?;
    if let Some(device_ns) = record.device_ns {
        write!(out, "\"device_ns\":{},", device_ns.get())?;
    }
    out.write_all(b"\"message\":")?;
    serde_json::to_writer(&mut *out, &message.name)?;
    out.write_all(b",\"signals\":{")?;
    for (at, value) in values.iter().enumerate() {
        let reading = Reading::of(message, value);
        if at > 0 {
            out.write_all(b",")?;
        }
        serde_json::to_writer(&mut *out, &reading.label)?;
        out.write_all(if details { b":{\"value\":" } else { b":" })?;
        match reading.number_for_programs().filter(|number| number.is_finite()) {
            Some(number) => write!(out, "{number}")?,
            None => out.write_all(b"null")?,
        }
        if details {
            let unit = Some(reading.signal.unit.as_str()).filter(|unit| !unit.is_empty());
            for (key, text) in [("unit", unit), ("text", reading.text_or_indicator())] {
                if let Some(text) = text {
                    write!(out, ",\"{key}\":")?;
                    serde_json::to_writer(&mut *out, text)?;
                }
            }
            write!(out, ",\"raw\":{}}}", value.raw)?;
        }
    }
    out.write_all(b"}}\n")
}
