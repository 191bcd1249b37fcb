//! A decoded value together with the signal that it belongs to, ready to be shown.

use std::borrow::Cow;
use std::fmt;

use cantap_trace::TraceRecord;

use crate::{Decoder, Message, Number, Signal, SignalValue};

/// One signal of a frame. Its `Display` is `Speed = 88 km/h`, `Gear = 3 (Drive)` or `Temperature = not available`.
#[derive(Clone, Debug)]
pub struct Reading<'a> {
    /// The message that it is in.
    pub message: &'a Message,
    /// The signal.
    pub signal: &'a Signal,
    /// Its name in this message ([`Signal::label`]).
    pub label: Cow<'a, str>,
    /// Its bits.
    pub raw: u64,
    /// Its physical value in [`Signal::unit`]; `None` if the bits mean that there is none.
    pub number: Option<Number>,
    /// What J1939 says instead of a value, such as `not available`.
    pub indicator: Option<&'static str>,
    /// The value table's text.
    pub text: Option<&'a str>,
}

impl<'a> Reading<'a> {
    /// A value that a [`Decoder`] found in this message.
    ///
    /// # Panics
    /// If it is another message's.
    pub fn of(message: &'a Message, value: &SignalValue) -> Self {
        let signal = &message.signals[value.signal as usize];
        let indicator = message.indicator(signal, value.raw).map(crate::Indicator::name);
        Self {
            message,
            signal,
            label: signal.label(),
            raw: value.raw,
            number: indicator.is_none().then(|| signal.number(value.raw)),
            indicator,
            text: signal.text(value.raw),
        }
    }

    /// [`Self::number`] as programs read it in a text ([`Signal::for_programs`]).
    pub fn number_for_programs(&self) -> Option<Number> {
        self.number.map(|number| self.signal.for_programs(number))
    }

    /// The value table's text, or what replaces a value.
    pub fn text_or_indicator(&self) -> Option<&'a str> {
        self.text.or(self.indicator)
    }
}

impl fmt::Display for Reading<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} = ", self.label)?;
        match self.number {
            Some(number) => {
                write!(f, "{}", self.signal.for_people(number))?;
                if !self.signal.unit.is_empty() {
                    write!(f, " {}", self.signal.unit)?;
                }
            }
            None => f.write_str(self.indicator.unwrap_or_default())?,
        }
        // "not available (Not Available)" would be redundant.
        let repeats =
            |text: &&str| self.indicator.is_some_and(|indicator| text.eq_ignore_ascii_case(indicator));
        match self.text.filter(|text| !repeats(text)) {
            Some(text) => write!(f, " ({text})"),
            None => Ok(()),
        }
    }
}

impl Decoder {
    /// The chosen signals of a record, in the order of the database; none for anything but a data frame of a message that it has.
    /// It allocates for each record: [`Decoder::decode`] does not.
    pub fn readings(&self, record: &TraceRecord) -> Vec<Reading<'_>> {
        let mut values = Vec::new();
        let found = record.frame().and_then(|frame| self.decode(record.channel, frame, &mut values));
        let Some(message) = found.map(|found| self.message(found)) else { return Vec::new() };
        values.iter().map(|value| Reading::of(message, value)).collect()
    }
}

#[cfg(test)]
mod tests {
    use cantap_trace::{Direction, TraceEvent};

    use super::*;
    use crate::{Source, dbc};

    #[test]
    fn a_value_names_its_signal_and_its_message() {
        let text = "BO_ 291 Engine: 8 ECU\n SG_ Speed : 0|16@1+ (0.1,0) [0|0] \"km/h\" Dash\n SG_ Gear : 16|3@1+ (1,0) [0|0] \"\" Dash\n\
                    VAL_ 291 Gear 3 \"Drive\" ;\n";
        let database = dbc::parse("car.dbc", text.as_bytes()).unwrap();
        let decoder = Decoder::new(vec![Source { channel: None, database }]);
        let shown = |frame: &str| {
            let event =
                TraceEvent::Frame { frame: frame.parse().unwrap(), direction: Direction::Rx, late: false };
            let record = TraceRecord { time_ns: 0, device_ns: None, channel: 1, event };
            decoder
                .readings(&record)
                .iter()
                .map(|reading| format!("{}: {reading}", reading.message.name))
                .collect::<Vec<_>>()
        };
        assert_eq!(shown("123#7503030000000000"), ["Engine: Speed = 88.5 km/h", "Engine: Gear = 3 (Drive)"]);
        assert_eq!(
            shown("123#7503"),
            ["Engine: Speed = 88.5 km/h"],
            "what does not fit the frame is not there"
        );
        assert!(shown("124#7503030000000000").is_empty() && shown("123#R8").is_empty());
    }
}
