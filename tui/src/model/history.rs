//! The last records, within a memory budget, and which of them are listed.

use std::collections::VecDeque;

use cantap::{TraceEvent, TraceRecord};
use cantap_signals::condition::Condition;
use cantap_trace::filter::{Filter, passes};
use cantap_trace::{Interval, Moment};

use super::kept::Kept;

/// Records that are kept even with little memory.
const LEAST: usize = 1000;

/// Lists records only while a condition holds: one about signals holds from the frame that makes it true to the one that ends it.
pub struct While {
    /// As typed.
    text: String,
    condition: Condition,
    holds: bool,
}

impl While {
    /// It has seen no record yet.
    pub const fn new(text: String, condition: Condition) -> Self {
        Self { text, condition, holds: false }
    }

    /// Takes the next record. Returns whether it is listed.
    fn take(&mut self, record: &TraceRecord) -> bool {
        let holds = self.condition.holds(record);
        if self.condition.was_concerned() {
            self.holds = holds;
        }
        self.holds
    }
}

/// The past: every record, and a list of those accepted by the filters.
///
/// A position in the list counts from the first record ever listed, and stays the same while older ones are
/// dropped.
pub struct History {
    records: VecDeque<Kept>,
    most: usize,
    /// The CAN FD frames among the records, and the number of the first one: numbers continue, and wrap.
    fd: VecDeque<TraceEvent>,
    first_fd: u32,
    /// Number of the oldest record, counted from the first one ever.
    first: u64,
    filters: Vec<Filter>,
    /// What else must hold for a record to be listed. It has seen every record that is kept.
    only_while: Option<While>,
    /// Numbers of the listed records, if not all are.
    listed: VecDeque<u64>,
    /// Position of the first of them.
    first_listed: u64,
}

impl History {
    /// Room for as many records as fit in `bytes`, at least a thousand.
    pub fn new(bytes: usize) -> Self {
        let most = (bytes / size_of::<Kept>()).max(LEAST);
        // Reserved in advance: growing would copy everything, and freeze the display meanwhile.
        let records = VecDeque::with_capacity(most);
        let fd = VecDeque::new();
        Self {
            records,
            most,
            fd,
            first_fd: 0,
            first: 0,
            filters: Vec::new(),
            only_while: None,
            listed: VecDeque::new(),
            first_listed: 0,
        }
    }

    /// Appends a record; if necessary the oldest is dropped.
    pub fn push(&mut self, record: TraceRecord) {
        while self.records.len() == self.most
            || self.records.len() >= LEAST && self.kept_bytes() > self.memory().1
        {
            if self.records.pop_front().is_some_and(|record| record.is_fd()) {
                self.fd.pop_front();
                self.first_fd = self.first_fd.wrapping_add(1);
            }
            if self.listed.front() == Some(&self.first) {
                self.listed.pop_front();
                self.first_listed += 1;
            }
            self.first += 1;
        }
        let holds = self.only_while.as_mut().is_none_or(|only| only.take(&record));
        if self.is_narrowed() && holds && self.accepts(&record) {
            self.listed.push_back(self.first + self.records.len() as u64);
        }
        let kept = Kept::new(&record, self.first_fd.wrapping_add(self.fd.len() as u32));
        if kept.is_fd() {
            self.fd.push_back(record.event);
        }
        self.records.push_back(kept);
    }

    /// Whether not every record is listed.
    pub fn is_narrowed(&self) -> bool {
        !self.filters.is_empty() || self.only_while.is_some()
    }

    /// The condition that must hold for a record to be listed, as typed.
    pub fn only_while(&self) -> Option<&str> {
        self.only_while.as_ref().map(|only| only.text.as_str())
    }

    /// The filters.
    pub fn filters(&self) -> &[Filter] {
        &self.filters
    }

    /// Whether a record should be shown: without filters, or if one of them accepts it.
    pub fn accepts(&self, record: &TraceRecord) -> bool {
        passes(&self.filters, record)
    }

    /// Lists only what one of these accepts, including the past. Returns the new position of the record listed at
    /// `place`, or of the next one listed.
    pub fn set_filters(&mut self, filters: Vec<Filter>, place: Option<u64>) -> Option<u64> {
        self.narrow(filters, None, place)
    }

