//! Binds a condition's names to their meaning: parts of the frame, signals of databases, or what a listener knows.

use crate::named::PREFIX;
use crate::{Decoder, MessageRef, Signal, Suggestion};

use super::error::ConditionFault;
use super::expression::{Expression, Part, Slot, byte_index, constant, part};
use super::listener::Listener;
use super::syntax::{Kind, Node, Operator};

/// An expression whose names are bound.
pub(super) struct Bound {
    pub(super) expression: Expression,
    pub(super) slots: Vec<Slot>,
    /// Whether it refers to the frame itself.
    pub(super) about_frames: bool,
    /// The listener's names in it.
    pub(super) names: Vec<String>,
}

/// The position of a fault in the text, and the fault.
pub(super) type Fault = (usize, ConditionFault);

/// Binds a whole condition.
pub(super) fn bind(
    text: &str,
    tree: &Node,
    decoder: &Decoder,
    listener: &mut dyn Listener,
) -> Result<Bound, Fault> {
    let mut binder =
        Binder { text, decoder, listener, slots: Vec::new(), about_frames: false, names: Vec::new() };
    let expression = binder.truth(tree)?;
    let Binder { slots, about_frames, names, .. } = binder;
    Ok(Bound { expression, slots, about_frames, names })
}

struct Binder<'a> {
    text: &'a str,
    decoder: &'a Decoder,
    listener: &'a mut dyn Listener,
    slots: Vec<Slot>,
    about_frames: bool,
    names: Vec<String>,
}

