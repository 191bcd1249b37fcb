//! For spreadsheets: one line per signal (RFC 4180).

use std::borrow::Cow;
use std::io::{self, Write};

use cantap_signals::Reading;

use super::decoded::Decoded;
use cantap_trace::Seconds;

pub fn write_header(out: &mut impl Write) -> io::Result<()> {
    out.write_all(b"time,channel,id,message,signal,value,unit,text\r\n")
}

pub fn write(out: &mut impl Write, decoded: &Decoded, cells: Cells) -> io::Result<()> {
    let Decoded { record, frame, message, values, .. } = decoded;
    for value in *values {
        let reading = Reading::of(message, value);
        write!(
            out,
            "{},{},{},{},{},",
            Seconds(record.time_ns),
            record.channel,
            frame.id(),
            cells.field(&message.name),
            cells.field(&reading.label),
        )?;
        if let Some(number) = reading.number_for_programs() {
            write!(out, "{number}")?;
        }
        write!(
            out,
            ",{},{}\r\n",
            cells.field(&reading.signal.unit),
            cells.field(reading.text_or_indicator().unwrap_or_default())
        )?;
    }
    Ok(())
}

/// How texts are written.
#[derive(Clone, Copy)]
pub struct Cells {
    /// A text that a spreadsheet would take for a formula gets an apostrophe in front, which makes it a text there.
    pub are_texts: bool,
}

impl Cells {
    /// Quotes a text if it contains a comma, a quote or a line end.
    pub fn field(self, text: &str) -> Cow<'_, str> {
        let text: Cow<'_, str> = if self.are_texts && text.starts_with(['=', '+', '-', '@', '\t', '\r']) {
            format!("'{text}").into()
        } else {
            text.into()
        };
        if text.contains([',', '"', '\n', '\r']) {
            format!("\"{}\"", text.replace('"', "\"\"")).into()
        } else {
            text
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_formula_is_a_text_if_that_is_wanted() {
        let (as_is, texts) = (Cells { are_texts: false }, Cells { are_texts: true });
        for (text, quoted, marked) in [
            ("Speed", "Speed", "Speed"),
            ("=HYPERLINK(\"x\",1)", "\"=HYPERLINK(\"\"x\"\",1)\"", "\"'=HYPERLINK(\"\"x\"\",1)\""),
            ("-1+cmd", "-1+cmd", "'-1+cmd"),
            ("@SUM", "@SUM", "'@SUM"),
            ("a=b", "a=b", "a=b"),
        ] {
            assert_eq!((as_is.field(text).as_ref(), texts.field(text).as_ref()), (quoted, marked));
        }
    }
}
