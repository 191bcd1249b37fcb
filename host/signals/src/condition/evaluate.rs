//! A condition bound to databases, evaluated record by record.

use crate::{Decoder, SignalValue};
use cantap_trace::TraceRecord;

use super::bind::{Bound, bind};
use super::error::ConditionError;
use super::expression::{Expression, Part, Slot, binary, byte_index, part_of, truth};
use super::listener::{ConditionEvent, Deaf, Listener, Listening};
use super::syntax::{self, Operator};

/// A condition, with the last values of the signals that it uses.
#[derive(Clone, Debug)]
pub struct Condition {
    expression: Expression,
    /// Knows only the condition's signals.
    decoder: Decoder,
    slots: Vec<Slot>,
    /// Whether it refers to the frame itself.
    about_frames: bool,
    values: Vec<SignalValue>,
    concerned: bool,
    /// For names that a listener knows; `None` if there are none.
    listening: Option<Listening>,
}

impl Condition {
    /// Parses a condition; its signals come from the decoder's databases.
    pub fn new(text: &str, decoder: &Decoder) -> Result<Self, ConditionError> {
        Self::with_listener(text, decoder, Box::new(Deaf))
    }

    /// The same, also with the listener's names. Signals take precedence over them.
    pub fn with_listener(
        text: &str,
        decoder: &Decoder,
        mut listener: Box<dyn Listener>,
    ) -> Result<Self, ConditionError> {
        let tree = syntax::parse(text)?;
        let bound = bind(text, &tree, decoder, &mut *listener).map_err(|(at, fault)| {
            let text = text.to_owned();
            ConditionError { text, at, fault }
        })?;
        let Bound { expression, slots, about_frames, names } = bound;
        let names: Vec<_> = names.into_iter().map(|name| (name, false)).collect();
        let listening = (!names.is_empty()).then(|| Listening { listener, names, matched: Vec::new() });
        let mut own = decoder.clone();
        own.retain(|message, index, _| {
            slots.iter().any(|slot| slot.candidates.contains(&(message, index as u32)))
        });
        // A condition without names is evaluated for every record.
        let about_frames = about_frames || slots.is_empty() && listening.is_none();
        let (values, concerned) = (Vec::new(), false);
        Ok(Self { expression, decoder: own, slots, about_frames, values, concerned, listening })
    }

    /// Takes a record and returns whether the condition holds now, as far as this record is relevant to it.
    pub fn holds(&mut self, record: &TraceRecord) -> bool {
        self.concerned = self.update(record) || self.about_frames;
        let holds = self.concerned && self.is_true(record, None);
        let Some(mut listening) = self.listening.take() else { return holds };
        let Listening { listener, names, matched } = &mut listening;
        matched.clear();
        let mut any_event = false;
        listener.take(record, &mut |event| {
            any_event = true;
            for (name, occurred) in names.iter_mut().filter(|(_, occurred)| !occurred) {
                *occurred = event.has(name) == Some(true);
            }
            let event = NamedEvent { event, names };
            if self.is_true(record, Some(&event)) {
                matched.push(event.event.describe());
            }
        });
        let holds = holds || !matched.is_empty();
        self.concerned |= any_event;
        self.listening = Some(listening);
        holds
    }

    fn is_true(&self, record: &TraceRecord, event: Option<&NamedEvent<'_>>) -> bool {
        truth(self.evaluate(&self.expression, record, event)) == Some(true)
    }

    /// Whether it refers to the frame itself, or to what frames say together, rather than to signals alone.
    pub fn is_about_frames(&self) -> bool {
        self.about_frames || self.listening.is_some()
    }

    /// The listener's events of the last record taken by [`Self::holds`] that made the condition hold; one
    /// line each.
    pub fn matched_events(&self) -> &[String] {
        self.listening.as_ref().map_or(&[], |listening| &listening.matched)
    }

    /// The listener's names in the condition that no event has had so far: perhaps they do not exist.
    pub fn names_without_events(&self) -> impl Iterator<Item = &str> {
        let names = self.listening.iter().flat_map(|listening| &listening.names);
        names.filter(|(_, occurred)| !occurred).map(|(name, _)| name.as_str())
    }

    /// Whether the last record taken by [`Self::holds`] is relevant to the condition: it carries one of its
    /// signals, or the condition refers to the frame itself.
    pub fn was_concerned(&self) -> bool {
        self.concerned
    }

