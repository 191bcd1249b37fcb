//! Reading flash through the accelerator (RM0090 Rev 21 §3.5.2): one line of 128 bits at a time, the line in use,
//! the next one read ahead, and two caches.
//!
//! Where the manual leaves something open, the slower possibility is assumed: a read that has begun is not aborted, no
//! matter what is requested next; there is one read at a time; and a jump from the end of a line waits for the next
//! line, which the core has already requested.

use super::speeds::Speeds;

/// 128 bits.
const LINE_BYTES: u32 = 16;
const INSTRUCTION_LINES: usize = 64;
const DATA_LINES: usize = 8;
/// The core fetches whole words, two ahead of what it executes: they fill the decode and fetch stages of its
/// three-stage pipeline.
const AHEAD_BYTES: u32 = 8;

/// The lines that a cache holds, the least recently used first.
#[derive(Debug)]
struct Lines<const N: usize> {
    lines: [u32; N],
    used: usize,
}

impl<const N: usize> Default for Lines<N> {
    fn default() -> Self {
        Self { lines: [0; N], used: 0 }
    }
}

impl<const N: usize> Lines<N> {
    fn holds(&self, line: u32) -> bool {
        self.lines[..self.used].contains(&line)
    }

    /// Whether the cache holds the line; if so, it becomes the most recently used one.
    fn touch(&mut self, line: u32) -> bool {
        let found = self.lines[..self.used].iter().rposition(|held| *held == line);
        if let Some(at) = found {
            self.lines[at..self.used].rotate_left(1);
        }
        found.is_some()
    }

    fn add(&mut self, line: u32) {
        if self.used < N {
            self.used += 1;
        } else {
            self.lines.rotate_left(1);
        }
        self.lines[self.used - 1] = line;
    }
}

/// The read interface of flash.
#[derive(Debug, Default)]
pub struct FlashReads {
    /// The line from which instructions are taken.
    current: Option<u32>,
    /// The line that is being or was read ahead.
    ahead: Option<u32>,
    /// The offset fetched last.
    last: u32,
    /// When the read under way ends.
    busy_until: u64,
    instructions: Lines<INSTRUCTION_LINES>,
    data: Lines<DATA_LINES>,
}

impl FlashReads {
    /// Fetches half a word of instructions at `offset`; returns the cycles until it arrives.
    pub fn fetch(&mut self, offset: u32, jump: bool, now: u64, speeds: &Speeds) -> u64 {
        let line = offset / LINE_BYTES;
        let from = std::mem::replace(&mut self.last, offset);
        if self.current == Some(line) {
            return 0;
        }
        self.current = Some(line);
        let ready = if self.ahead == Some(line) {
            now.max(self.busy_until)
        } else if speeds.instruction_cache && self.instructions.touch(line) {
            let asked_beyond = jump && from % LINE_BYTES + 2 + AHEAD_BYTES > LINE_BYTES;
            if asked_beyond { now.max(self.busy_until) } else { now }
        } else {
            if speeds.instruction_cache {
                self.instructions.add(line);
            }
            self.read_line(now, speeds)
        };
        let next = line + 1;
        let cached = speeds.instruction_cache && self.instructions.holds(next);
        self.ahead = (speeds.prefetch && !cached).then_some(next);
        if self.ahead.is_some() {
            // Starting from the cycle in which the first word is passed on.
            self.busy_until = ready.max(self.busy_until) + speeds.wait_states + 1;
        }
        ready - now
    }

    /// Reads data at `offset`; returns the cycles until it arrives.
    pub fn read(&mut self, offset: u32, now: u64, speeds: &Speeds) -> u64 {
        let line = offset / LINE_BYTES;
        if speeds.data_cache && self.data.touch(line) {
            return 0;
        }
        if speeds.data_cache {
            self.data.add(line);
        }
        self.read_uncached(now, speeds)
    }

    /// Reads something that is never cached; returns the cycles until it arrives.
    pub fn read_uncached(&mut self, now: u64, speeds: &Speeds) -> u64 {
        self.read_line(now, speeds) - now
    }

