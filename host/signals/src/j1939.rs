//! What a J1939 parameter's bits can say instead of a value: that its sensor failed, or that there is no
//! value.
//!
//! SAE J1939-71 reserves the top of each range for this: in a byte 0xFE and 0xFF, in two to four bytes the values with
//! these in the highest byte, in two bits 2 and 3. NMEA 2000, which is based on J1939, has signed values, for which
//! these are the largest two.

use std::fmt;

use super::layout;
use super::model::{Message, Signal, ValueKind};

/// What a parameter sends instead of a value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Indicator {
    /// The sensor, or the sender of the parameter, failed.
    Error,
    /// There is no such value.
    NotAvailable,
}

impl Indicator {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Error => "error",
            Self::NotAvailable => "not available",
        }
    }
}

impl fmt::Display for Indicator {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl Message {
    /// What the bits say instead of a value; `None` if they are a value, as always outside J1939.
    pub fn indicator(&self, signal: &Signal, raw: u64) -> Option<Indicator> {
        if self.j1939 { signal.indicator(raw) } else { None }
    }
}

/// The bits that a sender would use for an indicator.
pub(super) fn raw_of(signal: &Signal, indicator: Indicator) -> Option<u64> {
    let (mask, length) = (layout::mask(signal.length), u32::from(signal.length));
    let raw = match (signal.kind, indicator) {
        (ValueKind::Signed, Indicator::NotAvailable) => mask >> 1,
        (ValueKind::Signed, Indicator::Error) => (mask >> 1) - 1,
        (_, Indicator::NotAvailable) => mask,
        (_, Indicator::Error) if length >= 8 => 0xFE << (length - 8),
        (_, Indicator::Error) => mask - 1,
    };
    (signal.indicator(raw) == Some(indicator)).then_some(raw)
}

impl Signal {
    /// The least bits that may be an indicator in J1939; `None` if none are.
    pub(super) fn first_indicator(&self) -> Option<u64> {
        let mask = layout::mask(self.length);
        match (self.kind, self.length) {
            _ if self.is_switch => None,
            (ValueKind::Unsigned, 8 | 16 | 24 | 32) => Some(0xFE << (self.length - 8)),
            (ValueKind::Unsigned, 2) => Some(2),
            (ValueKind::Unsigned, 3..) => Some(mask),
            (ValueKind::Signed, 16..) => Some((mask >> 1) - 1),
            _ => None,
        }
    }

    /// Like [`Message::indicator`], for a signal of J1939.
    pub(super) fn indicator(&self, raw: u64) -> Option<Indicator> {
        if self.is_switch {
            return None;
        }
        let mask = layout::mask(self.length);
        let (found, largest) = match (self.kind, self.length) {
            (ValueKind::Unsigned, 8 | 16 | 24 | 32) => match raw >> (self.length - 8) {
                0xFF => (Indicator::NotAvailable, mask),
                0xFE => (Indicator::Error, mask),
                _ => return None,
            },
            (ValueKind::Unsigned, 2) if raw == 2 => (Indicator::Error, mask),
            (ValueKind::Unsigned, 2..) if raw == mask => (Indicator::NotAvailable, mask),
            (ValueKind::Signed, 16..) if raw == mask >> 1 => (Indicator::NotAvailable, mask >> 1),
            (ValueKind::Signed, 16..) if raw == (mask >> 1) - 1 => (Indicator::Error, mask >> 1),
            _ => return None,
        };
        if self.length < 8
            && let Some(text) = self.text(raw)
        {
            // A list of states may use all its numbers; its own texts decide.
            return named(text);
        }
        // A file that gives a signal's range knows it better than the standard, unless the range is only that
        // of the bits.
        let within = |max| max < self.physical(largest) && self.physical(raw) <= max;
        (!self.max.is_some_and(within)).then_some(found)
    }
}

/// The indicator that a value table's text stands for.
fn named(text: &str) -> Option<Indicator> {
    let text = text.to_lowercase();
    let says = |words: &[&str]| words.iter().any(|word| text.contains(word));
    if says(&["not avail", "not_avail", "notavail", "unavailable", "don't care", "no action", "no data"]) {
        Some(Indicator::NotAvailable)
    } else {
        says(&["error"]).then_some(Indicator::Error)
    }
}

#[cfg(test)]
mod tests {
    use super::super::model::ValueTable;
    use super::*;

