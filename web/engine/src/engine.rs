//! The engine's state, and its answers.

use std::collections::hash_map::Entry;

use cantap_wire::CHANNELS;
use rustc_hash::FxHashMap;
use serde::Serialize;
use serde_json::{Value, json};

use crate::board::{self, Board};
use crate::databases::{Databases, Loaded, SignalPlace};
use crate::error::EngineError;
use crate::export;
use crate::fields::Fields;
use crate::findings::{self, Finding};
use crate::identifiers;
use crate::index::{Index, Place, identifier};
use crate::interval::{self, IntervalAnswer};
use crate::load::{self, ChannelBits};
use crate::message::{self, Floats, Received, Sections};
use crate::own_database::SignalEdit;
use crate::request::Request;
use crate::row::Row;
use crate::series::{Picture, Series};
use crate::summary::Summary;
use crate::trace::{Content, Rates, Trace};
use crate::views::Views;
use crate::{conversations, request};

/// No answer has more rows than this.
const MOST_ROWS: usize = 100_000;
/// No picture has more columns than this.
const MOST_COLUMNS: usize = 100_000;
/// Signals that no database has are kept for so many pictures: those that are being drawn.
const MOST_RAW: usize = 32;
/// The least bit rate, in bit/s: below it no controller works, and the windows of statistics are too short.
const LEAST_BITRATE: u32 = 1000;

/// A trace, its databases, and what was computed for earlier requests.
#[derive(Default)]
pub struct Engine {
    trace: Option<Trace>,
    rates: Rates,
    databases: Databases,
    views: Views,
    index: Index,
    /// By the signal.
    series: FxHashMap<SignalPlace, Series>,
    /// By the edit's parameters.
    raw_series: Vec<(String, Series)>,
    bits: FxHashMap<u8, ChannelBits>,
    fields: Fields,
    generation: u64,
    board: Option<Board>,
}

/// `Series` in `api.ts`.
#[derive(Serialize)]
struct SeriesAnswer {
    time: Floats,
    end: Floats,
    first: Floats,
    min: Floats,
    max: Floats,
    last: Floats,
    values: usize,
    exact: bool,
}

/// `Gap` in `api.ts`.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct GapAnswer {
    from: f64,
    to: f64,
    channel: u8,
    stage: &'static str,
    count: u64,
    at_least: bool,
}

type Answer = Result<Value, EngineError>;

fn json(answer: impl Serialize) -> Answer {
    // Keys are texts, and numbers that JSON does not have become null.
    serde_json::to_value(answer).map_err(|_| EngineError::BadMessage)
}

impl Engine {
    /// Answers a request; see [`message`].
    pub fn ask(&mut self, request: &[u8]) -> Vec<u8> {
        let mut sections = Sections::default();
        let answer = self.answer(request, &mut sections);
        message::answer(answer, &sections)
    }

    fn answer(&mut self, request: &[u8], sections: &mut Sections) -> Answer {
        let (head, received) = message::split(request)?;
        let request: Request =
            serde_json::from_slice(head).map_err(|error| EngineError::BadRequest(error.to_string()))?;
        match request {
            Request::Open { name, bytes, more, size, keep } => {
                if self.board.as_ref().is_some_and(Board::is_open) {
                    return Err(EngineError::BoardOpen);
                }
                self.board = None;
                let bytes = received.bytes(bytes)?;
                self.replace(|rates, generation| {
                    Trace::open(&name, bytes, more, size, keep, rates, generation)
                })?;
                self.summary()
            }
            Request::Append { bytes, more } => {
                let bytes = received.bytes(bytes)?;
                self.trace.as_mut().ok_or(EngineError::NoTrace)?.append(bytes, more)?;
                self.forget_if_anew();
                self.forget_oldest();
                self.summary()
            }
            Request::Summary {} => self.summary(),
            Request::Bitrate { channel, bitrate, data_bitrate } => {
                self.bitrate(channel, bitrate, data_bitrate)
            }
            Request::Database { name, bytes, channel } => self.database(&name, bytes, channel, received),
            Request::Connections(connections) => {
                self.databases.connect(&connections)?;
                self.databases_changed();
                json(json!({}))
            }
            Request::Messages {} => {
                self.extend_index();
                json(self.databases.messages(&self.index))
            }
            request @ (Request::EditSignal(_) | Request::SetOwnDatabase { .. }) => self.edit(request),
            Request::Formats {} => json(export::formats()),
            Request::BoardUsb {} => json(board::USB_ID),
            Request::BoardOpen { name, bitrates, now, again } => {
                self.open_board(&name, bitrates, now, again)?;
                self.board(sections)
            }
            Request::BoardTake { pieces, now } => {
                let board = self.board.as_mut().ok_or(EngineError::NoBoard)?;
                for piece in pieces {
                    board.take(received.bytes(piece.bytes)?, piece.at);
                }
                board.take(&[], now);
                self.board(sections)
            }
            Request::BoardStop {} => {
                self.board.as_mut().ok_or(EngineError::NoBoard)?.stop();
                self.board(sections)
            }
            Request::BoardVanished { reason } => {
                self.board.as_mut().ok_or(EngineError::NoBoard)?.vanished(&reason);
                self.board(sections)
            }
            request => self.of_trace(request, sections),
        }
    }

