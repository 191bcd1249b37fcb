//! Selects fields of events by name, for pictures and tables.

use cantap_signals::SelectionError;
use glob::Pattern;

use crate::canopen::drive::DriveState;
use crate::{Event, EventKind, Field, Protocol, Value, naming};

/// A node's state by its heartbeat, with [`MISSING`] while that is missing.
const NODE_STATE: &str = "nmt_state";
/// A drive's state (CiA 402) by its statusword, in the order of [`DriveState`].
const DRIVE_STATE: &str = "drive_state";
/// No heartbeat has this.
const MISSING: f64 = -1.0;

/// Names of fields as in [`naming`], with `*`, `?` and `[a-z]`: `j1939.engine_speed`, `obd.*`, `xcp.enginespeed`. States of CANopen's nodes and
/// drives, which events have in words, are `canopen.nmt_state` and `canopen.drive_state`.
#[derive(Clone, Debug, Default)]
pub struct FieldSelection {
    patterns: Vec<(Protocol, Pattern, String)>,
    /// Whether each of them has matched a value.
    matched: Vec<bool>,
}

/// A number in an event.
#[derive(Clone, Debug, PartialEq)]
pub struct FieldValue<'a> {
    /// The protocol, a dot, and the field: `j1939.engine_speed`.
    pub name: String,
    /// What tells it from others of that name: who said it to whom, the message, and those of its fields that say which of several things it is
    /// about, such as `did 0xF190` or `instance 1`. Always three.
    pub parts: [String; 3],
    /// Empty without one.
    pub unit: &'a str,
    /// Not a number where the message says that there is none.
    pub value: f64,
    /// What the value stands for.
    pub text: Option<&'a str>,
}

impl FieldSelection {
    /// Everything.
    pub fn all() -> Self {
        let patterns = Protocol::ALL
            .map(|protocol| (protocol, Pattern::new("*").unwrap_or_default(), format!("{protocol}.*")));
        Self { matched: vec![false; patterns.len()], patterns: patterns.into() }
    }

    /// Adds a name or pattern; false if it does not begin with a protocol and a dot, so that it names no field.
    pub fn add(&mut self, pattern: &str) -> Result<bool, SelectionError> {
        let Some((protocol, field)) = naming::parts_of_pattern(pattern) else { return Ok(false) };
        let compiled = Pattern::new(&field)
            .map_err(|source| SelectionError::Malformed { pattern: pattern.to_owned(), source })?;
        self.patterns.push((protocol, compiled, pattern.to_owned()));
        self.matched.push(false);
        Ok(true)
    }

    /// Whether nothing is selected.
    pub fn is_empty(&self) -> bool {
        self.patterns.is_empty()
    }

    /// The protocols in the names, each once.
    pub fn protocols(&self) -> Vec<Protocol> {
        let mut protocols: Vec<_> = self.patterns.iter().map(|(protocol, ..)| *protocol).collect();
        protocols.sort_unstable();
        protocols.dedup();
        protocols
    }

    /// The patterns that have matched no value yet.
    pub fn unmatched(&self) -> impl Iterator<Item = &str> {
        let all = self.patterns.iter().zip(&self.matched);
        all.filter(|(_, matched)| !**matched).map(|((.., text), _)| text.as_str())
    }

    /// All of an event's fields, each with its name: `j1939.engine_speed`.
    pub fn all_fields(event: &Event) -> Vec<(String, &Field)> {
        let named = naming::fields(event).into_iter();
        named.map(|(name, field)| (format!("{}.{name}", event.protocol), field)).collect()
    }

