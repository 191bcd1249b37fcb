//! Operations on a whole trace.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use arrow_array::{ArrayRef, RecordBatch, UInt64Array};
use arrow_schema::{DataType, Field, Schema};
use cantap_analysis::stats::{Options as StatOptions, Statistics};
use cantap_columns::{BATCH_ROWS, FrameColumns, MessageTables};
use cantap_formats::Format;
use cantap_signals::condition::Condition;
use cantap_signals::search::{DataPattern, IdPattern, Search};
use cantap_signals::{Decoder, Selection};
use pyo3::prelude::*;

use crate::ahead::Ahead;
use crate::channels::{Channels, Named};
use crate::database::Database;
use crate::error::Error;
use crate::grammar::{BitRate, OfTrace, Seconds};
use crate::number::Whole;
use crate::report::{Report, from_json};
use crate::scan::{warn, warn_if_nothing_decoded, warning};
use crate::selection::{only, selection};
use crate::source::{Options, TraceSource};
use crate::table::{Table, batches_of};

/// Reads a trace to the end, some records at a time; Ctrl-C stops it.
pub fn walk(
    py: Python<'_>,
    options: &Options,
    report: &Report,
    mut take: impl FnMut(&[cantap::TraceRecord]) -> Result<(), Error> + Send,
) -> PyResult<()> {
    let for_source = report.clone();
    let mut source = py.detach(|| TraceSource::open(options, for_source))?;
    let mut records = Vec::new();
    while py.detach(|| -> Result<bool, Error> {
        let more = source.next_batch(&mut records)?;
        take(&records)?;
        Ok(more)
    })? {
        py.check_signals()?;
    }
    source.tell();
    warn(py, report, &options.named_channels())
}

/// Statistics of a trace, as from `cantap stats --json`.
#[pyfunction]
pub fn stats(
    py: Python<'_>,
    options: Options,
    bitrates: Vec<(Option<OfTrace>, BitRate)>,
    data_bitrates: Vec<(Option<OfTrace>, BitRate)>,
    window: Seconds,
) -> PyResult<Bound<'_, PyAny>> {
    let all = |rates: &[(Option<OfTrace>, BitRate)]| {
        rates.iter().find(|(channel, _)| channel.is_none()).map(|(_, rate)| rate.0)
    };
    let of_channels = |rates: &[(Option<OfTrace>, BitRate)]| {
        rates.iter().filter_map(|(channel, rate)| Some(((*channel)?.0, rate.0))).collect::<Vec<_>>()
    };
    let window = window.duration("window length")?;
    let statistics = Statistics::new(StatOptions {
        bitrate_bps: all(&bitrates),
        channel_bitrate_bps: of_channels(&bitrates),
        data_bitrate_bps: all(&data_bitrates),
        channel_data_bitrate_bps: of_channels(&data_bitrates),
        window,
        ..StatOptions::default()
    });
    let mut statistics = statistics.map_err(Error::argument)?;
    let report = Report::default();
    walk(py, &options, &report, |records| {
        for record in records {
            statistics.push(record);
        }
        Ok(())
    })?;
    statistics.finish();
    let rates = [("bitrate", &bitrates), ("data_bitrate", &data_bitrates)];
    let named = rates
        .map(|(argument, rates)| Named::by(argument, of_channels(rates).iter().map(|(channel, _)| *channel)));
    let counts = report.now();
    for named in named.iter().flatten() {
        if let Some(text) = named.missing_in(&counts.file, &counts.channels) {
            warning(py, &text)?;
        }
    }
    let mut summary = serde_json::to_value(statistics.summary()).unwrap_or_default();
    summary["issues"] = counts.issues.into();
    summary["left_out"] = serde_json::to_value(&counts.left_out).unwrap_or_default();
    summary["missing_pct"] = counts.missing_pct().into();
    from_json(py, &summary.to_string())
}

/// Where a part of a trace begins and ends, in nanoseconds since 1970, and how many records it has.
type TimePart = (Option<i64>, Option<i64>, u64);

