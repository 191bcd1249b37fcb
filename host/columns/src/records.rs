//! Converts columns back to records.

use arrow_array::cast::AsArray;
use arrow_array::types::{
    ArrowPrimitiveType, Int8Type, Int16Type, Int32Type, TimestampNanosecondType, UInt8Type, UInt32Type,
    UInt64Type,
};
use arrow_array::{Array, BinaryArray, BooleanArray, PrimitiveArray, RecordBatch, StringArray};
use arrow_schema::DataType;
use cantap_trace::{
    BusErrorKind, DeviceNs, Direction, ErrorState, FdFrame, Frame, Id, LinFault, LinFrame, LossStage,
    TraceEvent, TraceFrame, TraceRecord, TransmitFailure,
};

use crate::bad::BadColumns;
use crate::events::{BUS_ERROR, DISTURBED, LIN, LOST, STATE, SUPPRESSED, TRANSMIT_FAILED};
use crate::foreign::with_our_columns;
use crate::frames::{FRAME, RX, TX};
use crate::signals::VALUE;

/// The records of a batch that has the columns of [`crate::FrameColumns`], in any order and possibly among others, or columns that other
/// programs made.
///
/// `time`, `id` and `data` must be there, the last two only if there is no `event`. Other columns may be missing:
///
/// | without, or null | is |
/// |---|---|
/// | `channel` | 1; it must not be null |
/// | `event` | `frame`; it must not be null |
/// | `extended` | whether `id` is above 7FF |
/// | `fd` | whether there are more than 8 bytes |
/// | `remote`, `brs`, `esi`, `late`, `at_least` | false |
/// | `direction` | `rx` |
/// | `dlc` | what belongs to the length of `data`; 0 for a remote frame |
/// | `device_ns` | not known; so is 0 |
///
/// Numbers may have any width, and be floating-point if they are whole. `time` may be a timestamp of any unit, a duration, or float64
/// seconds; without a zone it is UTC. `data` may be binary, a list of numbers, or text with pairs of hexadecimal digits. `id` may be
/// text that begins with `0x`. Texts may be dictionaries.
///
/// # Errors
/// What cannot be taken without a guess or a loss.
pub fn records(batch: &RecordBatch) -> Result<Vec<TraceRecord>, BadColumns> {
    let batch = with_our_columns(batch)?;
    let columns = Columns::of(&batch)?;
    let record = |row| columns.record(row).map_err(|what| BadColumns::Row { row, what: what.to_owned() });
    (0..batch.num_rows()).map(record).collect()
}

struct Columns<'a> {
    time: &'a PrimitiveArray<TimestampNanosecondType>,
    channel: &'a PrimitiveArray<UInt8Type>,
    event: Text<'a>,
    detail: Text<'a>,
    count: &'a PrimitiveArray<UInt32Type>,
    at_least: &'a BooleanArray,
    tec: &'a PrimitiveArray<UInt8Type>,
    rec: &'a PrimitiveArray<UInt8Type>,
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
    device_ns: &'a PrimitiveArray<UInt64Type>,
}