    /// Opens a trace in place of the one before.
    fn replace(
        &mut self,
        open: impl FnOnce(Rates, u64) -> Result<Trace, EngineError>,
    ) -> Result<(), EngineError> {
        self.trace = None;
        self.forget();
        self.generation += 1;
        let trace = open(self.rates.clone(), self.generation)?;
        self.generation = trace.generation;
        self.trace = Some(trace);
        Ok(())
    }

    /// Drops what was computed from records that are no longer these.
    fn forget(&mut self) {
        self.index = Index::default();
        self.views.clear();
        self.forget_signals();
        self.bits.clear();
        self.fields = Fields::default();
    }

    fn forget_signals(&mut self) {
        self.series.clear();
        self.raw_series.clear();
    }

    fn forget_if_anew(&mut self) {
        let now = self.trace.as_ref().map_or(0, |trace| trace.generation);
        if now != self.generation {
            self.generation = now;
            self.forget();
        }
    }

    /// A live trace keeps its newest records: what was computed from the others goes with them.
    fn forget_oldest(&mut self) {
        let forgotten = self.trace.as_mut().map_or(0, |trace| trace.content.forget_oldest());
        if forgotten > 0 {
            self.index.forget_first(forgotten);
            self.views.forget_first(forgotten);
            self.forget_signals();
            self.bits.clear();
            let begin_ns = self.trace.as_ref().map_or(0, |trace| trace.content.begin_kept_ns());
            self.fields.forget_first(forgotten, begin_ns);
        }
    }

    fn content(&self) -> Result<&Content, EngineError> {
        self.trace.as_ref().map(|trace| &trace.content).ok_or(EngineError::NoTrace)
    }

    fn summary(&self) -> Answer {
        json(Summary::of(self.trace.as_ref().ok_or(EngineError::NoTrace)?))
    }

    /// Begins a session with a board: in a new trace, or `again` in the one that an earlier session has left.
    fn open_board(
        &mut self,
        name: &str,
        bitrates: [Option<u32>; CHANNELS],
        now: f64,
        again: bool,
    ) -> Result<(), EngineError> {
        if self.board.as_ref().is_some_and(Board::is_open) {
            return Err(EngineError::BoardOpen);
        }
        for (channel, bitrate) in (1..).zip(bitrates) {
            let Some(bitrate) = bitrate else { continue };
            if bitrate < LEAST_BITRATE {
                return Err(EngineError::BadBitrate(bitrate));
            }
            self.rates.set(channel, bitrate, None);
        }
        let before = self.board.take().filter(|_| again && self.trace.is_some());
        if let Some((before, trace)) = before.as_ref().zip(self.trace.as_mut()) {
            trace.add(&before.gap());
            trace.set_rates(self.rates.clone());
        } else {
            self.replace(|rates, generation| Trace::open(name, &[], true, None, None, rates, generation))?;
        }
        self.board = Some(Board::open(bitrates, now, before.map(|before| before.latest_ns())));
        Ok(())
    }

    /// Takes the records that the board's session has, and answers with its state and the summary.
    fn board(&mut self, sections: &mut Sections) -> Answer {
        let (Some(board), Some(trace)) = (&mut self.board, &mut self.trace) else {
            return Err(EngineError::NoBoard);
        };
        trace.add(&board.records());
        let state = board.state(sections);
        self.forget_oldest();
        json(json!({ "board": state, "summary": self.summary()? }))
    }

    fn extend_index(&mut self) {
        let Some(trace) = &self.trace else { return };
        if self.index.extend(&trace.content.store) {
            self.forget_signals();
        }
    }

    fn bitrate(&mut self, channel: u8, bitrate: u32, data: Option<u32>) -> Answer {
        for rate in [Some(bitrate), data].into_iter().flatten() {
            if rate < LEAST_BITRATE {
                return Err(EngineError::BadBitrate(rate));
            }
        }
        self.rates.set(channel, bitrate, data);
        self.trace.as_mut().ok_or(EngineError::NoTrace)?.set_rates(self.rates.clone());
        self.summary()
    }

    fn database(
        &mut self,
        name: &str,
        bytes: message::Bytes,
        channel: Option<u8>,
        received: Received<'_>,
    ) -> Answer {
        let loaded = self.databases.add(name, received.bytes(bytes)?, channel)?;
        self.databases_changed();
        json(loaded)
    }