    /// The event's selected fields, each with its name: `j1939.engine_speed`.
    pub fn fields<'a>(&mut self, event: &'a Event) -> Vec<(String, &'a Field)> {
        let protocol = event.protocol;
        let chosen = self.chosen(event, |field| field.value != Value::Missing);
        chosen.into_iter().map(|(name, field)| (format!("{protocol}.{name}"), field)).collect()
    }

    /// The event's selected numbers.
    pub fn take<'a>(&mut self, event: &'a Event) -> Vec<FieldValue<'a>> {
        let mut values = self.states(event);
        let chosen = self.chosen(event, |field| field.value.as_number().is_some_and(f64::is_finite));
        if chosen.is_empty() {
            return values;
        }
        let number = |field: &Field| {
            if field.value == Value::Missing { Some(f64::NAN) } else { field.value.as_number() }
        };
        let all = naming::fields(event);
        let numbers = chosen.iter().filter_map(|(name, field)| Some((name, *field, number(field)?)));
        let value = |(name, field, value): (&String, &'a Field, f64)| FieldValue {
            name: format!("{}.{name}", event.protocol),
            parts: [format!("{} > {}", event.from, event.to), event.title.to_string(), which(&all, name)],
            unit: &field.unit,
            value,
            text: field.text.as_deref(),
        };
        values.extend(numbers.map(value));
        values
    }

    /// The selected fields with their names in plain form. A pattern has matched where `counts` is true.
    fn chosen<'a>(&mut self, event: &'a Event, counts: impl Fn(&Field) -> bool) -> Vec<(String, &'a Field)> {
        if !self.patterns.iter().any(|(protocol, ..)| *protocol == event.protocol) {
            return Vec::new();
        }
        let mut chosen = naming::fields(event);
        chosen.retain(|(name, field)| {
            self.selects(event.protocol, [name, &naming::plain(&field.name)], counts(field))
        });
        chosen
    }

    /// Whether one of these names is selected; `counts`: then what selects it has matched.
    fn selects(&mut self, of: Protocol, names: [&str; 2], counts: bool) -> bool {
        let mut is_selected = false;
        for ((protocol, pattern, _), matched) in self.patterns.iter().zip(&mut self.matched) {
            if *protocol == of && names.iter().any(|name| pattern.matches(name)) {
                is_selected = true;
                *matched |= counts;
            }
        }
        is_selected
    }

    /// The selected states that an event has in words.
    fn states<'a>(&mut self, event: &'a Event) -> Vec<FieldValue<'a>> {
        if event.protocol != Protocol::CanOpen {
            return Vec::new();
        }
        let drive =
            DriveState::in_event(event).map(|state| (DRIVE_STATE, f64::from(state as u8), state.name()));
        let states = [node_state(event), drive].into_iter().flatten();
        let of = event.node().map_or_else(String::new, |node| node.to_string());
        states
            .filter(|(name, ..)| self.selects(event.protocol, [name; 2], true))
            .map(|(name, value, text)| FieldValue {
                name: format!("{}.{name}", event.protocol),
                parts: [of.clone(), "state".to_owned(), String::new()],
                unit: "",
                value,
                text: Some(text),
            })
            .collect()
    }
}

/// The state of a node that an event is about.
fn node_state(event: &Event) -> Option<(&'static str, f64, &str)> {
    let state = event.data.first().map(|byte| f64::from(byte & 0x7F)).filter(|_| event.trouble.is_none());
    match event.kind {
        EventKind::State | EventKind::BootUp => Some((NODE_STATE, state?, &event.title)),
        EventKind::HeartbeatBack => Some((NODE_STATE, state?, event.title.rsplit(": ").next()?)),
        EventKind::HeartbeatMissing | EventKind::GuardMissing => Some((NODE_STATE, MISSING, &event.title)),
        _ => None,
    }
}

