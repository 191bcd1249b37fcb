//! The content of a database: messages, signals, and how their bits become values.

use std::borrow::Cow;
use std::fmt;
use std::ops::RangeInclusive;
use std::str::FromStr;

use cantap_can::Id;

use super::container::{Container, InPdu};
use super::fault::Fault;
use super::layout::{self, ByteOrder};
use super::number::{Number, shortest_of_f32};
use super::scale::Scale;
use cantap_trace::clean;

/// A set of messages, from one file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Database {
    /// The file it was read from, for messages to the user.
    pub file: String,
    /// The messages, in the file's order.
    pub messages: Vec<Message>,
    /// The buses of the file that were read, by name; empty if its format has none.
    pub buses: Vec<String>,
    /// What is wrong with the file although it is usable.
    pub warnings: Vec<Fault>,
}

/// One kind of frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Message {
    /// The identifier of its frames.
    pub id: Id,
    /// Its name.
    pub name: String,
    /// Its purpose; may be empty.
    pub description: String,
    /// Its length in bytes. Above eight, it is a CAN FD message or one of a transport protocol.
    pub length: u16,
    /// How often it is sent, in milliseconds, if known.
    pub cycle_ms: Option<u32>,
    /// Whether it is a J1939 parameter group: priority and source address are ignored when matching.
    pub j1939: bool,
    /// Its part that holds PDUs, if each frame says itself which PDUs it contains.
    pub container: Option<Container>,
    /// Its signals, in the file's order.
    pub signals: Vec<Signal>,
    /// The line in the file, from 1; 0 if there is none.
    pub line: u32,
}

impl Message {
    /// The bytes that a signal may lie in: those of the message, or of the PDU that it is in.
    pub(super) fn room_of(&self, signal: &Signal) -> u16 {
        let pdu = signal.contained.as_ref().zip(self.container.as_ref());
        let pdu = pdu.and_then(|(pdu, container)| container.pdus.get(pdu.place));
        pdu.map_or(self.length, |pdu| pdu.length)
    }

    /// The signal with that name.
    pub fn signal(&self, name: &str) -> Option<&Signal> {
        self.signals.iter().find(|signal| signal.name == name)
    }
}

/// One value in a message.
#[derive(Clone, Debug, PartialEq)]
pub struct Signal {
    /// Its name.
    pub name: String,
    /// Its meaning; may be empty.
    pub description: String,
    /// Its unit, such as `km/h`; may be empty.
    pub unit: String,
    /// The first bit in DBC's numbering: the least significant bit of a little-endian signal, the
    /// most significant of a big-endian one. Bit 0 is the least significant of the first byte.
    pub start: u16,
    /// Number of bits, 1 to 64.
    pub length: u16,
    /// The order of its bytes.
    pub order: ByteOrder,
    /// How to interpret its bits.
    pub kind: ValueKind,
    /// Physical value = raw value · factor + offset.
    pub factor: f64,
    /// Physical value = raw value · factor + offset.
    pub offset: f64,
    /// The smallest physical value that the file allows, if it gives one.
    pub min: Option<f64>,
    /// The largest physical value that the file allows, if it gives one.
    pub max: Option<f64>,
    /// Texts for raw values.
    pub values: ValueTable,
    /// The PDU of the message's container that it is in, if it is in one: its place counts from that one's first byte.
    pub contained: Option<InPdu>,
    /// When the signal is present, if not always.
    pub multiplexed: Option<Multiplexed>,
    /// Whether other signals depend on its value.
    pub is_switch: bool,
    /// The raw value to send if the user gives none.
    pub initial_raw: u64,
    /// How to show it as on and off, if desired.
    pub digital: Option<Digital>,
    /// Limits beyond which it is shown as an alarm.
    pub alarms: Alarms,
    /// The colour in which to draw it.
    pub colour: Option<Colour>,
    /// How many signals with the same name come before it that a frame may carry together with it: mostly
    /// none.
    pub twins_before: u16,
    /// The line in the file, from 1; 0 if there is none.
    pub line: u32,
}

/// How to interpret a signal's bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ValueKind {
    /// An unsigned integer.
    Unsigned,
    /// An integer in two's complement.
    Signed,
    /// A sign bit, then the magnitude: 0xC040 in 16 bits is −0x4040.
    SignMagnitude,
    /// An integer in one's complement: negative ones have all bits of their magnitude inverted, and there are two zeros.
    OnesComplement,
    /// IEEE 754 half precision, 16 bits.
    Half,
    /// IEEE 754 single precision. If there are fewer than 32 bits, they are the upper ones, and the rest are
    /// zero.
    Single,
    /// IEEE 754 double precision. If there are fewer than 64 bits, they are the upper ones, and the rest are
    /// zero.
    Double,
}

