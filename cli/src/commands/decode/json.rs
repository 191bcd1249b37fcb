//! For programs: one object per message.

use std::io::{self, Write};

use super::decoded::{Decoded, Seconds};

pub fn write(out: &mut impl Write, decoded: &Decoded) -> io::Result<()> {
    let Decoded { record, frame, message, values } = decoded;
    // Written by hand: numbers keep every digit, and it is several times faster than a tree of values.
    write!(out, "{{\"t\":{},\"ch\":{},\"id\":\"{}\",", Seconds(record.time_ns), record.channel, frame.id())?;
    out.write_all(b"\"message\":")?;
    serde_json::to_writer(&mut *out, &message.name)?;
    out.write_all(b",\"signals\":{")?;
    for (at, value) in values.iter().enumerate() {
        let signal = &message.signals[value.signal as usize];
        if at > 0 {
            out.write_all(b",")?;
        }
        serde_json::to_writer(&mut *out, &signal.name)?;
        let number = signal.number(value.raw);
        if number.is_finite() { write!(out, ":{number}")? } else { out.write_all(b":null")? }
    }
    out.write_all(b"}}\n")
}