    #[test]
    fn the_top_of_each_range_is_no_value() {
        use Indicator::{Error, NotAvailable};
        let unsigned = |length| Signal::new("S", 0, length);
        let signed = |length| Signal { kind: ValueKind::Signed, ..Signal::new("S", 0, length) };
        for (signal, raw, expected) in [
            (unsigned(8), 0xFA, None),
            (unsigned(8), 0xFE, Some(Error)),
            (unsigned(8), 0xFF, Some(NotAvailable)),
            (unsigned(16), 0xFDFF, None),
            (unsigned(16), 0xFE12, Some(Error)),
            (unsigned(16), 0xFF00, Some(NotAvailable)),
            (unsigned(32), 0xFF00_0000, Some(NotAvailable)),
            (unsigned(2), 2, Some(Error)),
            (unsigned(2), 3, Some(NotAvailable)),
            (unsigned(1), 1, None),
            (unsigned(4), 14, None),
            (unsigned(4), 15, Some(NotAvailable)),
            (unsigned(64), u64::MAX, Some(NotAvailable)),
            (signed(32), 0x7FFF_FFFF, Some(NotAvailable)),
            (signed(32), 0x7FFF_FFFE, Some(Error)),
            (signed(32), 0xFFFF_FFFF, None),
        ] {
            assert_eq!(signal.indicator(raw), expected, "{} bits, {raw:X}", signal.length);
        }
    }

    #[test]
    fn nothing_below_the_first_indicator_is_one() {
        let kinds =
            [ValueKind::Unsigned, ValueKind::Signed, ValueKind::SignMagnitude, ValueKind::OnesComplement];
        for (kind, length) in kinds.into_iter().flat_map(|kind| (1..=18).map(move |length| (kind, length))) {
            for is_switch in [false, true] {
                let signal = Signal { kind, is_switch, ..Signal::new("S", 0, length) };
                let first = (0..1 << length).find(|raw| signal.indicator(*raw).is_some());
                assert_eq!(signal.first_indicator(), first, "{kind:?} of {length} bits");
            }
        }
        let longer = |kind, length| Signal { kind, ..Signal::new("S", 0, length) };
        for (kind, length, first) in [
            (ValueKind::Unsigned, 24, 0xFE_0000),
            (ValueKind::Unsigned, 32, 0xFE00_0000),
            (ValueKind::Unsigned, 64, u64::MAX),
            (ValueKind::Signed, 64, u64::MAX / 2 - 1),
        ] {
            let signal = longer(kind, length);
            assert_eq!(signal.first_indicator(), Some(first));
            assert_eq!((signal.indicator(first - 1), signal.indicator(first).is_some()), (None, true));
        }
    }

    #[test]
    fn the_files_own_words_and_limits_go_first() {
        let table = |entries: &[(i64, &str)]| {
            ValueTable::new(entries.iter().map(|(value, text)| (*value, (*text).to_owned())))
        };
        let gear = Signal { values: table(&[(2, "Second"), (3, "Third")]), ..Signal::new("Gear", 0, 2) };
        assert_eq!((gear.indicator(2), gear.indicator(3)), (None, None));
        let lamp = Signal { values: table(&[(3, "Not Available")]), ..Signal::new("Lamp", 0, 2) };
        assert_eq!(lamp.indicator(3), Some(Indicator::NotAvailable));
        // NMEA 2000 uses all but the last three; a range as wide as the bits does not matter.
        let depth = Signal { max: Some(65_532.0), ..Signal::new("Depth", 0, 16) };
        assert_eq!((depth.indicator(0xFE00), depth.indicator(0xFFFF)), (None, Some(Indicator::NotAvailable)));
        let speed = Signal { max: Some(65_535.0), ..Signal::new("Speed", 0, 16) };
        assert_eq!(speed.indicator(0xFE00), Some(Indicator::Error));
    }
}