/// Which of several things a field is about.
fn which(fields: &[(String, &crate::Field)], of: &str) -> String {
    let keys = fields.iter().filter(|(name, field)| {
        name != of
            && naming::is_key(name)
            && field.value.as_number().is_some_and(|number| number.fract() == 0.0)
    });
    let keys: Vec<_> = keys.map(|(name, field)| format!("{name} {}", field.value)).collect();
    keys.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::at;
    use crate::{Options, Reader};

    fn values(patterns: &[&str], frames: &[(f64, &str)]) -> (Vec<String>, Vec<String>) {
        let mut selection = FieldSelection::default();
        for pattern in patterns {
            assert!(selection.add(pattern).unwrap());
        }
        let mut reader = Reader::new(Options { protocols: selection.protocols(), ..Options::default() });
        let mut events = Vec::new();
        for (ms, frame) in frames {
            reader.push(&at(*ms, frame), &mut events);
        }
        reader.finish(&mut events);
        let mut said = Vec::new();
        for event in &events {
            for FieldValue { name, parts, unit, value, text } in selection.take(event) {
                said.push(format!("{name} {value} {unit} {} [{}]", text.unwrap_or("-"), parts.join("; ")));
            }
        }
        (said, selection.unmatched().map(str::to_owned).collect())
    }

    #[test]
    fn numbers_are_selected_by_the_names_that_conditions_have() {
        let engine = [(0.0, "0CF00400#017DA06813FFF0FF"), (10.0, "0CF00401#017DA0FFFFFFF0FF")];
        let (said, unmatched) = values(&["j1939.engine_speed", "J1939.Engine_Starter*", "obd.*"], &engine);
        assert_eq!(
            said,
            [
                "j1939.engine_speed 621 rpm - [0 > all; EEC1 engine; ]",
                "j1939.engine_starter_mode 0  - [0 > all; EEC1 engine; ]",
                "j1939.engine_speed NaN  - [1 > all; EEC1 engine; ]",
                "j1939.engine_starter_mode 0  - [1 > all; EEC1 engine; ]",
            ]
        );
        assert_eq!(unmatched, ["obd.*"]);
    }

    /// Two identifiers of one ECU are not one curve.
    #[test]
    fn what_a_value_is_about_is_part_of_its_name() {
        let talk =
            [(0.0, "7E0#03221234"), (1.0, "7E8#0462123405"), (2.0, "7E0#03222345"), (3.0, "7E8#0462234506")];
        let (said, _) = values(&["uds.sid"], &talk);
        assert!(said[0].contains("did 0x1234") && said[1].contains("did 0x2345"), "{said:?}");
    }

    #[test]
    fn states_of_nodes_and_drives_are_numbers_with_texts() {
        let mut frames = vec![
            (0.0, "705#00"),
            (100.0, "705#7F"),
            // Statusword is mapped to the first TPDO.
            (110.0, "605#23001A0110004160"),
            (111.0, "585#60001A0100000000"),
            (112.0, "605#2F001A0001000000"),
            (113.0, "585#60001A0000000000"),
            (200.0, "705#05"),
            (210.0, "185#4002"),
            (220.0, "185#3706"),
            (300.0, "705#05"),
        ];
        frames.push((2000.0, "080#"));
        let (said, unmatched) = values(&["canopen.nmt_state", "canopen.drive_*"], &frames);
        assert_eq!(
            said,
            [
                "canopen.nmt_state 0  boot-up [5; state; ]",
                "canopen.nmt_state 127  pre-operational [5; state; ]",
                "canopen.nmt_state 5  operational [5; state; ]",
                "canopen.drive_state 1  switch on disabled [5; state; ]",
                "canopen.drive_state 4  operation enabled [5; state; ]",
                "canopen.nmt_state -1  heartbeat missing [5; state; ]",
            ]
        );
        assert_eq!(unmatched, Vec::<String>::new());
        let mut all = FieldSelection::all();
        let mut events = Vec::new();
        let mut reader = Reader::new(Options { protocols: vec![Protocol::CanOpen], ..Options::default() });
        reader.push(&at(0.0, "705#05"), &mut events);
        assert_eq!(all.take(&events[0]).len(), 1);
    }

    #[test]
    fn names_of_signals_are_not_fields() {
        let add = |pattern| FieldSelection::default().add(pattern);
        assert!(add("obd.*").unwrap() && add("XCP.Speed").unwrap());
        assert!(!add("Engine.Speed").unwrap() && !add("Speed").unwrap() && !add("uds.").unwrap());
        assert!(add("obd.[").is_err());
    }
}