/// The values of another signal for which a signal is present.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Multiplexed {
    /// The other signal's index in [`Message::signals`].
    pub switch: usize,
    /// Its raw values, in the file's order.
    pub values: Vec<RangeInclusive<u64>>,
}

impl Multiplexed {
    /// Whether the signal is present when the switch has this raw value.
    pub fn matches(&self, raw: u64) -> bool {
        self.values.iter().any(|range| range.contains(&raw))
    }
}

/// A signal with two states: on from `high` upwards, off from `low` downwards, unchanged in between.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Digital {
    /// Off at this physical value and below.
    pub low: f64,
    /// On at this physical value and above.
    pub high: f64,
}

impl Digital {
    /// The state after `value`, given the state before it.
    pub fn state(self, before: bool, value: f64) -> bool {
        if value >= self.high { true } else { before && value > self.low }
    }
}

/// Limits of a signal's normal values.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Alarms {
    /// Below this physical value it is an alarm.
    pub min: Option<f64>,
    /// Above this physical value it is an alarm.
    pub max: Option<f64>,
}

/// Which limit a value exceeds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Alarm {
    /// Below [`Alarms::min`]; shown blue.
    Below,
    /// Above [`Alarms::max`]; shown red.
    Above,
}

impl Alarms {
    /// The alarm that this physical value raises, if any.
    pub fn check(self, value: f64) -> Option<Alarm> {
        if self.max.is_some_and(|max| value > max) {
            Some(Alarm::Above)
        } else if self.min.is_some_and(|min| value < min) {
            Some(Alarm::Below)
        } else {
            None
        }
    }
}

/// A colour, written `#RRGGBB`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Colour {
    /// 0 to 255.
    pub red: u8,
    /// 0 to 255.
    pub green: u8,
    /// 0 to 255.
    pub blue: u8,
}

impl FromStr for Colour {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let digits = text.strip_prefix('#').filter(|digits| digits.len() == 6);
        let digits = digits.filter(|digits| digits.bytes().all(|byte| byte.is_ascii_hexdigit()));
        let number = digits.and_then(|digits| u32::from_str_radix(digits, 16).ok());
        let [_, red, green, blue] = number.ok_or("write a colour as \"#RRGGBB\"")?.to_be_bytes();
        Ok(Self { red, green, blue })
    }
}

impl fmt::Display for Colour {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "#{:02X}{:02X}{:02X}", self.red, self.green, self.blue)
    }
}

/// Texts for raw values, such as 3 = "Drive".
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ValueTable {
    /// Sorted by value, without duplicates.
    entries: Vec<(i64, String)>,
}

impl ValueTable {
    /// Makes a table; if a value occurs twice, the last text is used.
    pub fn new(entries: impl IntoIterator<Item = (i64, String)>) -> Self {
        let by_value: std::collections::BTreeMap<_, _> = entries.into_iter().collect();
        Self { entries: by_value.into_iter().collect() }
    }

    /// The text for a raw value.
    pub fn text(&self, raw: i64) -> Option<&str> {
        let found = self.entries.binary_search_by_key(&raw, |&(value, _)| value).ok()?;
        Some(&self.entries[found].1)
    }

    /// The raw values with a text, in ascending order: those with the text as written, otherwise those with it in
    /// another case. Many tables use one text for several values.
    pub fn values(&self, text: &str) -> Vec<i64> {
        let find = |same: fn(&str, &str) -> bool| -> Vec<i64> {
            self.entries.iter().filter(|(_, entry)| same(entry, text)).map(|(value, _)| *value).collect()
        };
        let exact = find(|a, b| a == b);
        if exact.is_empty() { find(str::eq_ignore_ascii_case) } else { exact }
    }

    /// Makes the texts safe for a terminal.
    pub(super) fn clean(&mut self) {
        self.entries.iter_mut().for_each(|(_, text)| clean::make(text, clean::line));
    }

    /// All values with their texts, sorted by value.
    pub fn iter(&self) -> impl Iterator<Item = (i64, &str)> {
        self.entries.iter().map(|(value, text)| (*value, text.as_str()))
    }

    /// Whether there are no texts.
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }
}

