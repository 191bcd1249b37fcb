//! A condition with its names bound, and its arithmetic.

use std::ops::RangeInclusive;

use crate::MessageRef;
use cantap_trace::fd::FD_MAX_BYTES;
use cantap_trace::grammar;
use cantap_trace::{TraceEvent, TraceRecord};

use super::syntax::Operator;

/// A signal in the condition. The name may refer to signals of several messages.
#[derive(Clone, Debug)]
pub(super) struct Slot {
    pub(super) name: String,
    pub(super) candidates: Vec<(MessageRef, u32)>,
    /// The last value: which candidate, raw and physical.
    pub(super) last: Option<(usize, u64, f64)>,
}

#[derive(Clone, Debug)]
pub(super) enum Expression {
    Number(f64),
    Part(Part),
    Byte(Box<Expression>),
    Signal(usize),
    /// Whether the frame is one of these messages.
    Message(Vec<MessageRef>),
    /// Whether a signal's value has a text: for each candidate, the raw values with that text.
    HasText(usize, Vec<Vec<i64>>),
    /// The first value of a listener's name, by its index among the names.
    Field(usize),
    /// Whether it has a value.
    HasField(usize),
    /// Whether one of its values compares like this with the other side; `true` if the name is on the left.
    AnySaid(usize, Operator, Box<Expression>, bool),
    /// Whether one of its values is this text.
    FieldText(usize, String),
    Not(Box<Expression>),
    Negative(Box<Expression>),
    Binary(Operator, Box<Expression>, Box<Expression>),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Part {
    Id,
    Channel,
    Dlc,
    Length,
    Extended,
    Group,
    Remote,
    Error,
    Lost,
    Lin,
}

impl Part {
    /// What it is, and the values that it can have; `None` for what is only asked whether it is so.
    pub(super) const fn values(self) -> Option<(&'static str, RangeInclusive<u32>)> {
        Some(match self {
            Self::Id => ("an identifier", 0..=0x1FFF_FFFF),
            Self::Channel => ("a channel's number", 0..=u8::MAX as u32),
            Self::Dlc => ("a DLC", 0..=15),
            Self::Length => ("a frame's length", 0..=FD_MAX_BYTES as u32),
            Self::Group => ("a PGN", 0..=0x3_FFFF),
            Self::Extended | Self::Remote | Self::Error | Self::Lost | Self::Lin => return None,
        })
    }
}

pub(super) fn part(name: &str) -> Option<Part> {
    Some(match name.to_ascii_lowercase().as_str() {
        "id" => Part::Id,
        "ch" | "channel" => Part::Channel,
        "dlc" => Part::Dlc,
        "len" => Part::Length,
        "ext" => Part::Extended,
        "pgn" => Part::Group,
        "rtr" => Part::Remote,
        "error" => Part::Error,
        "lost" => Part::Lost,
        "lin" => Part::Lin,
        _ => return None,
    })
}

/// That a device does not count its losses is none.
fn is_loss(event: &TraceEvent) -> bool {
    matches!(event, TraceEvent::Lost { .. }) && *event != TraceEvent::UNCOUNTED
}

pub(super) fn part_of(part: Part, record: &TraceRecord) -> Option<f64> {
    let flag = |flag: bool| Some(f64::from(u8::from(flag)));
    match part {
        // LIN 1 is another bus than channel 1.
        Part::Channel if record.lin().is_some() => return None,
        Part::Channel => return Some(record.channel.into()),
        Part::Lin => return flag(record.lin().is_some()),
        Part::Error => return flag(matches!(record.event, TraceEvent::BusError { .. })),
        Part::Lost => return flag(is_loss(&record.event)),
        _ => {}
    }
    let frame = record.frame()?;
    match part {
        Part::Id => Some(frame.id().raw().into()),
        Part::Dlc => Some(frame.dlc().into()),
        Part::Length => Some(frame.data_len() as f64),
        Part::Extended => flag(frame.id().is_extended()),
        Part::Group => grammar::group_of(frame.id()).map(f64::from),
        Part::Remote => flag(frame.is_remote()),
        Part::Channel | Part::Error | Part::Lost | Part::Lin => None,
    }
}

/// The value of an expression that depends on no record.
pub(super) fn constant(expression: &Expression) -> Option<f64> {
    match expression {
        Expression::Number(value) => Some(*value),
        Expression::Negative(inner) => constant(inner).map(|value| -value),
        Expression::Binary(operator, left, right) => binary(*operator, constant(left)?, constant(right)?),
        _ => None,
    }
}

/// The index of a data byte, if it is a possible one.
pub(super) fn byte_index(value: f64) -> Option<usize> {
    const MOST: f64 = (FD_MAX_BYTES - 1) as f64;
    (value.fract() == 0.0 && (0.0..=MOST).contains(&value)).then_some(value as usize)
}

/// Not-a-number is as unknown as no value at all.
pub(super) fn truth(value: Option<f64>) -> Option<bool> {
    value.filter(|value| !value.is_nan()).map(|value| value != 0.0)
}

#[expect(clippy::float_cmp, reason = "a user who writes == means it")]
pub(super) fn binary(operator: Operator, left: f64, right: f64) -> Option<f64> {
    if left.is_nan() || right.is_nan() {
        return None;
    }
    let boolean = |truth: bool| Some(f64::from(u8::from(truth)));
    match operator {
        // Already decided unless both are true or both are false.
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