/// A column of texts, in any representation.
pub enum Text<'a> {
    Plain(&'a StringArray),
    Indexed { keys: Vec<Option<usize>>, texts: &'a StringArray },
}

impl<'a> Text<'a> {
    pub fn of(array: &'a dyn Array) -> Option<Self> {
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

    pub fn at(&self, row: usize) -> Option<&'a str> {
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
                return Err(BadColumns::Column {
                    column: column.to_owned(),
                    wanted,
                    found: "there is none".to_owned(),
                });
            };
            let found = || format!("this one is {}", array.data_type());
            cast(array.as_ref()).ok_or_else(|| BadColumns::Column {
                column: column.to_owned(),
                wanted,
                found: found(),
            })
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
            tec: typed(batch, "tec", "uint8", u8)?,
            rec: typed(batch, "rec", "uint8", u8)?,
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
            device_ns: typed(batch, "device_ns", "uint64", |array| array.as_primitive_opt())?,
        })
    }

    fn record(&self, row: usize) -> Result<TraceRecord, &'static str> {
        if self.time.is_null(row) || self.channel.is_null(row) {
            return Err("it has no time or no channel");
        }
        let event = self.event.at(row).ok_or("its event is missing")?;
        let detail = self.detail.at(row);
        let count = self.count.is_valid(row).then(|| self.count.value(row));
        let event = match event {
            FRAME => self.frame(row)?,
            LOST => {
                let stage = detail.map(|detail| {
                    LossStage::from_name(detail).ok_or("its detail is not a known place of a loss")
                });
                let at_least = self.at_least.is_valid(row) && self.at_least.value(row);
                TraceEvent::Lost { stage: stage.transpose()?, count: count.unwrap_or(0), at_least }
            }
            BUS_ERROR => {
                let kind = detail.map(|detail| {
                    BusErrorKind::from_name(detail).ok_or("its detail is not a known bus error")
                });
                TraceEvent::BusError { kind: kind.transpose()?, counters: self.counters(row) }
            }
            SUPPRESSED => TraceEvent::ErrorsSuppressed { count: count.unwrap_or(0) },
            STATE => {
                let state = detail.and_then(ErrorState::from_name);
                TraceEvent::State {
                    state: state.ok_or("its detail is not a known state")?,
                    counters: self.counters(row),
                }
            }
            TRANSMIT_FAILED => {
                let tag = if self.tag.is_valid(row) { self.tag.value(row) } else { 0 };
                let overtaken = TransmitFailure::Overtaken { periods: count.unwrap_or(1) };
                let reason = detail.and_then(|detail| {
                    if detail == overtaken.name() {
                        return Some(overtaken);
                    }
                    TransmitFailure::from_name(detail, None)
                });
                TraceEvent::TransmitFailed { tag, reason: reason.ok_or("its detail is not a known failure")? }
            }
            DISTURBED => TraceEvent::Disturbed { length_ns: count.unwrap_or(0) },
            LIN => self.lin(row, detail, count)?,
            VALUE => return Err("it is a decoded value; records are what `read` gives without a database"),
            _ => return Err("its event is not of a known kind"),
        };
        let device_ns =
            self.device_ns.is_valid(row).then(|| self.device_ns.value(row)).and_then(DeviceNs::new);
        Ok(TraceRecord { time_ns: self.time.value(row), device_ns, channel: self.channel.value(row), event })
    }

    fn counters(&self, row: usize) -> Option<(u8, u8)> {
        let known = self.tec.is_valid(row) && self.rec.is_valid(row);
        known.then(|| (self.tec.value(row), self.rec.value(row)))
    }

    fn direction(&self, row: usize) -> Result<Direction, &'static str> {
        match self.direction.at(row) {
            None => Ok(Direction::Rx),
            Some(text) if text.eq_ignore_ascii_case(RX) => Ok(Direction::Rx),
            Some(text) if text.eq_ignore_ascii_case(TX) => Ok(Direction::Tx),
            Some(_) => Err("a direction is rx or tx"),
        }
    }

    /// A LIN frame; `count` is its checksum.
    fn lin(&self, row: usize, detail: Option<&str>, count: Option<u32>) -> Result<TraceEvent, &'static str> {
        let fault =
            detail.map(|detail| LinFault::from_name(detail).ok_or("its detail is no fault of a LIN frame"));
        let id = self.id.is_valid(row).then(|| self.id.value(row)).and_then(|id| u8::try_from(id).ok());
        let data = if self.data.is_valid(row) { self.data.value(row) } else { &[] };
        let frame = id.and_then(|id| LinFrame::new(id, data));
        let frame = frame.ok_or("a LIN frame has an identifier up to 3F and at most 8 bytes")?;
        let checksum =
            count.map(|count| u8::try_from(count).map_err(|_| "the checksum of a LIN frame is a byte"));
        let frame = frame.with(checksum.transpose()?, fault.transpose()?);
        Ok(TraceEvent::Lin { frame, direction: self.direction(row)? })
    }

    fn frame(&self, row: usize) -> Result<TraceEvent, &'static str> {
        let flag = |flag: &BooleanArray| flag.is_valid(row).then(|| flag.value(row));
        let is = |column: &BooleanArray| flag(column).unwrap_or(false);
        if self.id.is_null(row) {
            return Err("the frame has no identifier");
        }
        let raw = self.id.value(row);
        let id = if flag(self.extended).unwrap_or(raw > MAX_STANDARD) {
            Id::extended(raw).ok_or("the identifier has more than 29 bits")?
        } else {
            Id::standard(raw).ok_or("a standard identifier is at most 7FF")?
        };
        let remote = is(self.remote);
        let dlc = self.dlc.is_valid(row).then(|| self.dlc.value(row));
        let bytes = self.data.is_valid(row).then(|| self.data.value(row));
        if bytes.is_none() && !remote && dlc != Some(0) {
            return Err("the frame has no data; give it, even if there are no bytes");
        }
        let bytes = bytes.unwrap_or_default();
        let frame: TraceFrame = if flag(self.fd).unwrap_or(bytes.len() > 8) {
            if remote {
                return Err("CAN FD has no remote frames");
            }
            FdFrame::new(id, is(self.brs), is(self.esi), bytes)
                .ok_or("CAN FD has frames of 0 to 8, 12, 16, 20, 24, 32, 48 and 64 bytes")?
                .into()
        } else {
            let mut data = [0; 8];
            let whole = data.get_mut(..bytes.len()).ok_or("a frame other than CAN FD has at most 8 bytes")?;
            whole.copy_from_slice(bytes);
            if remote && !bytes.is_empty() {
                return Err("a remote frame has no data");
            }
            let dlc = dlc.unwrap_or(bytes.len() as u8);
            if dlc > 15 {
                return Err("a length code is at most 15");
            }
            Frame::from_bus(id, remote, dlc, data).into()
        };
        if frame.data().len() != bytes.len() || dlc.is_some_and(|dlc| dlc != frame.dlc()) {
            return Err("dlc does not fit the data; it is the code on the bus, such as 9 for 12 bytes");
        }
        let direction = self.direction(row)?;
        Ok(TraceEvent::Frame { frame, direction, late: is(self.late) })
    }
}

/// The largest identifier of 11 bits.
const MAX_STANDARD: u32 = 0x7FF;
