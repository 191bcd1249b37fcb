//! A condition bound to databases, evaluated record by record.

use crate::{Decoder, MessageRef, Signal, SignalValue, Suggestion};
use cantap_trace::fd::FD_MAX_BYTES;
use cantap_trace::{TraceEvent, TraceRecord};

use super::error::{ConditionError, ConditionFault};
use super::listener::{Deaf, Listener, Listening, Said};
use super::syntax::{self, Kind, Node, Operator};

/// A condition, with the last values of the signals it speaks of.
#[derive(Clone, Debug)]
pub struct Condition {
    expression: Expression,
    /// Knows the condition's signals only.
    decoder: Decoder,
    slots: Vec<Slot>,
    /// Whether it speaks of the frame itself.
    about_frames: bool,
    values: Vec<SignalValue>,
    concerned: bool,
    /// For names that a listener knows; none without them.
    listening: Option<Listening>,
}

/// A signal that the condition names. The same name may stand for signals of several messages.
#[derive(Clone, Debug)]
struct Slot {
    name: String,
    candidates: Vec<(MessageRef, u32)>,
    /// The last value: which candidate, raw and physical.
    last: Option<(usize, u64, f64)>,
}

#[derive(Clone, Copy, Debug)]
enum Part {
    Id,
    Channel,
    Dlc,
    Length,
    Extended,
    Remote,
    Error,
    Lost,
}

#[derive(Clone, Debug)]
enum Expression {
    Number(f64),
    Part(Part),
    Byte(Box<Expression>),
    Signal(usize),
    /// Whether a signal's value has a text: for each candidate the raw values with that text.
    HasText(usize, Vec<Vec<i64>>),
    /// The first value of a listener's name, by its place among the names.
    Said(usize),
    /// Whether there is a value of it.
    IsSaid(usize),
    /// Whether one of its values compares so with the other side; `true` if the name is on the left.
    AnySaid(usize, Operator, Box<Expression>, bool),
    /// Whether one of its values is this text.
    SaidText(usize, String),
    Not(Box<Expression>),
    Negative(Box<Expression>),
    Binary(Operator, Box<Expression>, Box<Expression>),
}

fn part(name: &str) -> Option<Part> {
    Some(match name.to_ascii_lowercase().as_str() {
        "id" => Part::Id,
        "ch" | "channel" => Part::Channel,
        "dlc" => Part::Dlc,
        "len" => Part::Length,
        "ext" => Part::Extended,
        "rtr" => Part::Remote,
        "error" => Part::Error,
        "lost" => Part::Lost,
        _ => return None,
    })
}

impl Condition {
    /// Parses a condition; its signals are those of the decoder's databases.
    pub fn new(text: &str, decoder: &Decoder) -> Result<Self, ConditionError> {
        Self::with_listener(text, decoder, Box::new(Deaf))
    }

    /// The same, with the listener's names beside signals, which go before them.
    pub fn with_listener(
        text: &str,
        decoder: &Decoder,
        mut listener: Box<dyn Listener>,
    ) -> Result<Self, ConditionError> {
        let tree = syntax::parse(text)?;
        let mut binder = Binder {
            decoder,
            slots: Vec::new(),
            about_frames: false,
            listener: &mut *listener,
            names: Vec::new(),
        };
        let expression = binder.truth(&tree).map_err(|(at, fault)| {
            let text = text.to_owned();
            ConditionError { text, at, fault }
        })?;
        let Binder { slots, about_frames, names, .. } = binder;
        let names: Vec<_> = names.into_iter().map(|name| (name, false)).collect();
        let listening = (!names.is_empty()).then(|| Listening { listener, names, matched: Vec::new() });
        let mut own = decoder.clone();
        own.retain(|message, index, _| {
            slots.iter().any(|slot| slot.candidates.contains(&(message, index as u32)))
        });
        // A condition without names is looked at for every record.
        let about_frames = about_frames || slots.is_empty() && listening.is_none();
        let (values, concerned) = (Vec::new(), false);
        Ok(Self { expression, decoder: own, slots, about_frames, values, concerned, listening })
    }