/// A trace as parts that follow each other in time; `None` if it is not to be divided.
#[pyfunction]
fn divide(
    py: Python<'_>,
    path: PathBuf,
    options: Options,
    part_bytes: u64,
) -> PyResult<Option<Vec<TimePart>>> {
    let read = options.read()?;
    let found = py.detach(|| cantap_formats::divide(&path, &read, part_bytes)).map_err(Error::from)?;
    Ok(found.map(|parts| parts.iter().map(|part| (part.start_ns, part.end_ns, part.records)).collect()))
}

/// What Python's half makes a mapping of: tables by name, and the events.
type Tables = (Vec<(String, Table)>, Table);

/// A trace that a thread reads ahead, to be decoded: it begins before the database is loaded, which takes as long as many frames.
#[pyclass(module = "cantap", frozen)]
pub struct Reading {
    ahead: Mutex<Option<Ahead>>,
    report: Report,
    named: Vec<Named>,
}

#[pymethods]
impl Reading {
    #[new]
    fn new(py: Python<'_>, options: Options) -> PyResult<Self> {
        let report = Report::default();
        let for_source = report.clone();
        let ahead = py.detach(|| Ahead::read(TraceSource::open(&options, for_source)?))?;
        Ok(Self { ahead: Mutex::new(Some(ahead)), report, named: options.named_channels() })
    }

    /// The trace as a table for each message, and one for events other than frames; once. With `warns` it is a warning if nothing could
    /// be decoded.
    #[pyo3(signature = (db, signals, warns=true))]
    fn decode(
        &self,
        py: Python<'_>,
        db: Py<Database>,
        signals: Vec<String>,
        warns: bool,
    ) -> PyResult<(Tables, Py<Report>)> {
        let decoder = db.get().selecting(&signals)?;
        let chosen = selection(&signals)?;
        let ahead = self.ahead.lock().unwrap_or_else(PoisonError::into_inner).take();
        let mut ahead = ahead.ok_or_else(|| Error::argument("this trace has been decoded already"))?;
        let mut tables = MessageTables::new(Arc::clone(&decoder), chosen.is_some());
        // Of all files up to each.
        let (mut file, mut decoded) = (0, Vec::new());
        let mut next = || -> Result<bool, Error> {
            let Some(batch) = ahead.next()? else { return Ok(false) };
            if batch.file != file {
                file = batch.file;
                decoded.push(tables.counts());
            }
            tables.push_frames(&batch.frames);
            batch.records.iter().for_each(|record| tables.push(record));
            ahead.give_back(batch);
            Ok(true)
        };
        while py.detach(&mut next)? {
            py.check_signals()?;
        }
        let named: Vec<_> = self.named.iter().cloned().chain(db.get().named_channels()).collect();
        warn(py, &self.report, &named)?;
        decoded.push(py.detach(|| tables.counts()));
        self.report.set_decoded(&decoded);
        if warns {
            warn_if_nothing_decoded(py, &self.report)?;
        }
        Ok((finish(&decoder, tables, chosen.as_ref()), Py::new(py, self.report.clone())?))
    }
}

/// The same for a table of records.
#[pyfunction]
pub fn decode_table(
    py: Python<'_>,
    table: &Bound<'_, PyAny>,
    db: Py<Database>,
    signals: Vec<String>,
) -> PyResult<Tables> {
    let decoder = db.get().selecting(&signals)?;
    let chosen = selection(&signals)?;
    let mut tables = MessageTables::new(Arc::clone(&decoder), chosen.is_some());
    let mut rows = 0;
    let mut channels = Channels::default();
    for batch in batches_of(table)? {
        py.detach(|| {
            each_part(batch, &mut rows, |records| {
                for record in records {
                    channels.insert(record.channel);
                    tables.push(record);
                }
                Ok(())
            })
        })?;
        py.check_signals()?;
    }
    if let Some(text) = db.get().named_channels().and_then(|named| named.missing_in("the table", &channels)) {
        warning(py, &text)?;
    }
    Ok(finish(&decoder, tables, chosen.as_ref()))
}

