//! The columns with which every table begins: when, on which channel, what happened, and how often.

use std::sync::Arc;

use arrow_array::ArrayRef;
use arrow_array::builder::{BooleanBuilder, TimestampNanosecondBuilder, UInt8Builder, UInt32Builder};
use arrow_array::types::Int8Type;
use arrow_schema::{DataType, Field, TimeUnit};
use cantap_trace::{BusErrorKind, ErrorState, LinFault, LossStage, TraceEvent, TraceRecord, TransmitFailure};

use crate::texts::Texts;

/// The time zone of all times.
pub const UTC: &str = "UTC";

/// The event of a row that is not of the table's own kind.
pub const LOST: &str = "lost";
pub const BUS_ERROR: &str = "bus-error";
pub const SUPPRESSED: &str = "errors-suppressed";
pub const STATE: &str = "state";
pub const TRANSMIT_FAILED: &str = "transmit-failed";
pub const DISTURBED: &str = "disturbed";
pub const LIN: &str = "lin";
/// Their order in the column of events, after the table's own.
const KINDS: [&str; 7] = [LOST, BUS_ERROR, SUPPRESSED, STATE, TRANSMIT_FAILED, DISTURBED, LIN];

/// The columns' names and types.
pub fn fields() -> Vec<Field> {
    let texts = Texts::<Int8Type>::data_type();
    vec![
        Field::new("time", DataType::Timestamp(TimeUnit::Nanosecond, Some(UTC.into())), false),
        Field::new("channel", DataType::UInt8, false),
        Field::new("event", texts.clone(), false),
        Field::new("detail", texts, true),
        Field::new("count", DataType::UInt32, true),
        Field::new("at_least", DataType::Boolean, true),
        Field::new("tec", DataType::UInt8, true),
        Field::new("rec", DataType::UInt8, true),
        Field::new("tag", DataType::UInt32, true),
    ]
}

/// The columns under construction.
pub struct Events {
    time: TimestampNanosecondBuilder,
    channel: UInt8Builder,
    event: Texts<Int8Type>,
    detail: Texts<Int8Type>,
    details: Vec<&'static str>,
    count: UInt32Builder,
    at_least: BooleanBuilder,
    tec: UInt8Builder,
    rec: UInt8Builder,
    tag: UInt32Builder,
    /// Number of the table's own rows at the end for which only time and channel are in the columns so far: there is nothing else to
    /// add for them, and most rows are like that.
    plain: usize,
}

/// What a record says besides time and channel.
#[derive(Default)]
pub struct Happened {
    /// The index in the column of events; 0 is the table's own.
    event: i8,
    pub detail: Option<&'static str>,
    pub count: Option<u32>,
    pub at_least: Option<bool>,
    pub counters: Option<(u8, u8)>,
    pub tag: Option<u32>,
}

impl Events {
    /// For a table whose own rows are named `own`.
    pub fn new(own: &str) -> Self {
        let mut details = Vec::new();
        let names =
            LossStage::ALL.map(LossStage::name).into_iter().chain(BusErrorKind::ALL.map(BusErrorKind::name));
        let names = names.chain(ErrorState::ALL.map(ErrorState::name));
        let names = names.chain(LinFault::ALL.map(LinFault::name));
        for name in names.chain(TransmitFailure::ALL.map(TransmitFailure::name)) {
            if !details.contains(&name) {
                details.push(name);
            }
        }
        Self {
            time: TimestampNanosecondBuilder::new().with_timezone(UTC),
            channel: UInt8Builder::new(),
            event: Texts::new([own].into_iter().chain(KINDS)),
            detail: Texts::new(&details),
            details,
            count: UInt32Builder::new(),
            at_least: BooleanBuilder::new(),
            tec: UInt8Builder::new(),
            rec: UInt8Builder::new(),
            tag: UInt32Builder::new(),
            plain: 0,
        }
    }