impl Signal {
    /// An unsigned little-endian signal with factor 1 and no other properties.
    pub fn new(name: impl Into<String>, start: u16, length: u16) -> Self {
        Self {
            name: name.into(),
            description: String::new(),
            unit: String::new(),
            start,
            length,
            order: ByteOrder::Little,
            kind: ValueKind::Unsigned,
            factor: 1.0,
            offset: 0.0,
            min: None,
            max: None,
            values: ValueTable::default(),
            contained: None,
            multiplexed: None,
            is_switch: false,
            initial_raw: 0,
            digital: None,
            alarms: Alarms::default(),
            colour: None,
            twins_before: 0,
            line: 0,
        }
    }

    /// Its name, preceded by that of its contained PDU (`Status.Speed`) and followed by a number (`Speed#2`) if a frame may carry another signal
    /// with this name.
    pub fn label(&self) -> Cow<'_, str> {
        let name = match &self.contained {
            None => Cow::Borrowed(self.name.as_str()),
            Some(pdu) => format!("{}.{}", pdu.name, self.name).into(),
        };
        match self.twins_before {
            0 => name,
            before => format!("{name}#{}", before + 1).into(),
        }
    }

    /// Whether `of` is the name of what it is in: its message, or its contained PDU, with or without its message in front.
    pub(super) fn is_in(&self, of: &str, message: &Message) -> bool {
        let Some(pdu) = &self.contained else { return of == message.name };
        let inner = of.strip_prefix(message.name.as_str()).and_then(|rest| rest.strip_prefix('.'));
        of == pdu.name || inner == Some(pdu.name.as_str())
    }

    /// How many data bytes a frame must have to hold it.
    pub fn bytes_needed(&self) -> u32 {
        layout::bytes_needed(self.order, self.start, self.length)
    }

    /// The signal's bits from a message's data; `None` if the data are too short.
    pub fn extract(&self, data: &[u8]) -> Option<u64> {
        layout::extract(self.order, self.start, self.length, data)
    }

    /// The raw bits as an integer, for the integer kinds.
    pub fn integer(&self, raw: u64) -> Option<i128> {
        let unused = 64 - u32::from(self.length);
        match self.kind {
            ValueKind::Unsigned => Some(raw.into()),
            ValueKind::Signed => Some(i128::from((raw << unused) as i64 >> unused)),
            ValueKind::SignMagnitude => {
                let magnitude = i128::from(raw & layout::mask(self.length) >> 1);
                Some(if raw >> (self.length - 1) & 1 == 1 { -magnitude } else { magnitude })
            }
            ValueKind::OnesComplement => {
                let is_negative = raw >> (self.length - 1) & 1 == 1;
                Some(if is_negative { -i128::from(!raw & layout::mask(self.length)) } else { raw.into() })
            }
            ValueKind::Half | ValueKind::Single | ValueKind::Double => None,
        }
    }

    /// The raw bits as a float, before factor and offset.
    pub(super) fn raw_to_f64(&self, raw: u64) -> f64 {
        let length = u32::from(self.length);
        match self.kind {
            ValueKind::Unsigned => raw as f64,
            ValueKind::Signed | ValueKind::SignMagnitude | ValueKind::OnesComplement => {
                self.integer(raw).map_or(f64::NAN, |value| value as f64)
            }
            ValueKind::Half => half::f16::from_bits(raw as u16).to_f64(),
            ValueKind::Single => f32::from_bits((raw as u32) << (32 - length.min(32))).into(),
            ValueKind::Double => f64::from_bits(raw << (64 - length)),
        }
    }

    /// The physical value of the raw bits as a float: for an integer, the one nearest to the decimal result of factor and
    /// offset, such as 0.7 rather than 0.7000000000000001.
    pub fn physical(&self, raw: u64) -> f64 {
        self.scale().apply(self.raw_to_f64(raw))
    }

    /// How raw values become physical ones.
    pub(super) fn scale(&self) -> Scale {
        match self.kind {
            ValueKind::Unsigned
            | ValueKind::Signed
            | ValueKind::SignMagnitude
            | ValueKind::OnesComplement => Scale::of(self.factor, self.offset),
            ValueKind::Half | ValueKind::Single | ValueKind::Double => Scale::plain(self.factor, self.offset),
        }
    }

    /// The physical value of the raw bits, exact if it is an integer.
    pub fn number(&self, raw: u64) -> Number {
        match self.integer(raw) {
            Some(integer) if is_integer(self.factor) && is_integer(self.offset) => {
                Number::Integer(integer * self.factor as i128 + self.offset as i128)
            }
            _ => Number::Real(self.physical(raw)),
        }
    }

    /// A physical value of this signal for display: for floats of 32 and of 16 bits, with as few digits as tell them apart, since 0.1 on
    /// the bus is 0.10000000149011612 as a double; otherwise as [`Number::for_people`].
    pub fn for_people(&self, number: Number) -> Number {
        let Number::Real(value) = number else { return number };
        // A factor may lead out of the small float's range.
        let is_near = |shortest: &f64| (shortest - value).abs() <= value.abs() / 1e3;
        match self.fewest_digits(value).filter(is_near) {
            Some(shortest) => Number::Real(shortest),
            None if is_integer(value) => number,
            None => number.for_people(),
        }
    }

    /// A physical value of this signal as programs read it: a float of 32 or of 16 bits as the decimal number with the fewest digits
    /// that reads back as the same float (0.1 on the bus is 0.10000000149011612 as a double). Any other number stays exact, also
    /// one of such a float with a factor or an offset.
    #[must_use]
    pub fn for_programs(&self, number: Number) -> Number {
        match number {
            Number::Real(value) if self.factor.to_bits() == 1.0_f64.to_bits() && self.offset == 0.0 => {
                Number::Real(self.fewest_digits(value).unwrap_or(value))
            }
            _ => number,
        }
    }

    /// The decimal number with the fewest digits that is the same as `value` in a signal's float of 32 or of 16 bits; `None` if it is
    /// no such float, or if it is an integer, of which all digits count.
    fn fewest_digits(&self, value: f64) -> Option<f64> {
        match self.kind {
            _ if is_integer(value) => None,
            ValueKind::Single => Some(shortest_of_f32(value as f32)),
            ValueKind::Half => (0..5).find_map(|digits| {
                let shorter: f64 = format!("{value:.digits$e}").parse().ok()?;
                (half::f16::from_f64(shorter) == half::f16::from_f64(value)).then_some(shorter)
            }),
            _ => None,
        }
    }

    /// The key of the raw bits in the value table: the integer that they represent, before factor and offset.
    pub fn table_key(&self, raw: u64) -> Option<i64> {
        let value = self.integer(raw).or_else(|| {
            let value = self.raw_to_f64(raw);
            is_integer(value).then_some(value as i128)
        });
        i64::try_from(value?).ok()
    }

    /// The value table's text for the raw bits.
    pub fn text(&self, raw: u64) -> Option<&str> {
        if self.values.is_empty() {
            return None;
        }
        self.values.text(self.table_key(raw)?)
    }
}

