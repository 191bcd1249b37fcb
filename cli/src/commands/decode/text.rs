//! For people: `(1.000000) can0 618 Dashboard: Speed = 88 km/h, Gear = 3 (Drive)`.

use std::io::{self, Write};

use cantap_signals::{Message, Reading, SignalValue};
use cantap_trace::Interface;

use super::decoded::Decoded;
use cantap_trace::Seconds;

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
        write!(out, "{comma} {}", Reading::of(message, value))?;
    }
    Ok(())
}