    /// Appends a row for the record; a frame is a row of the table's own.
    pub fn push(&mut self, record: &TraceRecord) {
        if matches!(record.event, TraceEvent::Frame { .. }) {
            self.time.append_value(record.time_ns);
            self.channel.append_value(record.channel);
            self.plain += 1;
        } else {
            self.push_event(record);
        }
    }

    /// Appends several rows of the table's own for a frame.
    pub fn push_n(&mut self, record: &TraceRecord, rows: usize) {
        self.time.append_value_n(record.time_ns, rows);
        self.channel.append_value_n(record.channel, rows);
        self.plain += rows;
    }

    /// Adds the plain rows to all columns.
    fn complete(&mut self) {
        let rows = std::mem::take(&mut self.plain);
        self.event.push_n(0, rows);
        self.detail.push_none(rows);
        self.count.append_nulls(rows);
        self.at_least.append_nulls(rows);
        self.tec.append_nulls(rows);
        self.rec.append_nulls(rows);
        self.tag.append_nulls(rows);
    }

    fn push_event(&mut self, record: &TraceRecord) {
        self.complete();
        let happened = Happened::of(&record.event);
        let index = |detail| self.details.iter().position(|known| *known == detail).map(|at| at as i8);
        let detail = happened.detail.and_then(index);
        self.time.append_value(record.time_ns);
        self.channel.append_value(record.channel);
        self.event.push(happened.event);
        self.detail.push_option(detail);
        self.count.append_option(happened.count);
        self.at_least.append_option(happened.at_least);
        self.tec.append_option(happened.counters.map(|(tx, _)| tx));
        self.rec.append_option(happened.counters.map(|(_, rx)| rx));
        self.tag.append_option(happened.tag);
    }

    /// Returns the columns so far; the next ones start empty.
    pub fn take(&mut self) -> Vec<ArrayRef> {
        self.complete();
        vec![
            Arc::new(self.time.finish()),
            Arc::new(self.channel.finish()),
            self.event.take(),
            self.detail.take(),
            Arc::new(self.count.finish()),
            Arc::new(self.at_least.finish()),
            Arc::new(self.tec.finish()),
            Arc::new(self.rec.finish()),
            Arc::new(self.tag.finish()),
        ]
    }
}

impl Happened {
    /// The kind of event; `None` for a frame.
    #[cfg(feature = "mcap")]
    pub fn kind(&self) -> Option<&'static str> {
        KINDS.get(usize::try_from(self.event - 1).ok()?).copied()
    }

    pub fn of(event: &TraceEvent) -> Self {
        let kind = |kind| 1 + KINDS.iter().position(|known| *known == kind).unwrap_or(0) as i8;
        match *event {
            TraceEvent::Frame { .. } => Self::default(),
            TraceEvent::Lost { stage, count, at_least } => Self {
                event: kind(LOST),
                detail: stage.map(LossStage::name),
                count: Some(count),
                at_least: Some(at_least),
                ..Self::default()
            },
            TraceEvent::BusError { kind: error, counters } => Self {
                event: kind(BUS_ERROR),
                detail: error.map(BusErrorKind::name),
                counters,
                ..Self::default()
            },
            TraceEvent::ErrorsSuppressed { count } => {
                Self { event: kind(SUPPRESSED), count: Some(count), ..Self::default() }
            }
            TraceEvent::State { state, counters } => {
                Self { event: kind(STATE), detail: Some(state.name()), counters, ..Self::default() }
            }
            TraceEvent::TransmitFailed { tag, reason } => {
                let count = match reason {
                    TransmitFailure::Overtaken { periods } => Some(periods),
                    _ => None,
                };
                let (detail, tag) = (Some(reason.name()), Some(tag));
                Self { event: kind(TRANSMIT_FAILED), detail, count, tag, ..Self::default() }
            }
            TraceEvent::Disturbed { length_ns } => {
                Self { event: kind(DISTURBED), count: Some(length_ns), ..Self::default() }
            }
            TraceEvent::Lin { frame, .. } => Self {
                event: kind(LIN),
                detail: frame.fault.map(LinFault::name),
                count: frame.checksum.map(u32::from),
                ..Self::default()
            },
        }
    }
}