    fn databases_changed(&mut self) {
        self.views.clear();
        self.forget_signals();
        self.fields = Fields::default();
    }

    fn edit(&mut self, request: Request) -> Answer {
        let answer = match request {
            Request::EditSignal(edit) => {
                let place = Place { channel: edit.channel, id: identifier(edit.id, edit.extended)? };
                let known = self.databases.message(place).cloned();
                json(json!({ "dbc": self.databases.own.edit(&edit, known.as_ref())? }))
            }
            Request::SetOwnDatabase { dbc } => json(Loaded::of(&self.databases.own.replace(&dbc)?)),
            _ => Err(EngineError::BadMessage),
        }?;
        self.databases.rebuild();
        self.databases_changed();
        Ok(answer)
    }

    /// Requests about the trace that is open.
    fn of_trace(&mut self, request: Request, sections: &mut Sections) -> Answer {
        self.content()?;
        self.extend_index();
        let Self { trace, databases, views, index, fields, .. } = self;
        let trace = trace.as_ref().ok_or(EngineError::NoTrace)?;
        let content = &trace.content;
        let store = &content.store;
        let window = |from, to| (content.begin_ns(from), content.end_of_ns(to));
        match request {
            Request::Filter { filter } => {
                let view = views.filter(&filter, databases.decoder(), store)?;
                json(json!({ "view": view, "rows": views.rows(view, store)?.len() }))
            }
            Request::Rows { view, from, count } => {
                let rows = views.rows(view, store)?;
                let places = from..from.saturating_add(count.min(MOST_ROWS));
                let row = |place: usize| {
                    let index = rows.record(place)?;
                    let above = place.checked_sub(1).and_then(|above| rows.record(above));
                    Some(Row::of(index, above, &store.record(index)?, content, databases))
                };
                json(places.map_while(row).collect::<Vec<_>>())
            }
            Request::RowAt { view, time } => {
                let record = store.row_at(content.end_of_ns(time));
                json(json!({ "row": views.rows(view, store)?.row_of(record) }))
            }
            Request::Find { view, text, from, backwards } => {
                let row = views.find(view, &text, from, backwards, databases.decoder(), store)?;
                json(json!({ "row": row }))
            }
            Request::Decode { index } => {
                let row = index.checked_sub(content.forgotten());
                let record = row.and_then(|row| store.record(row));
                let record = record.ok_or(EngineError::NoRecord(index as u64))?;
                json(databases.values(&record))
            }
            Request::Ids { at } => {
                json(identifiers::rows_at(content.end_of_ns(at), content, index, databases, sections))
            }
            Request::Bits { channel, id, extended, from, to } => {
                let place = Place { channel, id: identifier(id, extended)? };
                let (from, to) = window(from, to);
                json(identifiers::bits(place, from, to, store, index, databases, sections))
            }
            Request::Gaps { from, to } => {
                let (from, to) = window(from, to);
                let gaps =
                    content.gaps.all(content.end_ns()).filter(|gap| gap.to_ns >= from && gap.from_ns <= to);
                let gap = |gap: crate::gaps::Gap| GapAnswer {
                    from: content.seconds(gap.from_ns),
                    to: content.seconds(gap.to_ns),
                    channel: gap.channel,
                    stage: gap.stage,
                    count: gap.count,
                    at_least: gap.at_least,
                };
                json(gaps.map(gap).collect::<Vec<_>>())
            }
            Request::Interval { from, to } => {
                let (from, to) = (content.end_of_ns(Some(from)), content.end_of_ns(Some(to)));
                json(IntervalAnswer::from(interval::between(from, to, store)))
            }
            Request::Periods { channel, id, extended } => {
                let place = Place { channel, id: identifier(id, extended)? };
                json(identifiers::periods(place, content, index, sections))
            }
            Request::Conversations { from, to, limit } => {
                let (from, to) = window(from, to);
                json(conversations::found(content, databases.conversations(), from, to, limit.min(MOST_ROWS)))
            }
            Request::Fields { records } => {
                fields.read(store, !trace.progress().growing, records, || databases.conversations());
                json(fields.answer())
            }
            Request::FieldSeries { field, from, to, columns } => {
                let (from, to) = window(from, to);
                picture(&fields.picture(field, from, to, columns.min(MOST_COLUMNS))?, content, sections)
            }
            Request::Findings {} => json(findings::all(content, index, &*databases)),
            Request::Export { view, format, from, to } => {
                let rows = views.rows(view, store)?;
                json(export::export(rows, store, window(from, to), trace.name(), &format, sections)?)
            }
            Request::Series { signal, from, to, columns } => {
                let (from, to) = window(from, to);
                let signal = databases.signal(signal)?;
                self.series(signal, from, to, columns, sections)
            }
            Request::RawSeries(raw) => self.raw_series(&raw, sections),
            Request::Load { channel, from, to, columns } => {
                let (from, to) =
                    (from.unwrap_or(0.0), to.unwrap_or_else(|| content.seconds(content.end_ns())));
                let (from, to) = window(Some(from), Some(to));
                self.load(channel, from, to, columns, sections)
            }
            // Those that need no trace were answered before.
            _ => Err(EngineError::BadMessage),
        }
    }

