//! The database's messages as frames from the car.

use cantap_firmware::bus::checksum::checksum;
use cantap_signals::encode::{Input, encode_message};
use cantap_signals::{ByteOrder, Message, Signal, ValueKind};
use cantap_wire::Frame;
use cantap_wire::message::Checksum;

use super::values::{self, Context};
use super::vehicle::Vehicle;

/// One message, and what all its frames have in common.
#[derive(Debug)]
pub struct Layout {
    message: Message,
    /// Bits without a signal: 1 in J1939, meaning "not available"; otherwise 0.
    fill: Vec<u8>,
    checksum: Option<(usize, Checksum)>,
    counter: Option<usize>,
}

impl Layout {
    /// From the database's message.
    pub fn new(message: &Message) -> Self {
        let ending = |end: &str| message.signals.iter().position(|signal| signal.name.ends_with(end));
        let checksum = ending("Checksum").map(|at| {
            let signal = &message.signals[at];
            let algorithm =
                if signal.description.starts_with("CRC") { Checksum::Crc8J1850 } else { Checksum::Xor };
            (usize::from(signal.start / 8), algorithm)
        });
        let fill = if message.j1939 { unused(message) } else { vec![0; message.length.into()] };
        Self { message: message.clone(), fill, checksum, counter: ending("Counter") }
    }

    /// The message.
    pub const fn message(&self) -> &Message {
        &self.message
    }

    /// The message's data for the current state of the car.
    pub fn data(&self, car: &Vehicle, context: Context) -> Vec<u8> {
        let inputs: Vec<_> = (self.message.signals.iter().enumerate())
            .filter(|(at, signal)| {
                let multiplexed = signal.multiplexed.as_ref();
                multiplexed.is_none_or(|multiplexed| multiplexed.matches(context.part.into()))
                    && self.checksum.is_none_or(|(byte, _)| {
                        byte != usize::from(signal.start / 8) || Some(*at) == self.counter
                    })
            })
            .filter_map(|(_, signal)| {
                let value = values::value(&signal.name, car, context)?;
                Some((signal.name.clone(), Input::Raw(raw(signal, value))))
            })
            .collect();
        // This cannot fail: a test sends every message of the database, and the values are within their
        // signals' ranges.
        let mut data = encode_message(&self.message, &inputs).unwrap_or_default();
        for (byte, fill) in data.iter_mut().zip(&self.fill) {
            *byte |= fill;
        }
        if let Some((holder, algorithm)) = self.checksum
            && holder < data.len()
        {
            data[holder] = checksum(algorithm, &data, holder);
        }
        data
    }

    /// The same as a frame.
    pub fn frame(&self, car: &Vehicle, context: Context) -> Frame {
        let data = self.data(car, context);
        let mut padded = [0; 8];
        padded[..data.len()].copy_from_slice(&data);
        Frame::from_bus(self.message.id, false, data.len() as u8, padded)
    }
}

/// The bits for a physical value, rounded to the signal's resolution.
fn raw(signal: &Signal, value: f64) -> u64 {
    let value = value.clamp(signal.min.unwrap_or(f64::MIN), signal.max.unwrap_or(f64::MAX));
    let steps = ((value - signal.offset) / signal.factor).round() as i64;
    let all = u64::MAX >> (64 - signal.length.clamp(1, 64));
    debug_assert!(matches!(signal.kind, ValueKind::Unsigned | ValueKind::Signed));
    steps as u64 & all
}

/// A mask with ones where there is no signal.
fn unused(message: &Message) -> Vec<u8> {
    let mut unused = vec![0xFF_u8; message.length.into()];
    for signal in &message.signals {
        debug_assert_eq!(signal.order, ByteOrder::Little, "{} is a J1939 signal", signal.name);
        for bit in signal.start..signal.start + signal.length {
            if let Some(byte) = unused.get_mut(usize::from(bit / 8)) {
                *byte &= !(1 << (bit % 8));
            }
        }
    }
    unused
}