    /// Takes a record and says whether the condition holds now, as far as this record has to do
    /// with it.
    pub fn holds(&mut self, record: &TraceRecord) -> bool {
        self.concerned = self.update(record) || self.about_frames;
        let holds = self.concerned && self.is_true(record, None);
        let Some(mut listening) = self.listening.take() else { return holds };
        let Listening { listener, names, matched } = &mut listening;
        matched.clear();
        let mut was_said = false;
        listener.take(record, &mut |said| {
            was_said = true;
            for (name, was_heard) in names.iter_mut().filter(|(_, was_heard)| !was_heard) {
                *was_heard = said.has(name) == Some(true);
            }
            let said = Heard { said, names };
            if self.is_true(record, Some(&said)) {
                matched.push(said.said.describe());
            }
        });
        let holds = holds || !matched.is_empty();
        self.concerned |= was_said;
        self.listening = Some(listening);
        holds
    }

    fn is_true(&self, record: &TraceRecord, said: Option<&Heard<'_>>) -> bool {
        truth(self.evaluate(&self.expression, record, said)) == Some(true)
    }

    /// Whether it speaks of the frame itself, or of what frames say together, and not of signals alone.
    pub fn is_about_frames(&self) -> bool {
        self.about_frames || self.listening.is_some()
    }

    /// What was said with the record that [`Self::holds`] took last, and made the condition hold; a line each.
    pub fn said(&self) -> &[String] {
        self.listening.as_ref().map_or(&[], |listening| &listening.matched)
    }

    /// The listener's names in the condition that no event had so far: perhaps there are none such.
    pub fn unheard(&self) -> impl Iterator<Item = &str> {
        let names = self.listening.iter().flat_map(|listening| &listening.names);
        names.filter(|(_, was_heard)| !was_heard).map(|(name, _)| name.as_str())
    }

    /// Whether the record that [`Self::holds`] took last has to do with the condition: it carries one of
    /// its signals, or the condition speaks of the frame itself.
    pub fn was_concerned(&self) -> bool {
        self.concerned
    }

