//! The last records, within a budget of memory.

use std::collections::VecDeque;

use cantap::TraceRecord;

/// Records by number: the first ever has number 0, and a number stays what it is.
pub struct History {
    records: VecDeque<TraceRecord>,
    most: usize,
    first: u64,
}

impl History {
    /// Room for as many records as `bytes` hold, at least a thousand.
    pub fn new(bytes: usize) -> Self {
        let most = (bytes / size_of::<TraceRecord>()).max(1000);
        // Reserved at once: growing would copy everything, and the display would stand still meanwhile.
        Self { records: VecDeque::with_capacity(most), most, first: 0 }
    }

    /// Appends a record; the oldest makes room.
    pub fn push(&mut self, record: TraceRecord) {
        if self.records.len() == self.most {
            self.records.pop_front();
            self.first += 1;
        }
        self.records.push_back(record);
    }

    /// Number of the oldest record that is still there.
    pub fn first(&self) -> u64 {
        self.first
    }

    /// Number that the next record will have.
    pub fn end(&self) -> u64 {
        self.first + self.records.len() as u64
    }

    /// The record of that number, if it is still there.
    pub fn get(&self, number: u64) -> Option<&TraceRecord> {
        self.records.get(usize::try_from(number.checked_sub(self.first)?).ok()?)
    }

    /// Bytes in use, and bytes there may be.
    pub fn memory(&self) -> (usize, usize) {
        (self.records.len() * size_of::<TraceRecord>(), self.most * size_of::<TraceRecord>())
    }

    /// Forgets everything; numbers go on.
    pub fn clear(&mut self) {
        self.first = self.end();
        self.records.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap::TraceEvent;

    #[test]
    fn the_oldest_makes_room_and_numbers_stay() {
        let mut history = History::new(0);
        let capacity = history.records.capacity();
        for n in 0..2500 {
            history.push(TraceRecord {
                time_ns: n,
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
}