    /// Remembers the record's signals; returns whether there were any.
    fn update(&mut self, record: &TraceRecord) -> bool {
        let Some(frame) = record.frame().filter(|_| !self.slots.is_empty()) else { return false };
        let Some(message) = self.decoder.decode(record.channel, frame, &mut self.values) else {
            return false;
        };
        for value in &self.values {
            let arrived = (message, value.signal);
            for slot in &mut self.slots {
                if let Some(candidate) = slot.candidates.iter().position(|&candidate| candidate == arrived) {
                    slot.last = Some((candidate, value.raw, value.value));
                }
            }
        }
        !self.values.is_empty()
    }

    fn evaluate(
        &self,
        expression: &Expression,
        record: &TraceRecord,
        event: Option<&NamedEvent<'_>>,
    ) -> Option<f64> {
        let boolean = |truth: bool| Some(f64::from(u8::from(truth)));
        match expression {
            Expression::Number(value) => Some(*value),
            Expression::Part(part) => match event {
                Some(event) if matches!(part, Part::Channel) => Some(event.event.channel().into()),
                // An event that ends because nothing came is reported with an unrelated frame.
                Some(event) if !event.event.is_completed_by(record) => None,
                _ => part_of(*part, record),
            },
            Expression::Byte(_) if event.is_some_and(|event| !event.event.is_completed_by(record)) => None,
            Expression::Byte(index) => {
                let index = byte_index(self.evaluate(index, record, event)?)?;
                record.frame()?.data().get(index).copied().map(f64::from)
            }
            Expression::Signal(slot) => self.slots[*slot].last.map(|(_, _, value)| value),
            Expression::Message(_) if event.is_some_and(|event| !event.event.is_completed_by(record)) => None,
            Expression::Message(messages) => {
                let message = self.decoder.find(record.channel, record.frame()?.id());
                boolean(message.is_some_and(|message| messages.contains(&message)))
            }
            Expression::HasText(slot, raws) => {
                let (candidate, raw, _) = self.slots[*slot].last?;
                let (message, index) = self.slots[*slot].candidates[candidate];
                let signal = &self.decoder.message(message).signals[index as usize];
                boolean(signal.table_key(raw).is_some_and(|key| raws[candidate].contains(&key)))
            }
            Expression::Field(name) => event?.numbers(*name).first().copied(),
            Expression::HasField(name) => boolean(event?.has(*name)?),
            Expression::AnySaid(name, operator, other, is_left) => {
                let (event, other) = (event?, self.evaluate(other, record, event)?);
                let numbers = event.numbers(*name);
                let compare = |number: f64| {
                    let (left, right) = if *is_left { (number, other) } else { (other, number) };
                    truth(binary(*operator, left, right))
                };
                if numbers.is_empty() {
                    None
                } else {
                    boolean(numbers.iter().any(|number| compare(*number) == Some(true)))
                }
            }
            Expression::FieldText(name, text) => boolean(event?.is_text(*name, text)?),
            Expression::Not(inner) => boolean(!truth(self.evaluate(inner, record, event))?),
            Expression::Negative(inner) => self.evaluate(inner, record, event).map(|value| -value),
            Expression::Binary(operator, left, right) => {
                let left = self.evaluate(left, record, event);
                // One side may decide the result on its own.
                match (operator, truth(left)) {
                    (Operator::And, Some(false)) => return boolean(false),
                    (Operator::Or, Some(true)) => return boolean(true),
                    _ => {}
                }
                let right = self.evaluate(right, record, event);
                match (operator, truth(right)) {
                    (Operator::And, Some(false)) => return boolean(false),
                    (Operator::Or, Some(true)) => return boolean(true),
                    _ => {}
                }
                binary(*operator, left?, right?)
            }
        }
    }
}

/// An event's values, in the order of the condition's names.
struct NamedEvent<'a> {
    event: &'a dyn ConditionEvent,
    names: &'a [(String, bool)],
}

