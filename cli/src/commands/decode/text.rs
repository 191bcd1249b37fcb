//! For people: `(1.000000) can0 618 Dashboard: Speed = 88 km/h, Gear = 3 (Drive)`.

use std::io::{self, Write};

use cantap_signals::{Message, SignalValue};

use super::decoded::{Decoded, Seconds};

pub fn write(out: &mut impl Write, decoded: &Decoded) -> io::Result<()> {
    let Decoded { record, frame, message, values } = decoded;
    // candump numbers interfaces from 0.
    let interface = record.channel.saturating_sub(1);
    write!(out, "({}) can{interface} {} {}:", Seconds(record.time_ns), frame.id(), message.name)?;
    write_values(out, message, values)?;
    writeln!(out)
}

/// ` Speed = 88 km/h, Gear = 3 (Drive)`.
pub fn write_values(out: &mut impl Write, message: &Message, values: &[SignalValue]) -> io::Result<()> {
    for (at, value) in values.iter().enumerate() {
        let signal = &message.signals[value.signal as usize];
        let comma = if at == 0 { "" } else { "," };
        write!(out, "{comma} {} = {}", signal.name, signal.number(value.raw).for_people())?;
        if !signal.unit.is_empty() {
            write!(out, " {}", signal.unit)?;
        }
        if let Some(text) = signal.text(value.raw) {
            write!(out, " ({text})")?;
        }
    }
    Ok(())
}
