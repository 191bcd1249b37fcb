//! Rows of a table that may have more than a trace: what is wrong with one does not cost the others.

use arrow_array::{Array, RecordBatch};
use cantap_trace::TraceRecord;

use crate::bad::BadColumns;
use crate::records::{Text, records};
use crate::signals::VALUE;

/// What a row of a table is to a trace.
#[derive(Clone, Debug, PartialEq)]
pub enum Row {
    /// A record.
    Record(TraceRecord),
    /// A decoded value: such a table has the other events, but not the frames.
    Value,
    /// Something that a trace cannot hold: why.
    Bad(String),
}

/// As [`crate::records`], one by one, in the batch's order.
///
/// # Errors
/// If the columns themselves are not those of a trace. A row is not one of these.
pub fn rows(batch: &RecordBatch) -> Result<Vec<Row>, BadColumns> {
    let mut rows = Vec::with_capacity(batch.num_rows());
    let is_value = match batch.column_by_name("event") {
        Some(column) => Text::of(column.as_ref()).map_or_else(Vec::new, |event| {
            (0..column.len()).map(|row| event.at(row) == Some(VALUE)).collect()
        }),
        None => Vec::new(),
    };
    let mut from = 0;
    for run in is_value.chunk_by(|one, next| one == next) {
        if run[0] {
            rows.extend(run.iter().map(|_| Row::Value));
        } else {
            push_rows(&batch.slice(from, run.len()), &mut rows)?;
        }
        from += run.len();
    }
    if from < batch.num_rows() || batch.num_rows() == 0 {
        push_rows(&batch.slice(from, batch.num_rows() - from), &mut rows)?;
    }
    Ok(rows)
}

/// Those of a batch; halves of one with a bad row are tried apart, so that each bad row costs a logarithm of tries.
fn push_rows(batch: &RecordBatch, rows: &mut Vec<Row>) -> Result<(), BadColumns> {
    match records(batch) {
        Ok(records) => rows.extend(records.into_iter().map(Row::Record)),
        Err(BadColumns::Row { what, .. }) if batch.num_rows() == 1 => rows.push(Row::Bad(what)),
        Err(BadColumns::Row { .. }) => {
            let half = batch.num_rows() / 2;
            push_rows(&batch.slice(0, half), rows)?;
            push_rows(&batch.slice(half, batch.num_rows() - half), rows)?;
        }
        Err(error) => return Err(error),
    }
    Ok(())
}