impl NamedEvent<'_> {
    fn numbers(&self, name: usize) -> Vec<f64> {
        let mut numbers = Vec::new();
        self.event.numbers(&self.names[name].0, &mut |number| numbers.push(number));
        numbers
    }

    fn has(&self, name: usize) -> Option<bool> {
        self.event.has(&self.names[name].0)
    }

    fn is_text(&self, name: usize, text: &str) -> Option<bool> {
        self.event.is_text(&self.names[name].0, text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Source, dbc};
    use cantap_trace::{Direction, TraceEvent};

    const DATABASE: &str = "BO_ 1 Engine: 8 A\n SG_ Speed : 0|8@1+ (1,0) [0|0] \"\" A\n SG_ F : 32|32@1+ (1,0) [0|0] \"\" A\n\
        BO_ 2 Box: 8 A\n SG_ Gear : 0|8@1+ (1,0) [0|0] \"\" A\n SG_ Speed : 8|8@1+ (1,0) [0|0] \"\" A\n\
        VAL_ 2 Gear 3 \"Drive\" 0 \"Not available\" ;\nSIG_VALTYPE_ 1 F : 1;\n";

    fn decoder() -> Decoder {
        let database = dbc::parse("x.dbc", DATABASE.as_bytes()).unwrap();
        Decoder::new(vec![Source { channel: None, database }])
    }

    fn record(event: TraceEvent) -> TraceRecord {
        TraceRecord { time_ns: 0, device_ns: None, channel: 1, event }
    }

    fn frame(text: &str) -> TraceRecord {
        record(TraceEvent::Frame { frame: text.parse().unwrap(), direction: Direction::Rx, late: false })
    }

    /// Once, the frames with 0x85 were shown to whoever had copied the identifier 133.
    #[test]
    fn an_identifier_without_0x_is_not_guessed() {
        for (text, wrong) in [("id == 133", true), ("133 != id", true), ("id >= 100 and id < 0x200", true)] {
            let error = Condition::new(text, &decoder()).map(drop);
            assert_eq!(error.is_err(), wrong, "{text}");
        }
        let error = Condition::new("id == 133", &decoder()).map(drop).unwrap_err().to_string();
        let expected =
            "write 0x133 for the one that is shown as 133, or 0x85 for the one that is 133 in decimal digits";
        assert!(error.contains(expected), "{error}");
        for text in
            ["id == 0x133", "id == 9", "id == 419361024", "id & 15 == 3", "pgn == 61444", "Speed == 133"]
        {
            assert!(Condition::new(text, &decoder()).is_ok(), "{text}");
        }
    }

    /// A trigger waited for ever for a difference of two identifiers.
    #[test]
    fn what_can_never_be_is_refused() {
        for (text, says) in [
            ("id == 0x100-0x1FF", "a range of identifiers is written id >= 0x100 and id <= 0x1FF"),
            ("0x100-0x1FF != id", "id >= 0x100 and id <= 0x1FF"),
            ("id == 0x20000000", "an identifier is from 0x0 to 0x1FFFFFFF"),
            ("id == -5", "an identifier is from"),
            ("dlc == 99", "a DLC is from 0 to 15"),
            ("len == 2.5", "a frame's length is from 0 to 64"),
            ("ch == 256", "a channel's number is from 0 to 255"),
        ] {
            let error = Condition::new(text, &decoder()).map(drop).unwrap_err().to_string();
            assert!(error.contains(says), "{text}: {error}");
        }
        for text in ["id - 0x100 == 5", "id == 0x700 + byte[0]", "dlc > 99", "ch == 1 + 1"] {
            assert!(Condition::new(text, &decoder()).is_ok(), "{text}");
        }
    }

    /// The frames at which the condition holds.
    fn hits(condition: &str, frames: &[&str]) -> Vec<usize> {
        let mut condition = Condition::new(condition, &decoder()).unwrap();
        (0..frames.len()).filter(|&at| condition.holds(&frame(frames[at]))).collect()
    }

    const FRAMES: &[&str] = &["002#0350", "001#51", "123#80", "001#50", "002#00", "001#60", "001#"];

    #[test]
    fn signals_of_several_messages_keep_their_last_value() {
        assert_eq!(hits("Engine.Speed > 80 and Gear == 3", FRAMES), [1]);
        assert_eq!(hits("Engine.Speed > 80 and Gear == Drive", FRAMES), [1]);
        assert_eq!(hits("'Not available' == Gear and Engine.Speed == 0x60", FRAMES), [5]);
        assert_eq!(hits("Gear != drive", FRAMES), [4]);
        assert_eq!(hits("Speed == 80", FRAMES), [0, 3], "of either message, the last one");
        assert_eq!(hits("not Engine.Speed > 80", FRAMES), [3], "before the first frame it is not known");
    }

    #[test]
    fn a_message_s_name_is_true_for_its_frames() {
        assert_eq!(hits("Engine", FRAMES), [1, 3, 5, 6]);
        assert_eq!(hits("Box and byte[1] == 0x50 or Engine and len == 0", FRAMES), [0, 6]);
        assert_eq!(hits("not Engine", FRAMES), [0, 2, 4]);
        assert_eq!(hits("Engine and len == 1 and Engine.Speed > 80", FRAMES), [1, 5]);
        assert_eq!(
            hits("msg:Engine and len == 1 or msg:Box", FRAMES),
            hits("Engine and len == 1 or Box", FRAMES)
        );
        for (text, part) in [
            ("Engin", "did you mean Engine?"),
            ("msg:Engin and len > 0", "did you mean Engine?"),
            ("msg:", "there is no signal or message \"msg:\""),
            ("msg:Speed", "there is no signal or message \"msg:Speed\""),
        ] {
            let unknown = Condition::new(text, &decoder()).unwrap_err().to_string();
            assert!(unknown.contains(part), "{text}: {unknown}");
        }
    }

    #[test]
    fn parts_of_the_frame_are_looked_at_for_every_record() {
        assert_eq!(hits("id == 0x123 and byte[0] & 0x80 and ch == 1", FRAMES), [2]);
        assert_eq!(hits("byte[1] != 0", FRAMES), [0], "a byte that is not there is neither equal nor not");
        assert_eq!(hits("len == 0 or byte[0] / 2 > 0x30", FRAMES), [2, 6]);
        assert_eq!(hits("ext or rtr", &["00000001#", "001#R", "001#"]), [0, 1]);
        assert_eq!(hits("pgn == 61444", &["0CF00400#", "18F00427#", "0CF00500#", "004#"]), [0, 1]);
        assert_eq!(hits("dlc == 9", &["001#1122334455667788_9"]), [0]);
        assert_eq!(hits("byte[0 - len] == 1 or byte[len / 2] == 1", &["001#01"]), [] as [usize; 0]);
        assert_eq!(
            hits("byte[0] / (len - 1) > 1 or byte[0] % (len - 1) >= 0", &["001#02"]),
            [] as [usize; 0]
        );
    }

    #[test]
    fn errors_and_losses_can_be_waited_for() {
        let mut condition = Condition::new("error or lost", &Decoder::new(Vec::new())).unwrap();
        assert!(condition.holds(&record(TraceEvent::BusError { kind: None, counters: None })));
        assert!(condition.holds(&record(TraceEvent::Lost { stage: None, count: 1, at_least: false })));
        assert!(!condition.holds(&record(TraceEvent::UNCOUNTED)));
        assert!(!condition.holds(&frame("001#")));
    }

    #[test]
    fn not_a_number_is_unknown() {
        let nan = &["001#000000000000C07F"];
        assert_eq!(hits("F == F or F != F or not F or F", nan), [] as [usize; 0]);
        assert_eq!(hits("F > 1 or Speed == 0", nan), [0]);
        assert_eq!(hits("Speed / 0 > 1 or Speed % 0 == 0", &["001#01"]), [] as [usize; 0]);
    }

    #[test]
    fn names_that_are_nothing_are_explained() {
        for (text, expected) in [
            ("Sped > 1", "there is no signal or message \"Sped\"; did you mean Speed?\n  Sped > 1\n  ^"),
            (
                "Gear == Driv",
                "Gear has no value \"Driv\"; it has Not available, Drive\n  Gear == Driv\n          ^",
            ),
            ("Engine.Speed == Fast", "Engine.Speed has no value \"Fast\"\n"),
            (
                "byte[-1] == 1",
                "a frame has no byte -1; bytes are counted from 0 to 7, in CAN FD to 63\n  byte[-1] == 1\n       ^",
            ),
            ("byte[1 + 0.5] == 1", "a frame has no byte 1.5; "),
            ("byte[64] == 1", "a frame has no byte 64; "),
            (
                "7E8",
                "a number is to be compared with something; frames with that identifier are id == 0x7E8\n  7E8\n  ^",
            ),
            (
                "Speed and 0x3",
                "a number is to be compared with something; frames with that identifier are id == 0x3\n",
            ),
            ("not 1.5", "a number is to be compared with something\n  not 1.5\n      ^"),
            ("'Drive' > 1", "a text can only be compared with a signal, by == or !=\n  'Drive' > 1\n  ^"),
        ] {
            let error = Condition::new(text, &decoder()).unwrap_err().to_string();
            assert!(error.starts_with(expected), "{error}");
        }
        let error = Condition::new("Speed > 1", &Decoder::new(Vec::new())).unwrap_err().to_string();
        assert!(error.contains("without a database there are neither signals nor messages\n"), "{error}");
    }
}