    /// The same, and of that only what arrives while a condition holds. What arrived before the oldest record that is kept is unknown to it.
    pub fn narrow(
        &mut self,
        filters: Vec<Filter>,
        mut only_while: Option<While>,
        place: Option<u64>,
    ) -> Option<u64> {
        let number = place.map(|place| self.number(place));
        self.filters = filters;
        let is_narrowed = !self.filters.is_empty() || only_while.is_some();
        let mut lists = |record: &TraceRecord| {
            let holds = only_while.as_mut().is_none_or(|only| only.take(record));
            holds && self.accepts(record)
        };
        let listed = if is_narrowed {
            let numbered = (self.first..).zip(&self.records);
            numbered
                .filter(|(_, kept)| self.whole(kept).is_some_and(|record| lists(&record)))
                .map(|(number, _)| number)
                .collect()
        } else {
            VecDeque::new()
        };
        self.listed = listed;
        self.only_while = only_while;
        self.first_listed = 0;
        number.map(|number| {
            if self.is_narrowed() {
                self.listed.partition_point(|listed| *listed < number) as u64
            } else {
                number
            }
        })
    }

    /// The number of the record listed at a position.
    fn number(&self, place: u64) -> u64 {
        if !self.is_narrowed() {
            return place;
        }
        let index = place.saturating_sub(self.first_listed) as usize;
        self.listed.get(index).copied().unwrap_or(self.first + self.records.len() as u64)
    }

    /// Position of the oldest listed record that is still there.
    pub fn first(&self) -> u64 {
        if self.is_narrowed() { self.first_listed } else { self.first }
    }

    /// Position that the next listed record will have.
    pub fn end(&self) -> u64 {
        if self.is_narrowed() {
            self.first_listed + self.listed.len() as u64
        } else {
            self.first + self.records.len() as u64
        }
    }

    /// The record listed at a position, if it is still there.
    pub fn get(&self, place: u64) -> Option<TraceRecord> {
        if place < self.first() || place >= self.end() {
            return None;
        }
        self.records
            .get(usize::try_from(self.number(place) - self.first).ok()?)
            .and_then(|kept| self.whole(kept))
    }

    /// Position of the first listed record that is not older than a time, otherwise of the last one.
    pub fn place_at(&self, time_ns: i64) -> Option<u64> {
        let (mut low, mut high) = (self.first(), self.end());
        while low < high {
            let middle = low + (high - low) / 2;
            match self.get(middle) {
                Some(record) if record.time_ns < time_ns => low = middle + 1,
                _ => high = middle,
            }
        }
        let last = self.end().checked_sub(1).filter(|last| *last >= self.first());
        last.map(|last| low.min(last))
    }

    /// How long it was from one time to another, listed records or not.
    pub fn interval(&self, from_ns: i64, to_ns: i64) -> Interval {
        let moment_at = |time_ns| {
            let place = self.records.partition_point(|kept| kept.moment().time_ns < time_ns);
            let earlier = self.records.range(..place).rev().map(Kept::moment);
            Moment::at(time_ns, earlier, self.records.range(place..).map(Kept::moment))
        };
        moment_at(to_ns).interval_since(moment_at(from_ns))
    }

