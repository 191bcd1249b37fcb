//! For people: `(1.000000) can0 618 Dashboard: Speed = 88 km/h, Gear = 3 (Drive)`.

use std::io::{self, Write};

use cantap_signals::{Message, SignalValue};
use cantap_trace::Interface;

use super::decoded::{Decoded, Reading, Seconds};

pub fn write(out: &mut impl Write, decoded: &Decoded) -> io::Result<()> {
    let Decoded { record, frame, message, values, .. } = decoded;
    let interface = Interface(record.channel);
    write!(out, "({}) {interface} {} {}:", Seconds(record.time_ns), frame.id(), message.name)?;
    write_values(out, message, values)?;
    writeln!(out)
}

/// ` Speed = 88 km/h, Gear = 3 (Drive), Temperature = not available`.
pub fn write_values(out: &mut impl Write, message: &Message, values: &[SignalValue]) -> io::Result<()> {
    for (at, value) in values.iter().enumerate() {
        let comma = if at == 0 { "" } else { "," };
        let reading = Reading::of(message, value);
        write!(out, "{comma} {} = ", reading.label)?;
        match (reading.number, reading.indicator) {
            (Some(number), _) => {
                write!(out, "{}", reading.signal.for_people(number))?;
                if !reading.signal.unit.is_empty() {
                    write!(out, " {}", reading.signal.unit)?;
                }
            }
            (None, indicator) => out.write_all(indicator.unwrap_or_default().as_bytes())?,
        }
        // "not available (Not Available)" would be redundant.
        let said =
            |text: &&str| reading.indicator.is_some_and(|indicator| text.eq_ignore_ascii_case(indicator));
        if let Some(text) = reading.text.filter(|text| !said(text)) {
            write!(out, " ({text})")?;
        }
    }
    Ok(())
}
