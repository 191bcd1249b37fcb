//! For spreadsheets: one line per signal (RFC 4180).

use std::borrow::Cow;
use std::io::{self, Write};

use cantap_signals::Reading;

use super::decoded::Decoded;
use crate::seconds::Seconds;

pub fn write_header(out: &mut impl Write) -> io::Result<()> {
    out.write_all(b"time,channel,id,message,signal,value,unit,text\r\n")
}

pub fn write(out: &mut impl Write, decoded: &Decoded) -> io::Result<()> {
    let Decoded { record, frame, message, values, .. } = decoded;
    for value in *values {
        let reading = Reading::of(message, value);
        write!(
            out,
            "{},{},{},{},{},",
            Seconds(record.time_ns),
            record.channel,
            frame.id(),
            field(&message.name),
            field(&reading.label),
        )?;
        if let Some(number) = reading.number {
            write!(out, "{number}")?;
        }
        write!(
            out,
            ",{},{}\r\n",
            field(&reading.signal.unit),
            field(reading.text_or_indicator().unwrap_or_default())
        )?;
    }
    Ok(())
}

/// Quotes a field if it contains a comma, a quote or a line end.
pub fn field(text: &str) -> Cow<'_, str> {
    if text.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", text.replace('"', "\"\"")).into()
    } else {
        text.into()
    }
}
