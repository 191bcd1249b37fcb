//! Converts columns back to records.

use arrow_array::cast::AsArray;
use arrow_array::types::{
    ArrowPrimitiveType, Int8Type, Int16Type, Int32Type, TimestampNanosecondType, UInt8Type, UInt32Type,
};
use arrow_array::{Array, BinaryArray, BooleanArray, PrimitiveArray, RecordBatch, StringArray};
use arrow_schema::{ArrowError, DataType};
use cantap_trace::names::{BUS_ERRORS, ERROR_STATES, LOSS_STAGES, OVERTAKEN, TRANSMIT_FAILURES, item};
use cantap_trace::{Direction, FdFrame, Frame, Id, TraceEvent, TraceFrame, TraceRecord};
use cantap_wire::record::TransmitFailure;

use crate::events::{BUS_ERROR, LOST, STATE, SUPPRESSED, TRANSMIT_FAILED};
use crate::frames::{FRAME, RX, TX};

/// Why columns are not a trace.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BadColumns {
    /// A column is missing or has another type.
    #[error("a trace has a column '{column}' of type {wanted}; {found}")]
    Column {
        /// Its name.
        column: &'static str,
        /// The required type.
        wanted: &'static str,
        /// What was found instead.
        found: String,
    },
    /// A row contains something that a trace cannot hold.
    #[error("row {row} is not {what}")]
    Row {
        /// The row's index in its batch, from 0.
        row: usize,
        /// What was expected.
        what: &'static str,
    },
    /// The file cannot be read.
    #[error(transparent)]
    Arrow(#[from] ArrowError),
}

/// The records of a batch that has the columns of [`crate::FrameColumns`], in any order and possibly among others.
/// Texts may be dictionaries or plain.
pub fn records(batch: &RecordBatch) -> Result<Vec<TraceRecord>, BadColumns> {
    let columns = Columns::of(batch)?;
    (0..batch.num_rows()).map(|row| columns.record(row)).collect()
}

struct Columns<'a> {
    time: &'a PrimitiveArray<TimestampNanosecondType>,
    channel: &'a PrimitiveArray<UInt8Type>,
    event: Text<'a>,
    detail: Text<'a>,
    count: &'a PrimitiveArray<UInt32Type>,
    at_least: &'a BooleanArray,
    tx_errors: &'a PrimitiveArray<UInt8Type>,
    rx_errors: &'a PrimitiveArray<UInt8Type>,
    tag: &'a PrimitiveArray<UInt32Type>,
    id: &'a PrimitiveArray<UInt32Type>,
    extended: &'a BooleanArray,
    remote: &'a BooleanArray,
    fd: &'a BooleanArray,
    late: &'a BooleanArray,
    brs: &'a BooleanArray,
    esi: &'a BooleanArray,
    direction: Text<'a>,
    dlc: &'a PrimitiveArray<UInt8Type>,
    data: &'a BinaryArray,
}

/// A column of texts, in any representation.
enum Text<'a> {
    Plain(&'a StringArray),
    Indexed { keys: Vec<Option<usize>>, texts: &'a StringArray },
}

impl<'a> Text<'a> {
    fn of(array: &'a dyn Array) -> Option<Self> {
        if let Some(plain) = array.as_string_opt() {
            return Some(Self::Plain(plain));
        }
        let dictionary = array.as_any_dictionary_opt()?;
        let texts = dictionary.values().as_string_opt()?;
        let DataType::Dictionary(key, _) = array.data_type() else { return None };
        let keys = match **key {
            DataType::Int8 => keys::<Int8Type>(dictionary.keys()),
            DataType::Int16 => keys::<Int16Type>(dictionary.keys()),
            DataType::Int32 => keys::<Int32Type>(dictionary.keys()),
            _ => return None,
        };
        Some(Self::Indexed { keys, texts })
    }

    fn at(&self, row: usize) -> Option<&'a str> {
        match self {
            Self::Plain(texts) => texts.is_valid(row).then(|| texts.value(row)),
            Self::Indexed { keys, texts } => keys[row].map(|key| texts.value(key)),
        }
    }
}

fn keys<K: ArrowPrimitiveType<Native: TryInto<usize>>>(keys: &dyn Array) -> Vec<Option<usize>> {
    keys.as_primitive::<K>().iter().map(|key| key.and_then(|key| key.try_into().ok())).collect()
}