    /// All records kept, listed or not, the oldest first.
    pub fn all(&self) -> impl Iterator<Item = TraceRecord> + use<'_> {
        self.records.iter().filter_map(|kept| self.whole(kept))
    }

    /// Number of records kept, listed or not.
    pub fn len(&self) -> usize {
        self.records.len()
    }

    /// Bytes in use, including the list, and the budget for records in bytes.
    pub fn memory(&self) -> (usize, usize) {
        (self.kept_bytes() + self.listed.len() * size_of::<u64>(), self.most * size_of::<Kept>())
    }

    fn whole(&self, kept: &Kept) -> Option<TraceRecord> {
        kept.record(|number| self.fd.get(number.wrapping_sub(self.first_fd) as usize).copied())
    }

    fn kept_bytes(&self) -> usize {
        self.records.len() * size_of::<Kept>() + self.fd.len() * size_of::<TraceEvent>()
    }

    /// Forgets everything but the filters; numbers and positions continue.
    pub fn clear(&mut self) {
        self.first += self.records.len() as u64;
        self.first_listed += self.listed.len() as u64;
        self.records.clear();
        self.first_fd = self.first_fd.wrapping_add(self.fd.len() as u32);
        self.fd.clear();
        self.listed.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap::Direction;
    use cantap_signals::{Decoder, Source};

    #[test]
    fn the_oldest_makes_room_and_numbers_stay() {
        let mut history = History::new(0);
        let capacity = history.records.capacity();
        for n in 0..2500 {
            history.push(TraceRecord {
                time_ns: n,
                device_ns: None,
                channel: 1,
                event: TraceEvent::ErrorsSuppressed { count: 0 },
            });
        }
        assert_eq!((history.first(), history.end()), (1500, 2500));
        assert_eq!(history.get(1499), None);
        assert_eq!(history.get(1500).unwrap().time_ns, 1500);
        assert_eq!(history.records.capacity(), capacity);
        history.clear();
        assert_eq!((history.first(), history.end(), history.get(2499)), (2500, 2500, None));
    }

    fn frame(n: i64) -> TraceRecord {
        let frame = if n % 3 == 0 { "123#" } else { "124#" }.parse().unwrap();
        let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
        TraceRecord { time_ns: n, device_ns: None, channel: 1, event }
    }

    #[test]
    fn a_record_is_found_by_its_time() {
        let mut history = History::new(0);
        assert_eq!(history.place_at(5), None);
        (0..2000).for_each(|n| history.push(frame(2 * n)));
        assert_eq!([0, 2100, 2101, 9999].map(|at| history.place_at(at)), [1000, 1050, 1051, 1999].map(Some));
        history.set_filters(vec!["123:7FF".parse().unwrap()], None);
        let at = history.place_at(3001).unwrap();
        assert!(history.get(at).unwrap().time_ns >= 3001 && history.get(at - 1).unwrap().time_ns < 3001);
    }

    #[test]
    fn fd_frames_make_room_by_their_size() {
        let mut history = History::new(size_of::<Kept>() * 4000);
        let event = |at: i64| {
            let frame = format!("123##1{}", "00".repeat(64)).parse().unwrap();
            let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
            TraceRecord { time_ns: at, device_ns: None, channel: 1, event }
        };
        (0..4000).for_each(|n| history.push(event(n)));
        let (used, most) = history.memory();
        assert!(used <= most + 200 || history.len() == 1000, "{used} of {most}, {} records", history.len());
        assert_eq!(history.get(history.end() - 1), Some(event(3999)));
        (4000..12_000).for_each(|n| history.push(frame(n)));
        assert_eq!(history.len(), 4000);
    }

    fn listed(history: &History) -> Vec<i64> {
        (history.first()..history.end()).map(|place| history.get(place).unwrap().time_ns).collect()
    }

    #[test]
    fn a_condition_lists_the_past_and_what_comes_while_it_holds() {
        let database = "BO_ 291 M: 8 N\n SG_ Speed : 0|8@1+ (1,0) [0|0] \"\" N\n";
        let database = cantap_signals::dbc::parse("m.dbc", database.as_bytes()).unwrap();
        let decoder = Decoder::new(vec![Source { channel: None, database }]);
        let only_while = |text: &str| {
            let condition = Condition::new(text, &decoder).unwrap();
            Some(While::new(text.to_owned(), condition))
        };
        let at = |n: i64| TraceRecord {
            event: TraceEvent::Frame {
                frame: if n % 2 == 0 { format!("123#{:02X}", n % 100) } else { "124#".to_owned() }
                    .parse()
                    .unwrap(),
                direction: Direction::Rx,
                late: false,
            },
            ..frame(n)
        };
        let mut history = History::new(0);
        (0..90).for_each(|n| history.push(at(n)));
        history.narrow(Vec::new(), only_while("Speed > 80"), None);
        assert_eq!(history.only_while(), Some("Speed > 80"));
        assert_eq!(listed(&history), (82..90).collect::<Vec<_>>());
        (90..104).for_each(|n| history.push(at(n)));
        // It ends with the frame that ends it.
        assert_eq!(listed(&history), (82..100).collect::<Vec<_>>());
        // With a filter, both must hold.
        history.narrow(vec!["124:7FF".parse().unwrap()], only_while("Speed > 80"), None);
        assert_eq!(listed(&history), (83..100).step_by(2).collect::<Vec<_>>());
        // One about frames concerns each alone.
        history.narrow(Vec::new(), only_while("len == 1 and byte[0] == 84"), None);
        assert_eq!(listed(&history), [84]);
        history.narrow(Vec::new(), None, None);
        assert!(!history.is_narrowed() && listed(&history).len() == 104);
    }

    #[test]
    fn filters_list_the_past_and_what_comes_and_keep_what_they_do_not_list() {
        let mut history = History::new(0);
        (0..10).for_each(|n| history.push(frame(n)));
        // The fifth record is no longer listed: the next one is.
        assert_eq!(history.set_filters(vec!["123:7FF".parse().unwrap()], Some(5)), Some(2));
        assert_eq!(listed(&history), [0, 3, 6, 9]);
        (10..1004).for_each(|n| history.push(frame(n)));
        assert_eq!((history.len(), history.first(), history.end()), (1000, 2, 335));
        assert_eq!(listed(&history), (6..1004).step_by(3).collect::<Vec<_>>());
        assert_eq!(history.set_filters(Vec::new(), Some(2)), Some(6));
        assert_eq!(listed(&history), (4..1004).collect::<Vec<_>>());
        // Nothing is listed, and a position after the end does not exist.
        assert_eq!(history.set_filters(vec!["7FF:7FF".parse().unwrap()], Some(500)), Some(0));
        assert_eq!((history.first(), history.end(), history.get(0)), (0, 0, None));
        history.clear();
        assert_eq!(history.set_filters(Vec::new(), None), None);
        assert_eq!((history.first(), history.end()), (1004, 1004));
    }
}
