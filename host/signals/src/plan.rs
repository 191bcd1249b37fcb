//! A message compiled for decoding: one shift, one mask and one multiplication per signal.
//!
//! Most frames carry at most eight bytes, so the data are loaded into a register twice, once per byte
//! order, and every signal is extracted from the one that suits it. Signals for the same multiplexer
//! values form a group whose condition is tested once.

mod rows;

use std::ops::RangeInclusive;

pub use rows::{MessageRows, SignalRows};

use super::fault::MAX_SWITCHES;
use super::layout;
use super::layout::ByteOrder;
use super::model::{Message, Signal, ValueKind};
use super::scale::Scale;

/// One decoded signal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SignalValue {
    /// The signal's index in [`Message::signals`].
    pub signal: u32,
    /// Its bits.
    pub raw: u64,
    /// Its physical value; not-a-number if J1939 says that there is none ([`Message::indicator`]).
    /// [`Signal::number`] gives it exactly where 53 bits are not enough.
    pub value: f64,
}

/// How to decode one message.
#[derive(Clone, Debug)]
pub struct MessagePlan {
    groups: Vec<Group>,
    /// The same for each PDU that the message may contain.
    contained: Vec<Vec<Group>>,
}

#[derive(Clone, Debug)]
struct Group {
    /// All must hold; empty for signals that are always present.
    conditions: Vec<Condition>,
    signals: Vec<SignalPlan>,
}

#[derive(Clone, Debug, PartialEq)]
struct Condition {
    switch: Field,
    values: Vec<RangeInclusive<u64>>,
}

/// Where the bits are.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Field {
    order: ByteOrder,
    /// For data of up to eight bytes: right shift of the register.
    shift: u8,
    /// Least number of data bytes; 255 if no frame has enough.
    needed: u8,
    mask: u64,
    /// For longer data.
    start: u16,
    length: u16,
}

#[derive(Clone, Copy, Debug)]
struct SignalPlan {
    field: Field,
    conversion: Conversion,
    index: u32,
    scale: Scale,
    /// The least bits that may mean that there is no value.
    first_indicator: Option<u64>,
}

#[derive(Clone, Copy, Debug)]
enum Conversion {
    Unsigned,
    /// Shift left and arithmetically right by this.
    Signed(u8),
    /// Left shift that aligns a single-precision float.
    Single(u8),
    /// Left shift that aligns a double-precision float.
    Double(u8),
    /// Too rare to be optimised.
    Other,
}

/// Data in the form that the decoder reads.
#[derive(Clone, Copy)]
enum Payload<'a> {
    /// Up to eight bytes, in both orders.
    Frame { little: u64, big: u64, len: u8 },
    /// A reassembled message.
    Long(&'a [u8]),
}

impl Field {
    /// `None` for signals that no database from a file has: with no bits, or too many.
    fn of(signal: &Signal) -> Option<Self> {
        let (order, start, length) = (signal.order, signal.start, signal.length);
        if !(1..=64).contains(&length) {
            return None;
        }
        let needed = signal.bytes_needed();
        let shift = match order {
            _ if needed > 8 => 0,
            ByteOrder::Little => start as u8,
            ByteOrder::Big => (64 - layout::wire_position(start.into()) - u32::from(length)) as u8,
        };
        let needed = if needed > 8 { u8::MAX } else { needed as u8 };
        Some(Self { order, shift, needed, mask: layout::mask(length), start, length })
    }

    fn extract(&self, payload: Payload) -> Option<u64> {
        match payload {
            Payload::Frame { little, big, len } => {
                if self.needed > len {
                    return None;
                }
                let word = if self.order == ByteOrder::Big { big } else { little };
                Some(word >> self.shift & self.mask)
            }
            Payload::Long(data) => layout::extract(self.order, self.start, self.length, data),
        }
    }
}