/// The tables by their messages' names, in the database's order. Of two with one name the later has its identifier behind it.
fn finish(decoder: &Decoder, tables: MessageTables, chosen: Option<&Selection>) -> Tables {
    let (tables, mut events) = tables.finish();
    let mut named: Vec<(String, Table)> = Vec::new();
    for (reference, mut table) in tables {
        let (channel, message) = (decoder.channel(reference), decoder.message(reference));
        let mut name = message.name.clone();
        if named.iter().any(|(other, _)| *other == name) {
            name = format!("{name}-{}", message.id);
        }
        if let Some(channel) = channel.filter(|_| named.iter().any(|(other, _)| *other == name)) {
            name = format!("{name}-{channel}");
        }
        let batch = table.take();
        let batch = chosen.map_or_else(|| batch.clone(), |chosen| only(&batch, message, chosen));
        named.push((name, Table::of_batch(batch)));
    }
    (named, Table::of_batch(events.take()))
}

/// The records that match, each with its position in the trace.
#[pyfunction]
pub fn search(
    py: Python<'_>,
    options: Options,
    condition: Option<String>,
    ids: Vec<String>,
    data: Vec<String>,
    max_count: Option<Whole<u64>>,
) -> PyResult<Table> {
    let decoder = options.decoder()?.unwrap_or_else(|| Arc::new(Decoder::new(Vec::new())));
    let condition = condition.map(|text| Condition::new(&text, &decoder)).transpose().map_err(Error::from)?;
    let ids = ids
        .iter()
        .map(|text| text.parse())
        .collect::<Result<Vec<IdPattern>, _>>()
        .map_err(Error::argument)?;
    let data = data.iter().map(|text| text.parse()).collect::<Result<Vec<DataPattern>, _>>();
    let data = data.map_err(Error::argument)?;
    if condition.is_none() && ids.is_empty() && data.is_empty() {
        return Err(Error::argument("nothing to look for; give a condition, id= or data=").into());
    }
    let mut search = Search { ids, data, condition };
    let (mut found, mut places) = (FrameColumns::default(), Vec::new());
    let mut place = 0_u64;
    let report = Report::default();
    walk(py, &options, &report, |records| {
        for record in records {
            let is_wanted = max_count.is_none_or(|most| (places.len() as u64) < most.0);
            if search.finds(record) && is_wanted {
                found.push(record);
                places.push(place);
            }
            place += 1;
        }
        Ok(())
    })?;
    let batch = found.take();
    let mut fields: Vec<_> = batch.schema().fields().iter().cloned().collect();
    fields.push(Arc::new(Field::new("place", DataType::UInt64, false)));
    let mut columns = batch.columns().to_vec();
    columns.push(Arc::new(UInt64Array::from(places)) as ArrayRef);
    let schema = Arc::new(Schema::new(fields));
    let batch = RecordBatch::try_new(Arc::clone(&schema), columns)
        .map_err(|error| Error::Format(error.to_string()))?;
    Ok(Table::new(schema, vec![batch], Some(Py::new(py, report)?)))
}

/// Converts a batch back to records, a part at a time: other programs make batches of any size. `rows` counts those of all batches.
pub fn each_part(
    batch: Result<RecordBatch, arrow_schema::ArrowError>,
    rows: &mut usize,
    mut take: impl FnMut(&[cantap::TraceRecord]) -> Result<(), Error>,
) -> Result<(), Error> {
    let batch = batch.map_err(|error| Error::Format(error.to_string()))?;
    for at in (0..batch.num_rows()).step_by(BATCH_ROWS) {
        let part = batch.slice(at, BATCH_ROWS.min(batch.num_rows() - at));
        let records = cantap_columns::records(&part).map_err(|error| error.after(*rows))?;
        take(&records)?;
        *rows += records.len();
    }
    Ok(())
}

/// Whether a file's name is that of a trace. Tables of decoded signals end in `.parquet`, too, and much else does in `.json`: such a file is only read if
/// it is named itself.
#[pyfunction]
fn is_trace_name(name: PathBuf) -> bool {
    Format::of_path(&name).is_ok_and(|format| !matches!(format, Format::Parquet | Format::Json))
}

/// Adds the functions to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<Reading>()?;
    module.add_function(wrap_pyfunction!(is_trace_name, module)?)?;
    module.add_function(wrap_pyfunction!(decode_table, module)?)?;
    module.add_function(wrap_pyfunction!(divide, module)?)?;
    module.add_function(wrap_pyfunction!(search, module)?)?;
    module.add_function(wrap_pyfunction!(stats, module)?)
}