    /// Remembers the record's signals; whether there were any.
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
        said: Option<&Heard<'_>>,
    ) -> Option<f64> {
        let boolean = |truth: bool| Some(f64::from(u8::from(truth)));
        match expression {
            Expression::Number(value) => Some(*value),
            Expression::Part(part) => match said {
                Some(heard) if matches!(part, Part::Channel) => Some(heard.said.channel().into()),
                // What ends because nothing came is said with a frame that it has nothing to do with.
                Some(heard) if !heard.said.is_completed_by(record) => None,
                _ => part_of(*part, record),
            },
            Expression::Byte(_) if said.is_some_and(|heard| !heard.said.is_completed_by(record)) => None,
            Expression::Byte(index) => {
                let index = byte_index(self.evaluate(index, record, said)?)?;
                record.frame()?.data().get(index).copied().map(f64::from)
            }
            Expression::Signal(slot) => self.slots[*slot].last.map(|(_, _, value)| value),
            Expression::HasText(slot, raws) => {
                let (candidate, raw, _) = self.slots[*slot].last?;
                let (message, index) = self.slots[*slot].candidates[candidate];
                let signal = &self.decoder.message(message).signals[index as usize];
                boolean(signal.table_key(raw).is_some_and(|key| raws[candidate].contains(&key)))
            }
            Expression::Said(name) => said?.numbers(*name).first().copied(),
            Expression::IsSaid(name) => boolean(said?.has(*name)?),
            Expression::AnySaid(name, operator, other, is_left) => {
                let (heard, other) = (said?, self.evaluate(other, record, said)?);
                let numbers = heard.numbers(*name);
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
            Expression::SaidText(name, text) => boolean(said?.is_text(*name, text)?),
            Expression::Not(inner) => boolean(!truth(self.evaluate(inner, record, said))?),
            Expression::Negative(inner) => self.evaluate(inner, record, said).map(|value| -value),
            Expression::Binary(operator, left, right) => {
                let left = self.evaluate(left, record, said);
                // One side may decide alone, whatever the other is.
                match (operator, truth(left)) {
                    (Operator::And, Some(false)) => return boolean(false),
                    (Operator::Or, Some(true)) => return boolean(true),
                    _ => {}
                }
                let right = self.evaluate(right, record, said);
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

/// An event, by the places of the condition's names.
struct Heard<'a> {
    said: &'a dyn Said,
    names: &'a [(String, bool)],
}

impl Heard<'_> {
    fn numbers(&self, name: usize) -> Vec<f64> {
        let mut numbers = Vec::new();
        self.said.numbers(&self.names[name].0, &mut |number| numbers.push(number));
        numbers
    }

    fn has(&self, name: usize) -> Option<bool> {
        self.said.has(&self.names[name].0)
    }

    fn is_text(&self, name: usize, text: &str) -> Option<bool> {
        self.said.is_text(&self.names[name].0, text)
    }
}

/// The value of what depends on no record.
fn constant(expression: &Expression) -> Option<f64> {
    match expression {
        Expression::Number(value) => Some(*value),
        Expression::Negative(inner) => constant(inner).map(|value| -value),
        Expression::Binary(operator, left, right) => binary(*operator, constant(left)?, constant(right)?),
        _ => None,
    }
}

/// The place of a data byte, if there can be a byte at it.
fn byte_index(value: f64) -> Option<usize> {
    const MOST: f64 = (FD_MAX_BYTES - 1) as f64;
    (value.fract() == 0.0 && (0.0..=MOST).contains(&value)).then_some(value as usize)
}

/// Not-a-number is as unknown as nothing at all.
fn truth(value: Option<f64>) -> Option<bool> {
    value.filter(|value| !value.is_nan()).map(|value| value != 0.0)
}

#[expect(clippy::float_cmp, reason = "a user who writes == means it")]
fn binary(operator: Operator, left: f64, right: f64) -> Option<f64> {
    if left.is_nan() || right.is_nan() {
        return None;
    }
    let boolean = |truth: bool| Some(f64::from(u8::from(truth)));
    match operator {
        // Decided before, unless both are true or both are false.
        Operator::And => boolean(true),
        Operator::Or => boolean(false),
        Operator::Equal => boolean(left == right),
        Operator::NotEqual => boolean(left != right),
        Operator::Less => boolean(left < right),
        Operator::LessOrEqual => boolean(left <= right),
        Operator::Greater => boolean(left > right),
        Operator::GreaterOrEqual => boolean(left >= right),
        Operator::BitOr => Some((left as i64 | right as i64) as f64),
        Operator::BitAnd => Some((left as i64 & right as i64) as f64),
        Operator::Add => Some(left + right),
        Operator::Subtract => Some(left - right),
        Operator::Multiply => Some(left * right),
        Operator::Divide | Operator::Remainder if right == 0.0 => None,
        Operator::Divide => Some(left / right),
        Operator::Remainder => Some(left % right),
    }
}

fn part_of(part: Part, record: &TraceRecord) -> Option<f64> {
    let flag = |flag: bool| Some(f64::from(u8::from(flag)));
    match part {
        Part::Channel => return Some(record.channel.into()),
        Part::Error => return flag(matches!(record.event, TraceEvent::BusError { .. })),
        Part::Lost => return flag(matches!(record.event, TraceEvent::Lost { .. })),
        _ => {}
    }
    let frame = record.frame()?;
    match part {
        Part::Id => Some(frame.id().raw().into()),
        Part::Dlc => Some(frame.dlc().into()),
        Part::Length => Some(frame.data_len() as f64),
        Part::Extended => flag(frame.id().is_extended()),
        Part::Remote => flag(frame.is_remote()),
        Part::Channel | Part::Error | Part::Lost => None,
    }
}

struct Binder<'a> {
    decoder: &'a Decoder,
    slots: Vec<Slot>,
    about_frames: bool,
    listener: &'a mut dyn Listener,
    /// Of the listener's.
    names: Vec<String>,
}

type Fault = (usize, ConditionFault);

impl Binder<'_> {
    /// What is asked whether it is true: there a listener's name alone asks whether it was said.
    fn truth(&mut self, node: &Node) -> Result<Expression, Fault> {
        Ok(match self.bind(node)? {
            Expression::Said(name) => Expression::IsSaid(name),
            other => other,
        })
    }

    fn bind(&mut self, node: &Node) -> Result<Expression, Fault> {
        Ok(match &node.kind {
            Kind::Number(value) => Expression::Number(*value),
            Kind::Text(_) => return Err((node.at, ConditionFault::LoneText)),
            Kind::Name(name) => self.name(node.at, name)?,
            Kind::Byte(index) => {
                self.about_frames = true;
                let bound = self.bind(index)?;
                if let Some(value) = constant(&bound).filter(|value| byte_index(*value).is_none()) {
                    return Err((index.at, ConditionFault::ByteIndex(value.to_string())));
                }
                Expression::Byte(bound.into())
            }
            Kind::Not(inner) => Expression::Not(self.truth(inner)?.into()),
            Kind::Binary(operator @ (Operator::And | Operator::Or), left, right) => {
                Expression::Binary(*operator, self.truth(left)?.into(), self.truth(right)?.into())
            }
            Kind::Negative(inner) => Expression::Negative(self.bind(inner)?.into()),
            Kind::Binary(operator @ (Operator::Equal | Operator::NotEqual), left, right) => {
                match self.text_comparison(left, right)? {
                    Some(has_text) if *operator == Operator::Equal => has_text,
                    Some(has_text) => Expression::Not(has_text.into()),
                    None => self.comparison(*operator, left, right)?,
                }
            }
            Kind::Binary(operator, left, right) => self.comparison(*operator, left, right)?,
        })
    }

    /// Of what was said several times, one is enough.
    fn comparison(&mut self, operator: Operator, left: &Node, right: &Node) -> Result<Expression, Fault> {
        let (left, right) = (self.bind(left)?, self.bind(right)?);
        let compares = matches!(
            operator,
            Operator::Equal
                | Operator::NotEqual
                | Operator::Less
                | Operator::LessOrEqual
                | Operator::Greater
                | Operator::GreaterOrEqual
        );
        Ok(match (left, right) {
            (Expression::Said(name), right) if compares => {
                Expression::AnySaid(name, operator, right.into(), true)
            }
            (left, Expression::Said(name)) if compares => {
                Expression::AnySaid(name, operator, left.into(), false)
            }
            (left, right) => Expression::Binary(operator, left.into(), right.into()),
        })
    }

    fn name(&mut self, at: usize, name: &str) -> Result<Expression, Fault> {
        if let Some(slot) = self.slot(name) {
            return Ok(Expression::Signal(slot));
        }
        if let Some(part) = part(name) {
            self.about_frames = true;
            return Ok(Expression::Part(part));
        }
        if let Some(said) = self.said(name) {
            return Ok(Expression::Said(said));
        }
        if self.decoder.signals().next().is_none() {
            return Err((at, ConditionFault::NoDatabase(name.to_owned())));
        }
        let near =
            Suggestion::nearest(name, self.decoder.signals().map(|(_, _, signal)| signal.name.as_str()));
        Err((at, ConditionFault::UnknownName { name: name.to_owned(), near }))
    }

    /// The slot of a signal, if there is one of that name. Parts of the frame go before signals.
    fn slot(&mut self, name: &str) -> Option<usize> {
        if let Some(slot) = self.slots.iter().position(|slot| slot.name == name) {
            return Some(slot);
        }
        if part(name).is_some() {
            return None;
        }
        let decoder = self.decoder;
        let named = |(message, index, signal): (MessageRef, usize, &Signal)| {
            let same = match name.split_once('.') {
                Some((of, name)) => decoder.message(message).name == of && signal.name == name,
                None => signal.name == name,
            };
            same.then_some((message, index as u32))
        };
        let candidates: Vec<_> = decoder.signals().filter_map(named).collect();
        if candidates.is_empty() {
            return None;
        }
        self.slots.push(Slot { name: name.to_owned(), candidates, last: None });
        Some(self.slots.len() - 1)
    }

    /// The place of a listener's name, if it is one.
    fn said(&mut self, name: &str) -> Option<usize> {
        let known = self.names.iter().position(|known| known == name);
        known.or_else(|| {
            self.listener.knows(name).then(|| {
                self.names.push(name.to_owned());
                self.names.len() - 1
            })
        })
    }

    /// `Signal == text`, either way round; `None` if neither side is a text.
    fn text_comparison(&mut self, left: &Node, right: &Node) -> Result<Option<Expression>, Fault> {
        for (signal, text) in [(left, right), (right, left)] {
            let (wanted, quoted) = match &text.kind {
                Kind::Text(wanted) => (wanted, true),
                Kind::Name(wanted) => (wanted, false),
                _ => continue,
            };
            let Kind::Name(name) = &signal.kind else { continue };
            let slot = self.slot(name);
            let said = if slot.is_none() && part(name).is_none() { self.said(name) } else { None };
            // Without quotes it may also be another signal, or nothing at all.
            let is_value =
                self.slot(wanted).is_some() || part(wanted).is_some() || self.said(wanted).is_some();
            if slot.is_none() && said.is_none() || !quoted && is_value {
                continue;
            }
            let Some(slot) = slot else {
                return Ok(said.map(|said| Expression::SaidText(said, wanted.clone())));
            };
            let decoder = self.decoder;
            let signals = self.slots[slot].candidates.iter();
            let signals = signals.map(|&(message, index)| &decoder.message(message).signals[index as usize]);
            let raws: Vec<_> = signals.clone().map(|signal| signal.values.values(wanted)).collect();
            if raws.iter().all(Vec::is_empty) {
                let texts: Vec<_> =
                    signals.flat_map(|signal| signal.values.iter().map(|(_, text)| text)).collect();
                let choices =
                    if texts.is_empty() { String::new() } else { format!("; it has {}", texts.join(", ")) };
                let (signal, wanted) = (name.clone(), wanted.clone());
                return Err((text.at, ConditionFault::UnknownText { signal, text: wanted, choices }));
            }
            return Ok(Some(Expression::HasText(slot, raws)));
        }
        Ok(None)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Source, dbc};
    use cantap_trace::Direction;

    const DATABASE: &str = "BO_ 1 Engine: 8 A\n SG_ Speed : 0|8@1+ (1,0) [0|0] \"\" A\n SG_ F : 32|32@1+ (1,0) [0|0] \"\" A\n\
        BO_ 2 Box: 8 A\n SG_ Gear : 0|8@1+ (1,0) [0|0] \"\" A\n SG_ Speed : 8|8@1+ (1,0) [0|0] \"\" A\n\
        VAL_ 2 Gear 3 \"Drive\" 0 \"Not available\" ;\nSIG_VALTYPE_ 1 F : 1;\n";

    fn decoder() -> Decoder {
        let database = dbc::parse("x.dbc", DATABASE.as_bytes()).unwrap();
        Decoder::new(vec![Source { channel: None, database }])
    }

    fn record(event: TraceEvent) -> TraceRecord {
        TraceRecord { time_ns: 0, channel: 1, event }
    }

    fn frame(text: &str) -> TraceRecord {
        record(TraceEvent::Frame { frame: text.parse().unwrap(), direction: Direction::Rx, late: false })
    }

    /// At which of the frames the condition holds.
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
    fn parts_of_the_frame_are_looked_at_for_every_record() {
        assert_eq!(hits("id == 0x123 and byte[0] & 0x80 and ch == 1", FRAMES), [2]);
        assert_eq!(hits("byte[1] != 0", FRAMES), [0], "a byte that is not there is neither equal nor not");
        assert_eq!(hits("len == 0 or byte[0] / 2 > 0x30", FRAMES), [2, 6]);
        assert_eq!(hits("ext or rtr", &["00000001#", "001#R", "001#"]), [0, 1]);
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
            ("Sped > 1", "there is no signal \"Sped\"; did you mean Speed?\n  Sped > 1\n  ^"),
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
            ("'Drive' > 1", "a text can only be compared with a signal, by == or !=\n  'Drive' > 1\n  ^"),
        ] {
            let error = Condition::new(text, &decoder()).unwrap_err().to_string();
            assert!(error.starts_with(expected), "{error}");
        }
        let error = Condition::new("Speed > 1", &Decoder::new(Vec::new())).unwrap_err().to_string();
        assert!(error.contains("without a database there are no signals\n"), "{error}");
    }
}
