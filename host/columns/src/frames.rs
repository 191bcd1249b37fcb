//! A table with a row per record: frames and everything else that happened.

use std::sync::{Arc, LazyLock};

use arrow_array::builder::{
    ArrayBuilder as _, BinaryBuilder, BooleanBuilder, UInt8Builder, UInt32Builder, UInt64Builder,
};
use arrow_array::types::Int8Type;
use arrow_array::{ArrayRef, RecordBatch};
use arrow_schema::{DataType, Field, Schema, SchemaRef};
use cantap_trace::{DeviceNs, Direction, FdFrame, TraceEvent, TraceRecord};

use crate::events::{self, Events};
use crate::texts::Texts;

/// The value of the column `event` in rows with a frame.
pub const FRAME: &str = "frame";
pub const RX: &str = "rx";
pub const TX: &str = "tx";

/// Records as columns. Nothing is left out: [`crate::records`] turns them back into records.
///
/// | column | type | of |
/// |---|---|---|
/// | `time` | timestamp\[ns, UTC\] | every row; since 1970, or since the trace's start where no date is known |
/// | `channel` | uint8, as the trace counts them: from 1 in most formats, from 0 in some | every row |
/// | `event` | text: `frame`, `lost`, `bus-error`, `errors-suppressed`, `state`, `transmit-failed`, `disturbed`, `lin` | every row |
/// | `detail` | text: where frames were lost, which error, which state, why not sent, what was wrong with a LIN frame | events that say it |
/// | `count` | uint32: frames lost, errors suppressed, periods overtaken; of a LIN frame its checksum | these |
/// | `at_least` | bool: there may have been more | losses |
/// | `tec`, `rec` | uint8: the controller's counters | errors and states that say it |
/// | `tag` | uint32: the request | frames that were not sent |
/// | `id` | uint32 | frames, of LIN too |
/// | `extended`, `remote`, `fd`, `late` | bool; `late`: the frame ended then or earlier | frames |
/// | `brs`, `esi` | bool | FD frames |
/// | `direction` | text: `rx`, `tx` | frames, of LIN too |
/// | `dlc` | uint8: the code on the bus, 0 to 15 | frames |
/// | `data` | binary, 0 to 64 bytes | frames, of LIN too |
/// | `device_ns` | uint64: nanoseconds of the device's own clock, corrected by nothing | records that have it |
pub struct FrameColumns {
    events: Events,
    id: UInt32Builder,
    /// In the order of [`FLAGS`].
    flags: [BooleanBuilder; 6],
    direction: Texts<Int8Type>,
    dlc: UInt8Builder,
    data: BinaryBuilder,
    device_ns: UInt64Builder,
}

const FLAGS: [&str; 6] = ["extended", "remote", "fd", "late", "brs", "esi"];

static SCHEMA: LazyLock<SchemaRef> = LazyLock::new(|| {
    let mut fields = events::fields();
    fields.push(Field::new("id", DataType::UInt32, true));
    fields.extend(FLAGS.map(|name| Field::new(name, DataType::Boolean, true)));
    fields.push(Field::new("direction", Texts::<Int8Type>::data_type(), true));
    fields.push(Field::new("dlc", DataType::UInt8, true));
    fields.push(Field::new("data", DataType::Binary, true));
    fields.push(Field::new("device_ns", DataType::UInt64, true));
    Arc::new(Schema::new(fields))
});

impl Default for FrameColumns {
    fn default() -> Self {
        Self {
            events: Events::new(FRAME),
            id: UInt32Builder::new(),
            flags: FLAGS.map(|_| BooleanBuilder::new()),
            direction: Texts::new([RX, TX]),
            dlc: UInt8Builder::new(),
            data: BinaryBuilder::new(),
            device_ns: UInt64Builder::new(),
        }
    }
}

impl FrameColumns {
    /// The table's columns.
    pub fn schema() -> SchemaRef {
        Arc::clone(&SCHEMA)
    }

    /// Appends a row.
    pub fn push(&mut self, record: &TraceRecord) {
        self.events.push(record);
        self.device_ns.append_option(record.device_ns.map(DeviceNs::get));
        let mut flags = [None; FLAGS.len()];
        if let TraceEvent::Frame { frame, direction, late } = &record.event {
            let (id, fd) = (frame.id(), frame.fd());
            flags = [id.is_extended(), frame.is_remote(), frame.is_fd(), *late, false, false].map(Some);
            (flags[4], flags[5]) = (fd.map(FdFrame::brs), fd.map(FdFrame::esi));
            self.id.append_value(id.raw());
            self.direction.push(i8::from(*direction == Direction::Tx));
            self.dlc.append_value(frame.dlc());
            self.data.append_value(frame.data());
        } else if let TraceEvent::Lin { frame, direction } = &record.event {
            self.id.append_value(frame.id().into());
            self.direction.push(i8::from(*direction == Direction::Tx));
            self.dlc.append_null();
            self.data.append_value(frame.data());
        } else {
            self.id.append_null();
            self.direction.push_option(None);
            self.dlc.append_null();
            self.data.append_null();
        }
        for (column, flag) in self.flags.iter_mut().zip(flags) {
            column.append_option(flag);
        }
    }

    /// The number of rows so far.
    pub fn rows(&self) -> usize {
        self.dlc.len()
    }

    /// Returns the rows so far; the next ones start a new batch.
    pub fn take(&mut self) -> RecordBatch {
        let mut columns = self.events.take();
        columns.push(Arc::new(self.id.finish()));
        columns.extend(self.flags.iter_mut().map(|flag| Arc::new(flag.finish()) as ArrayRef));
        columns.push(self.direction.take());
        let rest: [ArrayRef; 3] =
            [Arc::new(self.dlc.finish()), Arc::new(self.data.finish()), Arc::new(self.device_ns.finish())];
        columns.extend(rest);
        RecordBatch::try_new(Self::schema(), columns).expect("columns are as the schema says")
    }
}
