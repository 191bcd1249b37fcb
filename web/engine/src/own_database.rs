//! The user's own database: signals drawn into an identifier's bits, as a DBC.

use cantap_signals::{ByteOrder, Database, Message, Signal, ValueKind, ValueTable, dbc};
use serde::Deserialize;

use crate::dbc_text;
use crate::error::EngineError;
use crate::index::identifier;

/// The text of a value.
#[derive(Clone, Debug, serde::Serialize, serde::Deserialize)]
pub struct ValueText {
    /// The physical value.
    pub value: f64,
    /// Its text.
    pub text: String,
}

/// Its name in messages to the user, and of the file that the page saves.
pub const NAME: &str = "own.dbc";
/// The longest message that a signal may be drawn into, in bytes.
const MOST_BYTES: u16 = 64;

/// A signal as the user draws it: `SignalEdit` in `api.ts`.
#[derive(Clone, Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct SignalEdit {
    /// From 1.
    pub channel: u8,
    /// The identifier.
    pub id: u32,
    /// Whether it has 29 bits.
    pub extended: bool,
    /// What to call the message if it has no name yet.
    pub message_name: String,
    /// The signal's name; a signal of this name in the message is replaced.
    pub name: String,
    /// As a DBC has it.
    pub start_bit: u16,
    /// 1 to 64.
    pub bit_length: u16,
    /// The order of its bytes.
    pub little_endian: bool,
    /// Two's complement.
    pub signed: bool,
    /// Physical value = raw value · factor + offset.
    pub factor: f64,
    /// Physical value = raw value · factor + offset.
    pub offset: f64,
    /// May be empty.
    pub unit: String,
    /// Texts of raw values.
    #[serde(default)]
    pub texts: Vec<ValueText>,
}

impl SignalEdit {
    /// The signal, if its bits lie in a frame.
    pub fn signal(&self) -> Result<Signal, EngineError> {
        let refuse = |text: String| Err(EngineError::Signal(text));
        if !(1..=64).contains(&self.bit_length) {
            return refuse(format!("a signal has 1 to 64 bits, not {}; take fewer", self.bit_length));
        }
        if self.start_bit >= MOST_BYTES * 8 {
            return refuse(format!("bit {} lies outside every frame; bits go from 0 to 511", self.start_bit));
        }
        if !self.factor.is_finite() || !self.offset.is_finite() || self.factor == 0.0 {
            return refuse("factor and offset are numbers, and the factor is not 0".to_owned());
        }
        let signal = Signal {
            unit: self.unit.clone(),
            order: if self.little_endian { ByteOrder::Little } else { ByteOrder::Big },
            kind: if self.signed { ValueKind::Signed } else { ValueKind::Unsigned },
            factor: self.factor,
            offset: self.offset,
            values: ValueTable::new(self.texts.iter().map(|text| (text.value as i64, text.text.clone()))),
            ..Signal::new(self.name.clone(), self.start_bit, self.bit_length)
        };
        if signal.bytes_needed() > MOST_BYTES.into() {
            return refuse("the signal reaches beyond the longest frame; take fewer bits".to_owned());
        }
        Ok(signal)
    }

    /// A message with this signal alone.
    pub fn message(&self) -> Result<Message, EngineError> {
        let signal = self.signal()?;
        let id = identifier(self.id, self.extended)?;
        Ok(Message {
            id,
            name: self.message_name.clone(),
            description: String::new(),
            length: (signal.bytes_needed() as u16).max(8),
            cycle_ms: None,
            j1939: false,
            container: None,
            signals: vec![signal],
            line: 0,
        })
    }
}

/// The user's own database.
#[derive(Default)]
pub struct OwnDatabase(Option<Database>);

impl OwnDatabase {
    /// The database, unless it is empty.
    pub const fn database(&self) -> Option<&Database> {
        self.0.as_ref()
    }

    /// Replaces it by this text; an empty one removes it.
    pub fn replace(&mut self, text: &str) -> Result<Database, EngineError> {
        if text.trim().is_empty() {
            self.0 = None;
            return Ok(Database::default());
        }
        let database = dbc::parse(NAME, text.as_bytes())?;
        self.0 = Some(database.clone());
        Ok(database)
    }