impl Binder<'_> {
    /// Binds something whose truth is asked: there, a listener's name alone asks whether it has a value.
    fn truth(&mut self, node: &Node) -> Result<Expression, Fault> {
        if let Kind::Number(_) = node.kind {
            let rest = self.text.get(node.at..).unwrap_or_default();
            let end = rest.find(|c: char| !(c.is_ascii_alphanumeric() || c == '.')).unwrap_or(rest.len());
            return Err((node.at, ConditionFault::LoneNumber(rest[..end].to_owned())));
        }
        Ok(match self.bind(node)? {
            Expression::Field(name) => Expression::HasField(name),
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

    /// If there are several values, one that satisfies the comparison is enough.
    fn comparison(
        &mut self,
        operator: Operator,
        left_node: &Node,
        right_node: &Node,
    ) -> Result<Expression, Fault> {
        let (left, right) = (self.bind(left_node)?, self.bind(right_node)?);
        let compares = matches!(
            operator,
            Operator::Equal
                | Operator::NotEqual
                | Operator::Less
                | Operator::LessOrEqual
                | Operator::Greater
                | Operator::GreaterOrEqual
        );
        if compares {
            self.refuse_decimal_id(left_node, right_node)?;
            self.refuse_decimal_id(right_node, left_node)?;
            refuse_range(left_node, right_node)?;
            refuse_range(right_node, left_node)?;
        }
        if matches!(operator, Operator::Equal | Operator::NotEqual) {
            refuse_impossible(&left, (right_node.at, &right))?;
            refuse_impossible(&right, (left_node.at, &left))?;
        }
        Ok(match (left, right) {
            (Expression::Field(name), right) if compares => {
                Expression::AnySaid(name, operator, right.into(), true)
            }
            (left, Expression::Field(name)) if compares => {
                Expression::AnySaid(name, operator, left.into(), false)
            }
            (left, right) => Expression::Binary(operator, left.into(), right.into()),
        })
    }

    /// Whoever copies an identifier from a list of frames leaves out the 0x, and would be shown other frames, or none.
    fn refuse_decimal_id(&self, id: &Node, number: &Node) -> Result<(), Fault> {
        let (Kind::Name(name), Kind::Number(value)) = (&id.kind, &number.kind) else { return Ok(()) };
        if !matches!(part(name), Some(Part::Id)) {
            return Ok(());
        }
        let rest = self.text.get(number.at..).unwrap_or_default();
        let end = rest.find(|character: char| !character.is_ascii_digit()).unwrap_or(rest.len());
        let continues = rest[end..].starts_with(|c: char| c.is_ascii_alphanumeric() || c == '.' || c == '_');
        // Of so many digits it can only be the other.
        let is_id = u32::from_str_radix(&rest[..end], 16).is_ok_and(|raw| raw <= 0x1FFF_FFFF);
        if *value < 10.0 || continues || !is_id {
            return Ok(());
        }
        Err((number.at, ConditionFault::DecimalId(rest[..end].to_owned(), *value as u64)))
    }

    fn name(&mut self, at: usize, name: &str) -> Result<Expression, Fault> {
        if let Some(slot) = self.slot(name) {
            return Ok(Expression::Signal(slot));
        }
        if let Some(part) = part(name) {
            self.about_frames = true;
            return Ok(Expression::Part(part));
        }
        if let Some(field) = self.field(name) {
            return Ok(Expression::Field(field));
        }
        let of_message = name.strip_prefix(PREFIX).unwrap_or(name);
        let messages = self.decoder.messages();
        let messages: Vec<_> =
            messages.filter(|(_, _, message)| message.name == of_message).map(|(place, ..)| place).collect();
        if !messages.is_empty() {
            self.about_frames = true;
            return Ok(Expression::Message(messages));
        }
        if self.decoder.messages().next().is_none() {
            return Err((at, ConditionFault::NoDatabase(name.to_owned())));
        }
        let signals = self.decoder.signals().map(|(_, _, signal)| signal.name.as_str());
        let near = Suggestion::nearest(
            of_message,
            signals.chain(self.decoder.messages().map(|(_, _, message)| message.name.as_str())),
        );
        Err((at, ConditionFault::UnknownName { name: name.to_owned(), near }))
    }

    /// The slot of a signal, if there is one of that name. Parts of the frame take precedence over signals.
    fn slot(&mut self, name: &str) -> Option<usize> {
        if let Some(slot) = self.slots.iter().position(|slot| slot.name == name) {
            return Some(slot);
        }
        if part(name).is_some() {
            return None;
        }
        let decoder = self.decoder;
        let named = |(message, index, signal): (MessageRef, usize, &Signal)| {
            // Names of messages and of signals may have dots in them.
            let mut dots = name.match_indices('.');
            let is_named = |(at, _): (usize, &str)| {
                signal.name == name[at + 1..] && signal.is_in(&name[..at], decoder.message(message))
            };
            (if name.contains('.') { dots.any(is_named) } else { signal.name == name })
                .then_some((message, index as u32))
        };
        let candidates: Vec<_> = decoder.signals().filter_map(named).collect();
        if candidates.is_empty() {
            return None;
        }
        self.slots.push(Slot { name: name.to_owned(), candidates, last: None });
        Some(self.slots.len() - 1)
    }

    /// The index of a listener's name, if it is one.
    fn field(&mut self, name: &str) -> Option<usize> {
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
            let field = if slot.is_none() && part(name).is_none() { self.field(name) } else { None };
            // Without quotes it may also be another signal, or not exist at all.
            let is_value =
                self.slot(wanted).is_some() || part(wanted).is_some() || self.field(wanted).is_some();
            if slot.is_none() && field.is_none() || !quoted && is_value {
                continue;
            }
            let Some(slot) = slot else {
                return Ok(field.map(|field| Expression::FieldText(field, wanted.clone())));
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

/// Filters take `100-1FF` as a range. Here it is a difference, which no identifier would equal.
fn refuse_range(id: &Node, other: &Node) -> Result<(), Fault> {
    if let (Kind::Name(name), Kind::Binary(Operator::Subtract, first, last)) = (&id.kind, &other.kind)
        && matches!(part(name), Some(Part::Id))
        && let (Kind::Number(first), Kind::Number(last)) = (&first.kind, &last.kind)
    {
        return Err((other.at, ConditionFault::IdRange(*first as u64, *last as u64)));
    }
    Ok(())
}

/// A part of a frame that is compared with a number which it never has.
fn refuse_impossible(compared: &Expression, (at, other): (usize, &Expression)) -> Result<(), Fault> {
    let (Expression::Part(part), Some(value)) = (compared, constant(other)) else { return Ok(()) };
    let Some((what, possible)) = part.values() else { return Ok(()) };
    if value.fract() == 0.0 && (f64::from(*possible.start())..=f64::from(*possible.end())).contains(&value) {
        return Ok(());
    }
    let number = |number: u32| if *part == Part::Id { format!("0x{number:X}") } else { number.to_string() };
    let (first, last) = (number(*possible.start()), number(*possible.end()));
    Err((at, ConditionFault::NeverEqual { what, first, last }))
}
