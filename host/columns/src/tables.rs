//! A table for each message of a trace.

use std::num::NonZero;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;

use cantap_signals::{Decoder, MessageRef, SignalValue};
use cantap_trace::{PlainFrame, TraceRecord};

use crate::frames::FrameColumns;
use crate::messages::MessageColumns;

/// With fewer values than this a thread takes longer to start than to decode them.
const CELLS_PER_THREAD: usize = 1 << 16;

/// A trace that is decoded into a table for each message, and one of what happened beside frames.
pub struct MessageTables {
    decoder: Arc<Decoder>,
    /// Of chosen signals only: a frame without any of them counts for nothing.
    is_chosen: bool,
    /// By [`MessageRef::index`].
    tables: Vec<Option<Box<MessageColumns>>>,
    events: FrameColumns,
    values: Vec<SignalValue>,
    decoded: u64,
}

impl MessageTables {
    /// Tables of what this decoder finds. `is_chosen`: signals were chosen of it, and a frame without any of them is left out.
    pub fn new(decoder: Arc<Decoder>, is_chosen: bool) -> Self {
        let tables = decoder.messages().map(|_| None).collect();
        let (events, values) = (FrameColumns::default(), Vec::new());
        Self { decoder, is_chosen, tables, events, values, decoded: 0 }
    }

    /// Appends a record: a row of its message's table, of that of the events, or nothing.
    pub fn push(&mut self, record: &TraceRecord) {
        let Some(frame) = record.frame() else {
            self.events.push(record);
            return;
        };
        if frame.is_remote() {
            return;
        }
        let Some(reference) = self.decoder.find(record.channel, frame.id()) else { return };
        let Some(table) = table(&self.decoder, &mut self.tables, self.is_chosen, reference) else { return };
        if self.is_chosen && !table.has_value(frame.data_len()) {
            // Whether it has one of the signals depends on its bytes.
            self.values.clear();
            self.decoder.decode_data(reference, frame.data(), &mut self.values);
            if self.values.is_empty() {
                return;
            }
            table.push_values(record, &self.values);
        } else {
            table.push(record);
        }
        self.decoded += 1;
    }

    /// Appends plain frames, as [`Self::push`] does with their records.
    pub fn push_frames(&mut self, frames: &[PlainFrame]) {
        let Self { decoder, is_chosen, tables, values, decoded, .. } = self;
        for frame in frames {
            let Some(reference) = decoder.find(frame.channel, frame.id) else { continue };
            let Some(table) = table(decoder, tables, *is_chosen, reference) else { continue };
            if *is_chosen && !table.has_value(frame.len.into()) {
                values.clear();
                let data = frame.data.to_le_bytes();
                decoder.decode_data(reference, &data[..usize::from(frame.len)], values);
                if values.is_empty() {
                    continue;
                }
            }
            table.push_frame(frame);
            *decoded += 1;
        }
    }

    /// How many frames were decoded, and how many values they had.
    pub fn counts(&mut self) -> (u64, u64) {
        self.decode();
        (self.decoded, self.tables.iter_mut().flatten().map(|table| table.values()).sum())
    }

    /// Decodes all frames that wait for it, table by table, in as many threads as there are cores.
    fn decode(&mut self) {
        let mut tables: Vec<_> = self.tables.iter_mut().flatten().collect();
        let cells: usize = tables.iter().map(|table| table.waiting_cells()).sum();
        let cores = thread::available_parallelism().map_or(1, NonZero::get);
        let threads = cores.min(cells / CELLS_PER_THREAD).min(tables.len()).max(1);
        // The largest first, so that no thread begins with it when the others have ended.
        tables.sort_unstable_by_key(|table| table.waiting_cells());
        let tables = Mutex::new(tables);
        let next = || tables.lock().unwrap_or_else(PoisonError::into_inner).pop();
        let work = || {
            while let Some(table) = next() {
                table.decode();
            }
        };
        thread::scope(|scope| {
            for _ in 1..threads {
                scope.spawn(work);
            }
            work();
        });
    }

    /// The tables that have rows, in the order of the decoder's messages, and the one of what happened beside frames.
    pub fn finish(mut self) -> (Vec<(MessageRef, Box<MessageColumns>)>, FrameColumns) {
        self.decode();
        let Self { decoder, mut tables, events, .. } = self;
        let tables = decoder.messages().filter_map(|(reference, ..)| {
            let table = tables[reference.index()].take()?;
            (table.rows() > 0).then_some((reference, table))
        });
        (tables.collect(), events)
    }
}

/// The table of a message, made where there is none yet; `None` for messages of which no signal was chosen.
#[inline]
fn table<'a>(
    decoder: &Decoder,
    tables: &'a mut [Option<Box<MessageColumns>>],
    is_chosen: bool,
    reference: MessageRef,
) -> Option<&'a mut MessageColumns> {
    if is_chosen && !decoder.is_selected(reference) {
        return None;
    }
    let table = &mut tables[reference.index()];
    Some(table.get_or_insert_with(|| Box::new(MessageColumns::new(decoder, reference))))
}
