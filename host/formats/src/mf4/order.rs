//! The order of records of several groups that share a stream.
//!
//! The standard orders the records of each group only. A logger that queues what it sent apart from what it received may
//! write a request behind its response.

use std::collections::BTreeMap;

use cantap_trace::TraceRecord;

use super::super::issue::Fault;
use super::place::{Ahead, Known};

/// What a part yields next.
pub(super) enum Item {
    Record(TraceRecord),
    LeftOut(&'static str),
    Fault(u64, Fault),
}

impl Item {
    /// The content of the record at a place, or what is wrong with it.
    pub fn of(record: Result<TraceRecord, Fault>, place: u64) -> Self {
        record.map_or_else(|fault| Self::Fault(place, fault), Self::Record)
    }
}

/// How far behind others a record is looked for.
const WINDOW_NS: i64 = 1_000_000_000;

/// Most records that are kept for that: a second of two full channels at 1 Mbit/s.
const MOST: usize = 1 << 14;

/// Records that were read ahead.
pub(super) struct Order {
    /// By time, and by number where that is the same.
    items: BTreeMap<(i64, u64), Item>,
    /// The last time of each group, which none of its records comes before.
    last: Vec<i64>,
    /// The latest of them.
    latest_ns: i64,
    count: u64,
    ended: bool,
}

impl Order {
    pub fn of(groups: usize) -> Self {
        let last = vec![i64::MIN; groups];
        Self { items: BTreeMap::new(), last, latest_ns: i64::MIN, count: 0, ended: false }
    }

    /// Whether what was read might still lack the first record.
    pub fn needs_more(&self) -> bool {
        let is_near = |first: i64| self.latest_ns.saturating_sub(first) <= WINDOW_NS;
        let is_open = self.items.first_key_value().is_none_or(|((first, _), _)| is_near(*first));
        !self.ended && self.items.len() < MOST && is_open
    }

    /// Takes what came next; without anything, it was the end.
    pub fn put(&mut self, item: Option<Item>, group: usize) {
        let Some(item) = item else {
            self.ended = true;
            return;
        };
        let time_ns = match (&item, self.last.get_mut(group)) {
            (Item::Record(record), Some(last)) => {
                // What goes back by more stays where it is: a clock was set, or its time is damaged.
                let is_far = self.latest_ns.saturating_sub(record.time_ns) > WINDOW_NS;
                *last = if is_far { self.latest_ns } else { record.time_ns.max(*last) };
                *last
            }
            _ => self.latest_ns,
        };
        self.latest_ns = self.latest_ns.max(time_ns);
        self.items.insert((time_ns, self.count), item);
        self.count += 1;
    }

    /// The first, and its number.
    pub fn pop(&mut self) -> Option<(u64, Item)> {
        self.items.pop_first().map(|((_, number), item)| (number, item))
    }

    /// How many were read.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// What is known now, to go on from here when what was read ahead has been handed out.
    pub fn known(&self) -> Known {
        Known { count: self.count, latest_ns: self.latest_ns, last: self.last.clone() }
    }

    /// The lowest number of those that were read ahead.
    pub fn first_number(&self) -> Option<u64> {
        self.items.keys().map(|(_, number)| *number).min()
    }

    /// What was read ahead since a mark, and `next` besides, which was taken out last; all have come after the mark.
    pub fn ahead(&self, mark: &Known, next: Option<u64>) -> Ahead {
        let mut numbers: Vec<_> = self.items.keys().map(|(_, number)| *number).chain(next).collect();
        numbers.sort_unstable();
        Ahead::of(mark.clone(), self.count, &numbers, self.ended)
    }

    /// As it was at a mark; `None` if that is of another number of groups.
    pub fn at(mark: &Known, groups: usize) -> Option<Self> {
        let Known { count, latest_ns, last } = mark.clone();
        (last.len() == groups).then(|| Self { items: BTreeMap::new(), last, latest_ns, count, ended: false })
    }

    /// Forgets all but these, which are sorted.
    pub fn keep(&mut self, numbers: &[u64], ended: bool) {
        self.items.retain(|(_, number), _| numbers.binary_search(number).is_ok());
        self.ended = ended;
    }
}