    /// Adds or changes a signal, and returns the database's text. `known` is what other databases say of the identifier: the user's
    /// message replaces it, so it begins with its signals.
    pub fn edit(&mut self, edit: &SignalEdit, known: Option<&Message>) -> Result<String, EngineError> {
        dbc_text::check_name(&edit.name)?;
        let fresh = edit.message()?;
        let mut database = self.0.clone().unwrap_or_default();
        let place = database.messages.iter().position(|message| message.id == fresh.id);
        let place = if let Some(place) = place {
            place
        } else {
            let known = known.filter(|known| known.container.is_none());
            database.messages.push(if let Some(known) = known {
                Message { id: fresh.id, ..known.clone() }
            } else {
                dbc_text::check_name(&edit.message_name)?;
                Message { signals: Vec::new(), ..fresh.clone() }
            });
            database.messages.len() - 1
        };
        let message = &mut database.messages[place];
        message.length = message.length.max(fresh.length);
        for signal in fresh.signals {
            match message.signals.iter_mut().find(|known| known.name == signal.name) {
                // What the edit does not say stays.
                Some(known) => {
                    *known = Signal {
                        description: std::mem::take(&mut known.description),
                        multiplexed: known.multiplexed.take(),
                        is_switch: known.is_switch,
                        min: known.min,
                        max: known.max,
                        ..signal
                    };
                }
                None => message.signals.push(signal),
            }
        }
        let text = dbc_text::write(&database);
        // What is saved is what is used: whatever the text cannot say is not in the picture either.
        self.replace(&text)?;
        Ok(text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn edit(name: &str, start_bit: u16, bit_length: u16) -> SignalEdit {
        SignalEdit {
            channel: 1,
            id: 0x123,
            extended: false,
            message_name: "Engine".to_owned(),
            name: name.to_owned(),
            start_bit,
            bit_length,
            little_endian: true,
            signed: false,
            factor: 0.5,
            offset: -40.0,
            unit: "°C".to_owned(),
            texts: vec![ValueText { value: 255.0, text: "say \"none\"".to_owned() }],
        }
    }

    #[test]
    fn signals_are_added_and_changed_and_the_text_says_what_they_are() {
        let mut own = OwnDatabase::default();
        own.edit(&edit("Temperature", 8, 8), None).unwrap();
        own.edit(&edit("Speed", 16, 16), None).unwrap();
        let text = own.edit(&edit("Temperature", 0, 8), None).unwrap();
        let database = dbc::parse("a.dbc", text.as_bytes()).unwrap();
        assert_eq!(database.warnings, []);
        let [message] = &database.messages[..] else { panic!("{text}") };
        let found: Vec<_> =
            message.signals.iter().map(|signal| (signal.name.as_str(), signal.start)).collect();
        assert_eq!((message.name.as_str(), found), ("Engine", vec![("Temperature", 0), ("Speed", 16)]));
        let [temperature, _] = &message.signals[..] else { panic!("{text}") };
        assert_eq!((temperature.factor, temperature.offset, temperature.unit.as_str()), (0.5, -40.0, "°C"));
        assert_eq!(temperature.values.text(255), Some("say 'none'"));
    }

    #[test]
    fn signals_that_cannot_be_are_refused_with_what_to_do() {
        let mut own = OwnDatabase::default();
        for (bad, text) in [
            (edit("", 0, 8), "name"),
            (edit("9a", 0, 8), "name"),
            (edit("a b", 0, 8), "name"),
            (edit("a", 0, 0), "1 to 64 bits"),
            (edit("a", 0, 65), "1 to 64 bits"),
            (edit("a", 512, 8), "outside"),
            (edit("a", 510, 8), "beyond"),
            (SignalEdit { factor: 0.0, ..edit("a", 0, 8) }, "factor"),
            (SignalEdit { id: 0x800, ..edit("a", 0, 8) }, "identifier"),
        ] {
            let error = own.edit(&bad, None).unwrap_err().to_string();
            assert!(error.contains(text), "{error}");
        }
        assert!(own.database().is_none());
    }
}
