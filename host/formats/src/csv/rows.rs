//! What the rows of the dialects have in common.

use super::super::issue::Fault;
use super::super::text::{self, NS_PER_S};

/// Splits a row into `N` columns.
pub(super) fn columns<const N: usize>(line: &[u8]) -> Result<[&[u8]; N], Fault> {
    let mut columns: [&[u8]; N] = [b""; N];
    let mut count = 0;
    for column in line.split(|byte| *byte == b',') {
        if let Some(slot) = columns.get_mut(count) {
            *slot = column.trim_ascii();
        }
        count += 1;
    }
    if count == N { Ok(columns) } else { Err(Fault::malformed(format!("{N} columns"), line)) }
}

/// Writes microseconds, or nanoseconds if there are any.
pub(super) fn push_time(out: &mut Vec<u8>, time_ns: i64) {
    text::push_time(out, time_ns, NS_PER_S, if time_ns % 1000 == 0 { 6 } else { 9 }, b'.');
}