impl MessagePlan {
    /// Compiles those signals of `message` that `wanted` accepts.
    pub fn new(message: &Message, wanted: impl Fn(usize, &Signal) -> bool) -> Self {
        let mut own: Vec<Group> = Vec::new();
        let pdus = message.container.as_ref().map_or(0, |container| container.pdus.len());
        let mut contained: Vec<Vec<Group>> = vec![Vec::new(); pdus];
        for (index, signal) in message.signals.iter().enumerate() {
            let (Some(field), true) = (Field::of(signal), wanted(index, signal)) else { continue };
            let Some(conditions) = conditions(&message.signals, signal) else { continue };
            let unused = 64 - signal.length as u8;
            let conversion = match signal.kind {
                ValueKind::Unsigned => Conversion::Unsigned,
                ValueKind::Signed => Conversion::Signed(unused),
                ValueKind::Single if signal.length <= 32 => Conversion::Single(unused - 32),
                ValueKind::Double => Conversion::Double(unused),
                ValueKind::Half
                | ValueKind::Single
                | ValueKind::SignMagnitude
                | ValueKind::OnesComplement => Conversion::Other,
            };
            let first_indicator = if message.j1939 { signal.first_indicator() } else { None };
            let (index, scale) = (index as u32, signal.scale());
            let plan = SignalPlan { field, conversion, index, scale, first_indicator };
            let groups = match &signal.contained {
                None => &mut own,
                Some(pdu) => match contained.get_mut(pdu.place) {
                    Some(groups) => groups,
                    None => continue,
                },
            };
            match groups.iter_mut().find(|group| group.conditions == conditions) {
                Some(group) => group.signals.push(plan),
                None => groups.push(Group { conditions, signals: vec![plan] }),
            }
        }
        Self { groups: own, contained }
    }

    /// Whether there is nothing to decode.
    pub fn is_empty(&self) -> bool {
        self.groups.is_empty() && self.contained.iter().all(Vec::is_empty)
    }

    /// Appends every signal that is present and fits `data`. If a PDU is contained several times, the last one counts.
    pub fn decode(&self, message: &Message, data: &[u8], values: &mut Vec<SignalValue>) {
        decode_groups(&self.groups, message, data, values);
        let Some(container) = &message.container else { return };
        let mut parts = container.parts(data);
        while let Some(part) = parts.next() {
            let groups = part.pdu.and_then(|pdu| self.contained.get(pdu)).filter(|groups| !groups.is_empty());
            if let Some(groups) = groups.filter(|_| parts.clone().all(|later| later.pdu != part.pdu)) {
                decode_groups(groups, message, part.data, values);
            }
        }
    }
}

/// Appends every signal of these groups that is there and fits `data`.
fn decode_groups(groups: &[Group], message: &Message, data: &[u8], values: &mut Vec<SignalValue>) {
    let payload = if data.len() <= 8 {
        let mut padded = [0; 8];
        padded[..data.len()].copy_from_slice(data);
        let (little, big) = (u64::from_le_bytes(padded), u64::from_be_bytes(padded));
        Payload::Frame { little, big, len: data.len() as u8 }
    } else {
        Payload::Long(data)
    };
    for group in groups {
        if group.holds(payload) {
            values.extend(group.signals.iter().filter_map(|plan| plan.decode(message, payload)));
        }
    }
}

impl Group {
    /// Whether the multiplexers select its signals.
    fn holds(&self, payload: Payload) -> bool {
        self.conditions.iter().all(|condition| {
            let switch = condition.switch.extract(payload);
            switch.is_some_and(|raw| condition.values.iter().any(|range| range.contains(&raw)))
        })
    }
}

impl SignalPlan {
    #[inline]
    fn decode(&self, message: &Message, payload: Payload) -> Option<SignalValue> {
        let raw = self.field.extract(payload)?;
        let unscaled = match self.conversion {
            Conversion::Unsigned => raw as f64,
            Conversion::Signed(unused) => ((raw << unused) as i64 >> unused) as f64,
            Conversion::Single(left) => f32::from_bits((raw as u32) << left).into(),
            Conversion::Double(left) => f64::from_bits(raw << left),
            Conversion::Other => message.signals[self.index as usize].raw_to_f64(raw),
        };
        let may_indicate = self.first_indicator.is_some_and(|first| raw >= first);
        let no_value = may_indicate && message.signals[self.index as usize].indicator(raw).is_some();
        let value = if no_value { f64::NAN } else { self.scale.apply(unscaled) };
        Some(SignalValue { signal: self.index, raw, value })
    }
}

/// The conditions for the signal to be present, the outermost multiplexer last; `None` if it
/// never is.
fn conditions(signals: &[Signal], signal: &Signal) -> Option<Vec<Condition>> {
    let mut conditions = Vec::new();
    let mut at = signal;
    while let Some(multiplexed) = &at.multiplexed {
        // Files are checked for cycles; a database made by a program may have one.
        let switch = signals.get(multiplexed.switch).filter(|_| conditions.len() < MAX_SWITCHES)?;
        conditions.push(Condition { switch: Field::of(switch)?, values: multiplexed.values.clone() });
        at = switch;
    }
    Some(conditions)
}
