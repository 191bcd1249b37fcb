//! Where reading can go on in a file that is read at many places: what an index keeps of its streams of records.
//!
//! Where records of several groups are put in order, some were read ahead. They are not kept: they are read once more, from a mark before them on, without
//! those that had been handed out.

use serde::{Deserialize, Serialize};

use super::super::codec::PLAIN_BATCH;

/// Reading can go on after each so many records, however they are read.
pub(super) const EVERY: u64 = if cfg!(test) { 32 } else { PLAIN_BATCH as u64 };

/// Most records that are read once more; a damaged place may ask for any number.
pub(super) const MOST_AGAIN: u64 = 1 << 20;

/// A place in a file.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Saved {
    /// What was handed out before it.
    pub items: u64,
    /// What [`Decode::position`](super::super::codec::Decode::position) says there.
    pub position: u64,
    pub parts: Vec<SavedPart>,
}

/// A place in a stream.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct SavedPart {
    pub cursor: Cursor,
    /// The time of what comes next, if that has none itself.
    pub time_ns: i64,
    pub ahead: Option<Ahead>,
}

/// How far a stream was read, between two records none of which waits for anything.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct Cursor {
    pub at: u64,
    /// Number of records of each group.
    pub counts: Vec<u64>,
    /// Of each group of values: the place of the next, how many came, how many were requested.
    pub values: Vec<(u64, u64, u64)>,
    pub without_values: u64,
    pub first_without: u64,
    pub ended: bool,
    pub is_cut: bool,
    pub is_end_checked: bool,
}

/// What was known of the order when reading was at a cursor.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Known {
    /// How many records had been read.
    pub count: u64,
    pub latest_ns: i64,
    /// The last time of each group.
    pub last: Vec<i64>,
}

/// What was read ahead, from the cursor on.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Ahead {
    pub known: Known,
    /// How many records have been read altogether.
    pub count: u64,
    /// Those of them still to be handed out: how many are left out before them, and how many follow each other.
    pub runs: Vec<(u32, u32)>,
    pub ended: bool,
}

impl Ahead {
    /// With the numbers still to be handed out, in order.
    pub(super) fn of(known: Known, count: u64, numbers: &[u64], ended: bool) -> Self {
        let (mut runs, mut next) = (Vec::<(u32, u32)>::new(), known.count);
        for &number in numbers {
            match runs.last_mut() {
                Some((_, len)) if number == next => *len += 1,
                _ => runs.push(((number - next) as u32, 1)),
            }
            next = number + 1;
        }
        Self { known, count, runs, ended }
    }

    /// The numbers still to be handed out; `None` if there is no sense in them.
    pub(super) fn numbers(&self) -> Option<Vec<u64>> {
        let (mut numbers, mut next) = (Vec::new(), self.known.count);
        (self.count.checked_sub(next)? <= MOST_AGAIN).then_some(())?;
        for (skipped, len) in &self.runs {
            let begin = next.checked_add(u64::from(*skipped))?;
            next = begin.checked_add(u64::from(*len)).filter(|next| *next <= self.count)?;
            numbers.extend(begin..next);
        }
        Some(numbers)
    }
}

/// A cursor to go on from where records are put in order.
pub(super) struct Mark {
    pub cursor: Cursor,
    pub known: Known,
}