    /// Reads one line; returns when it arrives.
    fn read_line(&mut self, now: u64, speeds: &Speeds) -> u64 {
        self.busy_until = now.max(self.busy_until) + speeds.wait_states;
        self.busy_until
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FOUR: Speeds = Speeds {
        wait_states: 4,
        prefetch: true,
        instruction_cache: true,
        data_cache: true,
        apb1: 4,
        apb2: 2,
    };

    /// How long each instruction waits in straight code of 32-bit instructions of one cycle each.
    fn straight(flash: &mut FlashReads, speeds: &Speeds, words: u32) -> Vec<u64> {
        let mut now = 1000;
        (0..words)
            .map(|n| {
                let wait = flash.fetch(0x400 + 4 * n, false, now, speeds);
                now += wait + 1;
                wait
            })
            .collect()
    }

    /// RM0090's figure of sequential execution: with three wait states and prefetch, only the first line is waited for.
    #[test]
    fn prefetch_hides_three_wait_states_of_straight_code() {
        let speeds = Speeds { wait_states: 3, ..FOUR };
        assert_eq!(straight(&mut FlashReads::default(), &speeds, 9), [3, 0, 0, 0, 0, 0, 0, 0, 0]);
        let speeds = Speeds { prefetch: false, ..speeds };
        assert_eq!(straight(&mut FlashReads::default(), &speeds, 9), [3, 0, 0, 0, 3, 0, 0, 0, 3]);
    }

    /// A line takes five cycles to read and four to execute.
    #[test]
    fn four_wait_states_cost_a_cycle_for_each_line_of_long_instructions() {
        assert_eq!(straight(&mut FlashReads::default(), &FOUR, 9), [4, 0, 0, 0, 1, 0, 0, 0, 1]);
    }

    #[test]
    fn a_jump_misses_once_and_hits_afterwards() {
        let mut flash = FlashReads::default();
        assert_eq!(flash.fetch(0x400, true, 0, &FOUR), 4);
        // The following line is being read until cycle 9, and the jump's line after that.
        assert_eq!(flash.fetch(0x800, true, 5, &FOUR), 4 + 4);
        assert_eq!(flash.fetch(0x400, true, 100, &FOUR), 0);
        assert_eq!(
            flash.fetch(0x800, true, 101, &FOUR),
            0,
            "from the start of a line nothing beyond it was requested"
        );
        let off = Speeds { instruction_cache: false, ..FOUR };
        assert_eq!(flash.fetch(0x400, true, 200, &off), 4);
    }

    #[test]
    fn a_jump_from_a_lines_end_waits_for_the_line_behind_it() {
        let mut flash = FlashReads::default();
        flash.fetch(0x800, true, 0, &FOUR);
        flash.fetch(0x400, true, 100, &FOUR);
        flash.fetch(0x40E, false, 105, &FOUR);
        // The following line is read from 104 to 109.
        assert_eq!(flash.fetch(0x800, true, 106, &FOUR), 3);
    }

    #[test]
    fn the_least_recently_used_of_64_lines_goes() {
        let mut flash = FlashReads::default();
        let mut waited = |line: u32, now: u64| flash.fetch(line * 64, true, now, &FOUR) > 0;
        assert!((0..64).all(|line| waited(line, 1000 * u64::from(line))));
        assert!(!waited(0, 100_000));
        assert!(waited(64, 101_000));
        assert!(!waited(0, 102_000), "it was used");
        assert!(waited(1, 103_000), "it had to go");
    }

    /// The data cache has eight lines; without it, each access waits.
    #[test]
    fn literals_are_cached_by_eights() {
        let mut flash = FlashReads::default();
        let mut wait = |line: u32, now: u64| flash.read(line * 16, now, &FOUR);
        assert!((0..8).all(|line| wait(line, 100 * u64::from(line)) == 4));
        assert_eq!((wait(0, 1000), wait(8, 1100), wait(1, 1200)), (0, 4, 4));
        let off = Speeds { data_cache: false, ..FOUR };
        assert_eq!([0, 0].map(|offset| flash.read(offset, 2000, &off)), [4, 8], "one read at a time");
    }
}
