//! A stream of records read on from a place.

use std::io;

use super::super::whole::Whole;
use super::apart::Values;
use super::order::Order;
use super::part::Part;
use super::place::{Cursor, MOST_AGAIN, Mark, SavedPart};

/// Records from one mark to the next, at least.
const MARK_EVERY: u64 = if cfg!(test) { 64 } else { 1024 };
/// Where something waits at one, so many records later is another try.
const TRY_EVERY: u64 = MARK_EVERY / 16;

impl Part {
    /// How far it was read, in place of `cursor`; false if something waits.
    fn cursor(&self, cursor: &mut Cursor) -> bool {
        if !self.waiting.is_empty() || !self.values.values().all(Values::is_empty) {
            return false;
        }
        cursor.at = self.at;
        cursor.counts.clone_from(&self.counts);
        cursor.values.clear();
        cursor.values.extend(self.values.values().map(Values::read));
        (cursor.without_values, cursor.first_without) = (self.without_values, self.first_without);
        (cursor.ended, cursor.is_cut, cursor.is_end_checked) = (self.ended, self.is_cut, self.is_end_checked);
        true
    }

    /// Remembers where reading is before what comes next.
    pub(super) fn remember(&mut self) {
        let mut cursor = self.before.take().unwrap_or_default();
        self.before = self.cursor(&mut cursor).then_some(cursor);
    }

    /// Sets a mark before what comes next, if it is time and nothing waits.
    pub(super) fn mark(&mut self, order: &Order) {
        let count = order.count();
        let is_due = |last: &Mark| last.known.count / MARK_EVERY < count / MARK_EVERY;
        if !count.is_multiple_of(TRY_EVERY) || !self.marks.back().is_none_or(is_due) {
            return;
        }
        let mut cursor = Cursor::default();
        if self.cursor(&mut cursor) {
            let first = self.first_ahead(order);
            while self.marks.get(1).is_some_and(|mark| mark.known.count <= first) {
                self.marks.pop_front();
            }
            self.marks.push_back(Mark { cursor, known: order.known() });
        }
    }

    /// The lowest number of what was read ahead.
    fn first_ahead(&self, order: &Order) -> u64 {
        order.first_number().into_iter().chain(self.next_number).min().unwrap_or(order.count())
    }

    /// A place to read on from; `None` if there is none here.
    pub(super) fn save(&self) -> Option<SavedPart> {
        let time_ns = self.time_ns;
        if let Some(order) = &self.order {
            let first = self.first_ahead(order);
            let mark = self.marks.iter().rev().find(|mark| mark.known.count <= first)?;
            (order.count() - mark.known.count <= MOST_AGAIN).then_some(())?;
            let ahead = order.ahead(&mark.known, self.next_number);
            return Some(SavedPart { cursor: mark.cursor.clone(), time_ns, ahead: Some(ahead) });
        }
        let cursor = if let Some((at, group)) = self.step_back {
            let mut cursor = Cursor::default();
            self.cursor(&mut cursor).then_some(())?;
            cursor.at = at;
            cursor.counts[group] -= 1;
            cursor
        } else if self.next.is_some() {
            self.before.clone()?
        } else {
            let mut cursor = Cursor::default();
            self.cursor(&mut cursor).then_some(cursor)?
        };
        Some(SavedPart { cursor, time_ns, ahead: None })
    }

    /// Goes to a place, before anything is read. False if it is none of this stream.
    pub(super) fn resume(&mut self, file: &mut Whole, saved: &SavedPart) -> io::Result<bool> {
        let SavedPart { cursor, time_ns, ahead } = saved;
        let is_one = cursor.counts.len() == self.counts.len()
            && cursor.values.len() == self.values.len()
            && cursor.at <= self.stream.len()
            && ahead.is_some() == self.order.is_some();
        if !is_one {
            return Ok(false);
        }
        (self.at, self.time_ns) = (cursor.at, *time_ns);
        self.counts.clone_from(&cursor.counts);
        for (values, read) in self.values.values_mut().zip(&cursor.values) {
            *values = Values::after(*read);
        }
        (self.without_values, self.first_without) = (cursor.without_values, cursor.first_without);
        (self.ended, self.is_cut, self.is_end_checked) = (cursor.ended, cursor.is_cut, cursor.is_end_checked);
        let Some(ahead) = ahead else { return Ok(true) };
        let groups = self.groups.len();
        let (Some(numbers), Some(mut order)) = (ahead.numbers(), Order::at(&ahead.known, groups)) else {
            return Ok(false);
        };
        self.marks = [Mark { cursor: cursor.clone(), known: ahead.known.clone() }].into();
        while order.count() < ahead.count {
            let before = order.count();
            self.put_next(&mut order, file)?;
            if order.count() == before {
                return Ok(false);
            }
        }
        if ahead.ended {
            self.put_next(&mut order, file)?;
        }
        if order.count() != ahead.count {
            return Ok(false);
        }
        order.keep(&numbers, ahead.ended);
        self.order = Some(order);
        Ok(true)
    }
}
