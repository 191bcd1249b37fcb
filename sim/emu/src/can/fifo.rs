//! A receive FIFO: three mailboxes, and what happens with the fourth frame (RM0090 Rev 21 §32.7.3).

use std::collections::VecDeque;

use cantap_can::Frame;

use super::identifier::identifier_word;

/// Mailboxes of a FIFO.
pub const DEPTH: usize = 3;

const FULL: u32 = 1 << 3;
const OVERRUN: u32 = 1 << 4;
const RELEASE: u32 = 1 << 5;

/// A received frame in its mailbox.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Entry {
    frame: Frame,
    filter: u8,
}

/// Receive FIFO 0 or 1.
#[derive(Clone, Debug, Default)]
pub struct Fifo {
    entries: VecDeque<Entry>,
    full: bool,
    overrun: bool,
    lost: u64,
    /// When the release under way is done: the oldest frame stays visible until then.
    releasing: Option<u64>,
}

impl Fifo {
    /// A frame passed the filters. If `locked` (RFLM), a full FIFO drops it; otherwise it replaces the
    /// newest. Returns whether a frame was lost.
    pub fn put(&mut self, frame: Frame, filter: u8, locked: bool) -> bool {
        let entry = Entry { frame, filter };
        let lost = self.entries.len() == DEPTH;
        if lost {
            self.overrun = true;
            self.lost += 1;
            if !locked {
                self.entries[DEPTH - 1] = entry;
            }
        } else {
            self.entries.push_back(entry);
        }
        // Set when the third frame is stored, cleared by software only.
        self.full |= self.entries.len() == DEPTH;
        lost
    }

    /// Frames waiting: 0 to 3.
    pub fn fill(&self) -> usize {
        self.entries.len()
    }

    /// Frames lost to overruns so far.
    pub fn lost(&self) -> u64 {
        self.lost
    }

    /// RFxR.
    pub fn status(&self) -> u32 {
        self.entries.len() as u32
            | if self.full { FULL } else { 0 }
            | if self.overrun { OVERRUN } else { 0 }
            | if self.releasing.is_some() { RELEASE } else { 0 }
    }

    /// A write to RFxR: releases the oldest frame, clears flags. `released_at` says when a release is done; 0 is at once.
    pub fn control(&mut self, value: u32, released_at: impl FnOnce() -> u64) {
        if value & FULL != 0 {
            self.full = false;
        }
        if value & OVERRUN != 0 {
            self.overrun = false;
        }
        if value & RELEASE != 0 && self.releasing.is_none() && !self.entries.is_empty() {
            self.releasing = Some(released_at());
            self.advance(|at| at == 0);
        }
    }

    /// Ends the release under way if its time `has_come`.
    pub fn advance(&mut self, has_come: impl FnOnce(u64) -> bool) {
        if self.releasing.is_some_and(has_come) {
            self.releasing = None;
            self.entries.pop_front();
        }
    }

    /// When the release under way is done.
    pub fn next_event(&self) -> Option<u64> {
        self.releasing
    }

    /// What kept a release from ending is over.
    pub fn hasten(&mut self) {
        self.releasing = self.releasing.map(|_| 0);
    }

    /// RIxR, RDTxR, RDLxR or RDHxR (0 to 3) of the oldest frame; zero if there is none. There is no time
    /// stamp: the time-triggered mode must not be used on these chips.
    pub fn mailbox(&self, register: u32) -> u32 {
        let Some(Entry { frame, filter }) = self.entries.front() else { return 0 };
        let data = frame.padded_data();
        let word = |at: usize| u32::from_le_bytes([data[at], data[at + 1], data[at + 2], data[at + 3]]);
        match register {
            0 => identifier_word(frame),
            1 => u32::from(*filter) << 8 | u32::from(frame.dlc()),
            2 => word(0),
            _ => word(4),
        }
    }

    /// Whether the interrupt is asserted, given IER's message-pending, full and overrun enables.
    pub fn irq(&self, pending: bool, full: bool, overrun: bool) -> bool {
        pending && !self.entries.is_empty() || full && self.full || overrun && self.overrun
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fill(locked: bool) -> Fifo {
        let mut fifo = Fifo::default();
        for id in 1..=5u32 {
            let frame = format!("{id:03X}#").parse().unwrap();
            assert_eq!(fifo.put(frame, 0, locked), id > 3);
        }
        fifo
    }

    fn drain(fifo: &mut Fifo) -> Vec<u32> {
        let mut ids = Vec::new();
        while fifo.fill() > 0 {
            ids.push(fifo.mailbox(0) >> 21);
            fifo.control(RELEASE, || 0);
        }
        ids
    }

    #[test]
    fn an_overrun_keeps_the_newest_frame_unless_locked() {
        let mut fifo = fill(false);
        assert_eq!(fifo.status(), 3 | FULL | OVERRUN);
        assert_eq!(fifo.lost(), 2);
        assert_eq!(drain(&mut fifo), [1, 2, 5]);
        let mut fifo = fill(true);
        assert_eq!(drain(&mut fifo), [1, 2, 3]);
    }

    #[test]
    fn a_frame_stays_visible_and_in_the_way_until_its_release_is_done() {
        let mut fifo = fill(true);
        fifo.control(RELEASE | FULL | OVERRUN, || 100);
        fifo.control(RELEASE, || unreachable!("one is under way"));
        assert_eq!((fifo.status(), fifo.mailbox(0) >> 21), (3 | RELEASE, 1));
        assert!(fifo.put("007#".parse().unwrap(), 0, true), "there is no room yet");
        fifo.advance(|at| at <= 99);
        assert_eq!(fifo.fill(), 3);
        fifo.advance(|at| at <= 100);
        assert_eq!((fifo.status(), fifo.mailbox(0) >> 21), (2 | FULL | OVERRUN, 2));
    }

    #[test]
    fn full_and_overrun_stay_until_cleared() {
        let mut fifo = fill(true);
        drain(&mut fifo);
        assert_eq!(fifo.status(), FULL | OVERRUN);
        assert!(
            fifo.irq(false, true, false) && fifo.irq(false, false, true) && !fifo.irq(true, false, false)
        );
        fifo.control(OVERRUN, || 0);
        assert_eq!(fifo.status(), FULL);
        fifo.control(FULL, || 0);
        assert_eq!(fifo.status(), 0);
    }
}
