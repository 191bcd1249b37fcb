//! What a run costs: cycles per exception and asleep, the longest time for which interrupts were
//! masked, and how full the receive FIFOs became. What a cycle count means depends on the bound (see
//! [`crate::timing`]).

use crate::cpu::State;

/// Exception numbers that are counted: the core's 16 and the chip's interrupts.
pub const EXCEPTIONS: usize = 128;

/// A period in which the watched interrupts ([`crate::Setup::watched`]) were masked.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MaskedWindow {
    /// When it began, in core cycles.
    pub start: u64,
    /// How long it lasted, in core cycles.
    pub cycles: u64,
    /// Where it ended.
    pub pc: u32,
    /// Whether one of them was waiting at its end.
    pub waited: bool,
}

/// What an exception cost, without what interrupted it.
#[derive(Clone, Debug, PartialEq)]
pub struct Task {
    /// The exception's name: that of its handler in the image.
    pub name: String,
    /// How often it ran.
    pub entries: u64,
    /// Its share of the time, in per cent.
    pub percent: f64,
    /// Its longest run, in microseconds.
    pub longest_us: f64,
}

/// A change of what the core does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// An exception was entered, perhaps within another.
    Enter(u16),
    /// An exception ended, and what it interrupted continues.
    Leave(u16),
    /// One exception ended and the next began at once.
    Chain(u16, u16),
}

/// Counters over a run, or since [`Probe::reset`].
#[derive(Clone, Debug)]
pub struct Probe {
    cycles: [u64; EXCEPTIONS],
    entries: [u64; EXCEPTIONS],
    longest_runs: [u64; EXCEPTIONS],
    asleep: u64,
    stalled: u64,
    since: u64,
    open_window: Option<u64>,
    longest: MaskedWindow,
    longest_with_one_waiting: MaskedWindow,
    fifo_max: [usize; 2],
    /// Exceptions under way, the innermost last, each with its own cycles so far.
    active: Vec<(u16, u64)>,
}

impl Default for Probe {
    fn default() -> Self {
        Self {
            cycles: [0; EXCEPTIONS],
            entries: [0; EXCEPTIONS],
            longest_runs: [0; EXCEPTIONS],
            asleep: 0,
            stalled: 0,
            since: 0,
            open_window: None,
            longest: MaskedWindow::default(),
            longest_with_one_waiting: MaskedWindow::default(),
            fifo_max: [0; 2],
            active: Vec::new(),
        }
    }
}

impl Probe {
    /// Starts counting at `now`. A masked window under way is not counted: start-up, for example, is
    /// masked from beginning to end.
    pub fn reset(&mut self, now: u64) {
        let active = std::mem::take(&mut self.active);
        *self = Self { since: now, active, ..Self::default() };
    }

    /// When counting began.
    pub fn since(&self) -> u64 {
        self.since
    }

    /// Core cycles spent in exception `number` itself, without what interrupted it; 0 is thread mode.
    pub fn cycles(&self, number: u16) -> u64 {
        self.cycles[usize::from(number)]
    }

    /// How often exception `number` was entered.
    pub fn entries(&self, number: u16) -> u64 {
        self.entries[usize::from(number)]
    }

    /// Core cycles of the longest run of exception `number`, without what interrupted it.
    pub fn longest_run(&self, number: u16) -> u64 {
        self.longest_runs[usize::from(number)]
    }

    /// Core cycles asleep.
    pub fn asleep(&self) -> u64 {
        self.asleep
    }

    /// Core cycles in which the core was stalled because flash was being written.
    pub fn stalled(&self) -> u64 {
        self.stalled
    }

    /// The longest period in which the watched interrupts were masked.
    pub fn longest_masked(&self) -> MaskedWindow {
        self.longest
    }

    /// The longest of these at the end of which an interrupt was waiting.
    pub fn longest_masked_with_one_waiting(&self) -> MaskedWindow {
        self.longest_with_one_waiting
    }

    /// The most frames that waited in a receive FIFO of controller 0 or 1.
    pub fn fifo_max(&self, controller: usize) -> usize {
        self.fifo_max[controller]
    }

    /// The share of the time until `now` in which the core was awake, in per cent.
    pub fn load_percent(&self, now: u64) -> f64 {
        let span = (now - self.since).max(1);
        100.0 - 100.0 * self.asleep as f64 / span as f64
    }

    pub(crate) fn slept(&mut self, cycles: u64) {
        self.asleep += cycles;
    }

    pub(crate) fn stood_still(&mut self, cycles: u64) {
        self.stalled += cycles;
    }

    pub(crate) fn fifo(&mut self, controller: usize, fill: usize) {
        self.fifo_max[controller] = self.fifo_max[controller].max(fill);
    }

    /// Accounts one step from `before` to `after`.
    pub(crate) fn step(&mut self, before: &State, after: &State, cycles: u64) -> Option<Change> {
        let (from, to) = (before.exception(), after.exception());
        if from == to {
            self.account(from, cycles);
            return None;
        }
        // Only an entry pushes a frame; a return or a chained entry takes one off or leaves it.
        let entered = after.sp.wrapping_add(0x20) <= before.sp;
        if entered {
            self.enter(to);
            self.account(to, cycles);
            return Some(Change::Enter(to));
        }
        self.account(from, cycles);
        if let Some((exception, own)) = self.active.pop() {
            let longest = &mut self.longest_runs[usize::from(exception) % EXCEPTIONS];
            *longest = own.max(*longest);
        }
        if self.active.last().map_or(0, |(exception, _)| *exception) == to {
            return Some(Change::Leave(from));
        }
        self.enter(to);
        Some(Change::Chain(from, to))
    }

    fn enter(&mut self, exception: u16) {
        self.entries[usize::from(exception) % EXCEPTIONS] += 1;
        self.active.push((exception, 0));
    }

    /// Counts cycles as an exception's own.
    fn account(&mut self, exception: u16, cycles: u64) {
        self.cycles[usize::from(exception) % EXCEPTIONS] += cycles;
        if let Some((_, own)) = self.active.last_mut() {
            *own += cycles;
        }
    }

    /// Follows the masks; returns a window that has just ended.
    pub(crate) fn masked(&mut self, masked: bool, waits: bool, now: u64, pc: u32) -> Option<MaskedWindow> {
        match (self.open_window, masked) {
            (None, true) => {
                self.open_window = Some(now);
                None
            }
            (Some(start), false) => {
                self.open_window = None;
                let window = MaskedWindow { start, cycles: now - start, pc, waited: waits };
                if window.cycles > self.longest.cycles {
                    self.longest = window;
                }
                if waits && window.cycles > self.longest_with_one_waiting.cycles {
                    self.longest_with_one_waiting = window;
                }
                Some(window)
            }
            _ => None,
        }
    }

    /// Whether a masked window is open.
    pub(crate) fn in_window(&self) -> bool {
        self.open_window.is_some()
    }
}