impl<'a> Columns<'a> {
    fn of(batch: &'a RecordBatch) -> Result<Self, BadColumns> {
        fn typed<'a, T>(
            batch: &'a RecordBatch,
            column: &'static str,
            wanted: &'static str,
            cast: impl FnOnce(&'a dyn Array) -> Option<T>,
        ) -> Result<T, BadColumns> {
            let Some(array) = batch.column_by_name(column) else {
                return Err(BadColumns::Column { column, wanted, found: "there is none".to_owned() });
            };
            let found = || format!("this one is {}", array.data_type());
            cast(array.as_ref()).ok_or_else(|| BadColumns::Column { column, wanted, found: found() })
        }
        let time = |array: &'a dyn Array| array.as_primitive_opt();
        let u8 = |array: &'a dyn Array| array.as_primitive_opt();
        let u32 = |array: &'a dyn Array| array.as_primitive_opt();
        let flag = |column| typed(batch, column, "bool", |array| array.as_boolean_opt());
        let text = |column| typed(batch, column, "text", Text::of);
        Ok(Self {
            time: typed(batch, "time", "timestamp[ns, UTC]", time)?,
            channel: typed(batch, "channel", "uint8", u8)?,
            event: text("event")?,
            detail: text("detail")?,
            count: typed(batch, "count", "uint32", u32)?,
            at_least: flag("at_least")?,
            tx_errors: typed(batch, "tx_errors", "uint8", u8)?,
            rx_errors: typed(batch, "rx_errors", "uint8", u8)?,
            tag: typed(batch, "tag", "uint32", u32)?,
            id: typed(batch, "id", "uint32", u32)?,
            extended: flag("extended")?,
            remote: flag("remote")?,
            fd: flag("fd")?,
            late: flag("late")?,
            brs: flag("brs")?,
            esi: flag("esi")?,
            direction: text("direction")?,
            dlc: typed(batch, "dlc", "uint8", u8)?,
            data: typed(batch, "data", "binary", |array| array.as_binary_opt())?,
        })
    }

    fn record(&self, row: usize) -> Result<TraceRecord, BadColumns> {
        let bad = |what| BadColumns::Row { row, what };
        if self.time.is_null(row) || self.channel.is_null(row) {
            return Err(bad("a valid record: it has no time or no channel"));
        }
        let event = self.event.at(row).ok_or(bad("a valid record: it does not say what happened"))?;
        let detail = self.detail.at(row);
        let count = self.count.is_valid(row).then(|| self.count.value(row));
        let event = match event {
            FRAME => self.frame(row).ok_or(bad("a valid frame"))?,
            LOST => {
                let stage =
                    detail.map(|detail| item(&LOSS_STAGES, detail).ok_or(bad("a known place of a loss")));
                let at_least = self.at_least.is_valid(row) && self.at_least.value(row);
                TraceEvent::Lost { stage: stage.transpose()?, count: count.unwrap_or(0), at_least }
            }
            BUS_ERROR => {
                let kind = detail.map(|detail| item(&BUS_ERRORS, detail).ok_or(bad("a known bus error")));
                TraceEvent::BusError { kind: kind.transpose()?, counters: self.counters(row) }
            }
            SUPPRESSED => TraceEvent::ErrorsSuppressed { count: count.unwrap_or(0) },
            STATE => {
                let state = detail.and_then(|detail| item(&ERROR_STATES, detail));
                TraceEvent::State { state: state.ok_or(bad("a known state"))?, counters: self.counters(row) }
            }
            TRANSMIT_FAILED => {
                let tag = if self.tag.is_valid(row) { self.tag.value(row) } else { 0 };
                let reason = match detail {
                    Some(OVERTAKEN) => Some(TransmitFailure::Overtaken { periods: count.unwrap_or(1) }),
                    detail => detail.and_then(|detail| item(&TRANSMIT_FAILURES, detail)),
                };
                TraceEvent::TransmitFailed { tag, reason: reason.ok_or(bad("a known failure"))? }
            }
            _ => return Err(bad("a known kind of record")),
        };
        Ok(TraceRecord { time_ns: self.time.value(row), channel: self.channel.value(row), event })
    }

    fn counters(&self, row: usize) -> Option<(u8, u8)> {
        let known = self.tx_errors.is_valid(row) && self.rx_errors.is_valid(row);
        known.then(|| (self.tx_errors.value(row), self.rx_errors.value(row)))
    }

    fn frame(&self, row: usize) -> Option<TraceEvent> {
        let is = |flag: &BooleanArray| flag.is_valid(row) && flag.value(row);
        if self.id.is_null(row) {
            return None;
        }
        let raw = self.id.value(row);
        let id = if is(self.extended) { Id::extended(raw) } else { Id::standard(raw) }?;
        let bytes = if self.data.is_valid(row) { self.data.value(row) } else { &[] };
        let frame: TraceFrame = if is(self.fd) {
            FdFrame::new(id, is(self.brs), is(self.esi), bytes)?.into()
        } else {
            let mut data = [0; 8];
            data.get_mut(..bytes.len())?.copy_from_slice(bytes);
            let remote = is(self.remote);
            let dlc = if self.dlc.is_valid(row) { self.dlc.value(row) } else { bytes.len() as u8 };
            if dlc > 15 || !remote && usize::from(dlc.min(8)) != bytes.len() {
                return None;
            }
            Frame::from_bus(id, remote, dlc, data).into()
        };
        let direction = match self.direction.at(row) {
            Some(TX) => Direction::Tx,
            Some(RX) | None => Direction::Rx,
            Some(_) => return None,
        };
        Some(TraceEvent::Frame { frame, direction, late: is(self.late) })
    }
}
