//! Marks of USB's start of frame: once a second, the stamp timer's value at the start of a numbered frame.
//!
//! The hardware latches the timer at each SOF token; nothing here has a latency of its own. What can go wrong is the pairing: the
//! frame's number and the latched time are in two registers, and another SOF may come between the two reads. So the latch is read both
//! before and after the number, and readings near either edge of a frame are not trusted, because one register may be updated before
//! the other.
//!
//! Whether the numbers make sense from mark to mark is checked by the host, which has the time and the arithmetic for it.

use cantap_wire::Event;

use crate::{TICK_HZ, TICKS_PER_MS, TICKS_PER_US};

/// The least distance from a SOF at which a reading is trusted. The pulse that latches the timer is twelve system clocks long (RM0090,
/// "Peripheral SOFs"), and two microseconds are 288 of them: by then the slower of the two registers has followed.
const EDGE_TICKS: u32 = 2 * TICKS_PER_US;
/// Time from one mark to the next.
const EVERY_TICKS: u32 = TICK_HZ;

/// What the hardware latched at the last start of frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SofReading {
    /// The stamp timer at the last SOF, read before and after the frame's number.
    pub latched: [u32; 2],
    /// The frame's number, 11 bits.
    pub frame: u16,
    /// The stamp timer after these reads.
    pub now: u32,
    /// More than one SOF came since the last reading.
    pub several: bool,
}

/// A mark, and its time by the stamp timer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SofMark {
    /// [`Event::SofMark`].
    pub event: Event,
    /// When the frame started.
    pub at: u32,
}

/// Chooses what becomes a mark.
pub struct SofMarks {
    last: Option<u32>,
    doubled: u16,
}

impl SofMarks {
    /// The first mark is due at once.
    pub const fn new() -> Self {
        Self { last: None, doubled: 0 }
    }

    /// Call once a millisecond, with what was latched since the last call. Returns a mark if one is due and the reading
    /// is beyond doubt; otherwise the next call may return it.
    pub fn tick(&mut self, reading: Option<SofReading>) -> Option<SofMark> {
        let SofReading { latched: [at, again], frame, now, several } = reading?;
        self.doubled = self.doubled.saturating_add(u16::from(several));
        // A latch a whole frame old means that no SOF has followed: the bus is silent.
        let whole = at == again && (EDGE_TICKS..TICKS_PER_MS - EDGE_TICKS).contains(&now.wrapping_sub(at));
        let due = self.last.is_none_or(|last| now.wrapping_sub(last) >= EVERY_TICKS);
        if !(whole && due) {
            return None;
        }
        self.last = Some(now);
        let doubled = core::mem::take(&mut self.doubled);
        Some(SofMark { event: Event::SofMark { frame, doubled }, at })
    }
}

impl Default for SofMarks {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A reading `after` ticks after the SOF at `at`.
    fn reading(at: u32, frame: u16, after: u32) -> SofReading {
        SofReading { latched: [at; 2], frame, now: at.wrapping_add(after), several: false }
    }

    /// Frame `n` by a timer that began at `start`.
    fn tick(marks: &mut SofMarks, start: u32, n: u32, after: u32) -> Option<(u16, u32)> {
        let at = start.wrapping_add(n * TICKS_PER_MS);
        let mark = marks.tick(Some(reading(at, n as u16 & 0x7FF, after)))?;
        let Event::SofMark { frame, .. } = mark.event else { panic!("{mark:?}") };
        Some((frame, mark.at))
    }

    #[test]
    fn marks_come_once_a_second_over_wraps_of_frame_number_and_timer() {
        let mut marks = SofMarks::new();
        let start = 0_u32.wrapping_sub(2_500 * TICKS_PER_MS);
        let seen: Vec<_> = (0..5_500).filter_map(|n| tick(&mut marks, start, n, 6_000)).collect();
        let expected: Vec<_> = [0, 1000, 2000, 3000, 4000, 5000]
            .map(|n: u32| (n as u16 % 2048, start.wrapping_add(n * TICKS_PER_MS)))
            .to_vec();
        assert_eq!(seen, expected);
    }

    #[test]
    fn neither_edge_of_a_frame_is_trusted_and_the_next_millisecond_is_tried() {
        let mut marks = SofMarks::new();
        for (n, after) in
            [0, EDGE_TICKS - 1, TICKS_PER_MS - EDGE_TICKS, TICKS_PER_MS, u32::MAX].into_iter().enumerate()
        {
            assert_eq!(tick(&mut marks, 0, n as u32, after), None, "{after} ticks after");
        }
        assert_eq!(tick(&mut marks, 0, 5, EDGE_TICKS), Some((5, 5 * TICKS_PER_MS)));
    }

    #[test]
    fn a_sof_between_the_readings_makes_no_mark() {
        let mut marks = SofMarks::new();
        let torn =
            SofReading { latched: [0, TICKS_PER_MS], frame: 1, now: TICKS_PER_MS + 100, several: false };
        assert_eq!(marks.tick(Some(torn)), None);
        assert_eq!(marks.tick(None), None);
        assert_eq!(tick(&mut marks, 0, 2, 100), Some((2, 2 * TICKS_PER_MS)));
    }

    #[test]
    fn sofs_that_come_twice_are_told() {
        let mut marks = SofMarks::new();
        let twice = |n: u32| Some(SofReading { several: true, ..reading(n * TICKS_PER_MS, n as u16, 100) });
        let seen: Vec<_> = (0..2001).filter_map(|n| marks.tick(twice(n))).map(|mark| mark.event).collect();
        let expected = [(0, 1), (1000, 1000), (2000, 1000)];
        assert_eq!(seen, expected.map(|(frame, doubled)| Event::SofMark { frame, doubled }));
    }
}