    fn series(
        &mut self,
        signal: SignalPlace,
        from: i64,
        to: i64,
        columns: usize,
        sections: &mut Sections,
    ) -> Answer {
        let Some(place) = signal.place else { return picture(&Picture::EMPTY, self.content()?, sections) };
        let message = self.databases.decoder().message(signal.message).clone();
        let Self { trace, index, series, .. } = self;
        let content = trace.as_ref().map(|trace| &trace.content).ok_or(EngineError::NoTrace)?;
        let series = match series.entry(signal) {
            Entry::Occupied(known) => known.into_mut(),
            Entry::Vacant(new) => {
                new.insert(Series::new(message, signal.signal).ok_or(EngineError::NoSignal)?)
            }
        };
        let rows = index.rows(place);
        series.extend(&content.store, rows);
        let found = series.picture(&content.store, rows, from, to, columns.min(MOST_COLUMNS));
        picture(&found, content, sections)
    }

    fn raw_series(&mut self, raw: &request::RawSeries, sections: &mut Sections) -> Answer {
        let edit = &raw.edit;
        let place = Place { channel: edit.channel, id: identifier(edit.id, edit.extended)? };
        let SignalEdit { start_bit, bit_length, little_endian, signed, factor, offset, .. } = edit;
        let key = format!("{place:?} {start_bit} {bit_length} {little_endian} {signed} {factor} {offset}");
        let known = self.raw_series.iter().position(|(known, _)| *known == key);
        let (key, mut series) = match known {
            Some(known) => self.raw_series.remove(known),
            None => (key, Series::new(edit.message()?, 0).ok_or(EngineError::NoSignal)?),
        };
        let content = self.content()?;
        let rows = self.index.rows(place);
        series.extend(&content.store, rows);
        let (from, to) = (content.begin_ns(raw.from), content.end_of_ns(raw.to));
        let found = series.picture(&content.store, rows, from, to, raw.columns.min(MOST_COLUMNS));
        let answer = picture(&found, content, sections);
        // The one used last stands last.
        if self.raw_series.len() >= MOST_RAW {
            self.raw_series.remove(0);
        }
        self.raw_series.push((key, series));
        answer
    }

    fn load(&mut self, channel: u8, from: i64, to: i64, columns: usize, sections: &mut Sections) -> Answer {
        let Self { trace, rates, bits, .. } = self;
        let store = trace.as_ref().map(|trace| &trace.content.store).ok_or(EngineError::NoTrace)?;
        let bits = bits.entry(channel).or_default();
        bits.extend(channel, store);
        let (nominal, data) = rates.of(channel);
        let rates = nominal.map(|nominal| load::ChannelRates { nominal, data });
        let found = bits.columns(store, from, to, columns.clamp(1, MOST_COLUMNS), rates);
        let content = self.content()?;
        let times: Vec<_> = found.iter().map(|(time, _)| content.seconds(*time)).collect();
        let load: Vec<_> = found.iter().map(|(_, load)| *load).collect();
        json(json!({ "time": sections.floats(&times), "load": sections.floats(&load) }))
    }

    /// What an engineer should look at first, for programs in Rust.
    ///
    /// # Errors
    ///
    /// If no trace is open.
    pub fn findings(&mut self) -> Result<Vec<Finding>, EngineError> {
        self.extend_index();
        Ok(findings::all(self.content()?, &self.index, &self.databases))
    }
}

fn picture(picture: &Picture, content: &Content, sections: &mut Sections) -> Answer {
    let of = |value: fn(&crate::series::Block) -> f64| picture.columns.iter().map(value).collect::<Vec<_>>();
    let times = |time: fn(&crate::series::Block) -> i64| {
        picture.columns.iter().map(|block| content.seconds(time(block))).collect::<Vec<_>>()
    };
    json(SeriesAnswer {
        time: sections.floats(&times(|block| block.from_ns)),
        end: sections.floats(&times(|block| block.to_ns)),
        first: sections.floats(&of(|block| block.first)),
        min: sections.floats(&of(|block| block.min)),
        max: sections.floats(&of(|block| block.max)),
        last: sections.floats(&of(|block| block.last)),
        values: picture.values,
        exact: picture.exact,
    })
}