/// Whether a float is an integer small enough to be represented exactly.
fn is_integer(value: f64) -> bool {
    value.fract() == 0.0 && value.abs() <= (1u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The earlier analyser's "Signed".
    #[test]
    fn sign_magnitude_has_its_sign_in_the_first_bit() {
        let signal = Signal { kind: ValueKind::SignMagnitude, ..Signal::new("S", 0, 16) };
        assert_eq!(signal.number(0xC040), Number::Integer(-0x4040));
        assert_eq!(signal.number(0x4040), Number::Integer(0x4040));
    }

    #[test]
    fn ones_complement_has_two_zeros() {
        let signal = Signal { kind: ValueKind::OnesComplement, ..Signal::new("S", 0, 8) };
        for (raw, value) in [(0, 0), (0x7F, 127), (0x80, -127), (0xFE, -1), (0xFF, 0)] {
            assert_eq!(signal.number(raw), Number::Integer(value), "{raw:#x}");
        }
    }

    /// The earlier analyser's "Float": if there are fewer bits, they are the upper ones.
    #[test]
    fn floats_are_left_aligned() {
        let upper = Signal { kind: ValueKind::Single, ..Signal::new("F", 0, 16) };
        assert_eq!(upper.number(0xBFC0), Number::Real(-1.5));
        let whole = Signal { kind: ValueKind::Single, ..Signal::new("F", 0, 32) };
        assert_eq!(whole.number(0xBFC0_0000), Number::Real(-1.5));
        let double = Signal { kind: ValueKind::Double, ..Signal::new("D", 0, 24) };
        assert_eq!(double.number(0xBF_F800), Number::Real(-1.5));
    }

    #[test]
    fn small_floats_have_no_digits_that_they_cannot_tell() {
        let single = Signal { kind: ValueKind::Single, ..Signal::new("F", 0, 32) };
        let half = Signal { kind: ValueKind::Half, ..Signal::new("H", 0, 16) };
        let shown = |signal: &Signal, value: f32| {
            let raw = match signal.kind {
                ValueKind::Half => half::f16::from_f32(value).to_bits().into(),
                _ => value.to_bits().into(),
            };
            signal.for_people(signal.number(raw)).to_string()
        };
        for value in [0.1, 3.3, -12.75, 1e-8, 1e30, 16_777_216.0, f32::MIN_POSITIVE] {
            let text = shown(&single, value);
            assert_eq!(text.parse::<f32>().unwrap().to_bits(), value.to_bits(), "{text}");
            assert!(text.len() <= 13, "{text}");
        }
        assert_eq!([0.1, 3.3, f32::NAN].map(|value| shown(&single, value)), ["0.1", "3.3", "NaN"]);
        assert_eq!([0.1, 3.3, 65504.0, 0.0].map(|value| shown(&half, value)), ["0.1", "3.3", "65504", "0"]);
        let scaled = Signal { factor: 0.01, offset: 40.0, ..single.clone() };
        assert_eq!(shown(&scaled, 0.1), "40.001");
        let far = Signal { factor: 1e300, ..single };
        assert!(shown(&far, 0.1).ends_with("e299"));
        let double = Signal { kind: ValueKind::Double, ..Signal::new("D", 0, 64) };
        assert_eq!(double.for_people(Number::Real(0.123_456_789_012)).to_string(), "0.123456789012");
    }

    #[test]
    fn programs_get_the_shortest_text_that_reads_back_as_the_same_float() {
        let single = Signal { kind: ValueKind::Single, ..Signal::new("F", 0, 32) };
        let written = |signal: &Signal, raw: u32| signal.for_programs(signal.number(raw.into())).to_string();
        for value in [0.1, 3.3, 1e-30, 1e30, 16_777_216.0, 123_456_790.0, f32::MIN_POSITIVE, f32::MAX] {
            let text = written(&single, value.to_bits());
            assert_eq!(text.parse::<f32>().unwrap().to_bits(), value.to_bits(), "{text}");
            // Programs read a double and may make it a float again.
            assert_eq!((text.parse::<f64>().unwrap() as f32).to_bits(), value.to_bits(), "{text}");
        }
        assert_eq!(
            [0.1_f32, -12.75, 0.0, f32::NAN].map(|value| written(&single, value.to_bits())),
            ["0.1", "-12.75", "0", "NaN"]
        );
        let half = Signal { kind: ValueKind::Half, ..Signal::new("H", 0, 16) };
        assert_eq!(written(&half, half::f16::from_f32(0.1).to_bits().into()), "0.1");
        // What is no such float itself is exact.
        let scaled = Signal { factor: 0.01, ..single };
        assert_eq!(written(&scaled, 0.1_f32.to_bits()), Number::Real(f64::from(0.1_f32) * 0.01).to_string());
        let double = Signal { kind: ValueKind::Double, ..Signal::new("D", 0, 64) };
        let exact = 0.1 + 0.2;
        assert_eq!(double.for_programs(double.number(f64::to_bits(exact))), Number::Real(exact));
    }

    #[test]
    fn sixty_four_bits_stay_exact() {
        let unsigned = Signal::new("U", 0, 64);
        assert_eq!(unsigned.number(u64::MAX), Number::Integer(u64::MAX.into()));
        let signed =
            Signal { kind: ValueKind::Signed, factor: 10.0, offset: -1.0, ..Signal::new("S", 0, 64) };
        assert_eq!(signed.number(1 << 63), Number::Integer(i128::from(i64::MIN) * 10 - 1));
    }

    #[test]
    fn a_digital_signal_keeps_its_state_between_the_thresholds() {
        let digital = Digital { low: 1.0, high: 3.0 };
        let mut state = false;
        let states = [0.0, 2.0, 3.0, 2.0, 1.0, 2.0].map(|value| {
            state = digital.state(state, value);
            state
        });
        assert_eq!(states, [false, false, true, true, false, false]);
    }

    #[test]
    fn colours_are_six_digits() {
        assert_eq!("#ff8800".parse::<Colour>().unwrap().to_string(), "#FF8800");
        for bad in ["ff8800", "#ff880", "#ff88zz", "#+f8800", "#ff88é"] {
            assert!(bad.parse::<Colour>().is_err(), "{bad}");
        }
    }
}
