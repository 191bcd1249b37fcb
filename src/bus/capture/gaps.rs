//! Where in a FIFO's order frames were lost.
//!
//! A full FIFO keeps the frames that it holds and drops those that follow. So a loss comes after the frames that were in the FIFO then, and
//! before those that came in once there was room again. The controller only says that there was one. As a rule it is clear where: nothing
//! was taken out since the last look, or all of it within a fraction of a frame. If the controller takes long to release what was taken, it
//! is not, and then every place is marked at which frames may be missing.

use crate::ports::Traffic;

/// Frames of a FIFO.
const DEPTH: u8 = 3;
/// The bits of [`Gaps::marks`] for a loss before the next frame, and for one that there may be.
const CERTAIN: u8 = 1 << 0;
const POSSIBLE: u8 = 1 << 4;

/// What is known about the place before the next frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Gap {
    /// Nothing is missing.
    None,
    /// A frame is missing, or more.
    Certain,
    /// Frames may be missing.
    Possible,
}

/// What was taken out since the last look at the FIFO.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Since {
    /// Nothing: whatever waits was there before a loss.
    Nothing,
    /// Frames, at once, apart from so many that were left.
    Prompt(u8),
    /// Frames, of which one took long, apart from so many that were left.
    Late(u8),
}

/// The places of one FIFO.
#[derive(Clone, Copy, Debug)]
pub struct Gaps {
    /// Bit n: a loss after n more frames; bit 4 + n: perhaps one.
    marks: u8,
    since: Since,
}

impl Gaps {
    /// None.
    pub const fn new() -> Self {
        Self { marks: 0, since: Since::Nothing }
    }

    /// The FIFO overran since the last look.
    #[cold]
    #[inline(never)]
    pub fn overrun(&mut self, traffic: &impl Traffic) {
        let waiting = traffic.pending().min(DEPTH);
        self.marks |= match self.since {
            // The next frame would have come much later. Unless the FIFO is full again, the loss was before it.
            Since::Prompt(left) if waiting < DEPTH => CERTAIN << left.min(waiting),
            Since::Prompt(left) | Since::Late(left) if left < waiting => {
                (left..=waiting).map(|place| POSSIBLE << place).sum()
            }
            _ => CERTAIN << waiting,
        };
    }

    /// What is missing before the next frame; forgets it.
    pub const fn here(&mut self) -> Gap {
        if self.marks & (CERTAIN | POSSIBLE) == 0 {
            return Gap::None;
        }
        let certain = self.marks & CERTAIN != 0;
        self.marks &= !(CERTAIN | POSSIBLE);
        if certain { Gap::Certain } else { Gap::Possible }
    }

    /// A frame was taken out. Returns whether to look what is missing before the next.
    #[inline]
    pub const fn taken(&mut self) -> bool {
        if self.marks == 0 {
            return false;
        }
        // Bit 4 is not to become bit 3.
        self.marks = self.marks >> 1 & !(1 << DEPTH);
        true
    }

    /// Of the `pending` frames that a look found, one being released included, so many were taken out.
    #[inline]
    pub fn looked(&mut self, pending: u8, taken: u8, traffic: &impl Traffic) {
        self.since =
            if taken == pending { Since::Prompt(0) } else { Since::Late(traffic.pending().min(DEPTH)) };
    }

    /// The FIFO is empty, and nothing is being released.
    #[inline]
    pub const fn emptied(&mut self) {
        self.since = Since::Nothing;
    }

    /// Nothing more will be taken out: whether a loss has not been recorded yet, for certain or perhaps. Forgets everything.
    pub const fn rest(&mut self) -> Gap {
        let marks = self.marks;
        *self = Self::new();
        if marks == 0 {
            Gap::None
        } else if marks < POSSIBLE {
            Gap::Certain
        } else {
            Gap::Possible
        }
    }
}
