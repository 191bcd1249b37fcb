//! A channel's periodic entries: which are due, in which order they wait for a mailbox, and how many periods passed
//! without a frame.
//!
//! An entry that is already waiting does not become due again: the bus takes its frame when it can, and no sooner for being
//! asked twice. So entries that cannot be sent cost nothing, however short their periods; the periods that pass meanwhile are
//! counted by arithmetic when the frame is sent, or when a host asks. The longest wait goes first: if more is asked for than
//! the bus can carry, each entry still gets its turn.

use cantap_wire::message::{DEVICE_TAG, Modifier, Periodic};
use cantap_wire::record::TransmitFailure;
use cantap_wire::{Channel, Event, Frame};
use heapless::Deque;

use crate::bus::checksum::checksum;
use crate::bus::recorder::{RECORDS_PER_CALL, Recorder};
use crate::bus::time::NEVER;
use crate::{TICK_HZ, TICKS_PER_US};

/// Entries per channel: one for each bit of a word.
pub const PERIODIC_SLOTS: usize = u32::BITS as usize;
/// Shortest period: no frame is shorter than 47 µs.
pub const MIN_PERIOD_TICKS: u32 = 47 * TICKS_PER_US;

/// The table is checked no more often than this, so that entries due shortly after one another are found together.
const LOOK_EVERY_TICKS: u64 = 20 * TICKS_PER_US as u64;
/// For each entry, the number of periods that passed without a frame is reported no more often than this.
const TELL_EVERY_TICKS: u64 = TICK_HZ as u64 / 10;

struct PeriodicState {
    entry: Periodic,
    /// When the next period begins.
    next_due: u64,
    /// Transmissions left; `None` means for ever.
    left: Option<u32>,
    step: u32,
}

impl PeriodicState {
    /// Periods that have begun since the last call, up to `now`.
    fn begin_periods(&mut self, now: u64) -> u32 {
        let Some(behind) = now.checked_sub(self.next_due) else { return 0 };
        let period = self.entry.period_ticks.max(1);
        // The processor takes a dozen cycles for a 32-bit division, hundreds for a 64-bit one.
        let begun = match u32::try_from(behind) {
            Ok(behind) => u64::from(behind / period),
            Err(_) => behind / u64::from(period),
        } + 1;
        self.next_due += begun * u64::from(period);
        begun as u32
    }
}

/// The entries.
pub struct PeriodicTable {
    channel: Channel,
    entries: [Option<PeriodicState>; PERIODIC_SLOTS],
    /// Slots that are due and waiting for a mailbox, the longest wait first.
    waiting: Deque<u8, PERIODIC_SLOTS>,
    /// The other entries, one bit per slot. Only these need checking, and an overloaded table has few of them.
    idle: u32,
    /// When to check the table next: when the first entry that is not waiting becomes due, but not before `look_from`.
    due: u64,
    look_from: u64,
    /// Periods that passed without a frame, since [`Self::reset_counter`].
    overtaken: u32,
    /// By slot, how many of these no record has reported yet. They outlive their entry.
    untold: [u32; PERIODIC_SLOTS],
    /// The slots that have unreported periods, and those of them whose turn it is: one bit per slot.
    owed: u32,
    telling: u32,
    tell_from: u64,
    random: u32,
}

impl PeriodicTable {
    /// No entries.
    pub const fn new(channel: Channel) -> Self {
        Self {
            channel,
            entries: [const { None }; PERIODIC_SLOTS],
            waiting: Deque::new(),
            idle: 0,
            due: NEVER,
            look_from: 0,
            overtaken: 0,
            untold: [0; PERIODIC_SLOTS],
            owed: 0,
            telling: 0,
            tell_from: 0,
            random: 0x1234_5678,
        }
    }

    /// Sets or clears an entry; its first transmission is due at `now`. Touches no other entry: it is called with the lock held.
    pub fn set(&mut self, slot: usize, entry: Option<Periodic>, now: u64) {
        let Some(place) = self.entries.get_mut(slot) else { return };
        let was_waiting = place.is_some() && self.idle >> slot & 1 == 0;
        let begun = place.as_mut().map_or(0, |old| old.begin_periods(now));
        let first_due = now.max(self.look_from);
        *place = entry.map(|entry| PeriodicState {
            left: (entry.count > 0).then_some(entry.count),
            entry,
            next_due: now,
            step: 0,
        });
        let is_set = place.is_some();
        // Of the periods that an idle entry has begun, one would have been waiting.
        self.add_overtaken(slot, if was_waiting { begun } else { begun.saturating_sub(1) });
        self.idle = self.idle & !(1 << slot) | u32::from(is_set) << slot;
        if was_waiting {
            for _ in 0..self.waiting.len() {
                if let Some(other) = self.waiting.pop_front().filter(|&other| usize::from(other) != slot) {
                    // Cannot fail: it was there.
                    let _ = self.waiting.push_back(other);
                }
            }
        }
        // If the entry that was due first is gone, the next look finds that.
        if is_set {
            self.due = self.due.min(first_due);
        }
    }

    /// Forgets the entries; periods that passed until `now` are counted.
    pub fn clear(&mut self, now: u64) {
        self.count_overtaken(now);
        self.remove_all();
    }

    /// Forgets the entries and their unreported periods.
    pub fn forget(&mut self) {
        self.remove_all();
        self.untold = [0; PERIODIC_SLOTS];
        (self.owed, self.telling) = (0, 0);
    }

    fn remove_all(&mut self) {
        self.entries.iter_mut().for_each(|place| *place = None);
        self.waiting.clear();
        self.idle = 0;
        self.due = NEVER;
    }

    /// When [`Self::look`] must be called next; [`NEVER`] if all entries wait.
    #[inline]
    pub const fn due(&self) -> u64 {
        self.due
    }

    /// Whether an entry waits for a mailbox.
    #[inline]
    pub fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Finds the entries that have become due, and when the next one will be.
    pub fn look(&mut self, now: u64) {
        self.look_from = now + LOOK_EVERY_TICKS;
        let mut due = NEVER;
        for slot in slots(self.idle) {
            let Some(entry) = &mut self.entries[slot] else { continue };
            let begun = entry.begin_periods(now);
            if begun == 0 {
                due = due.min(entry.next_due);
                continue;
            }
            self.idle &= !(1 << slot);
            // Cannot fail: there is room for every slot.
            let _ = self.waiting.push_back(slot as u8);
            self.add_overtaken(slot, begun - 1);
        }
        self.due = due.max(self.look_from);
    }

    /// Counts the periods that have passed without a frame.
    pub fn count_overtaken(&mut self, now: u64) {
        if self.due <= now {
            self.look(now);
        }
        if self.waiting.is_empty() {
            return;
        }
        for slot in slots(!self.idle) {
            let Some(entry) = &mut self.entries[slot] else { continue };
            let overtaken = entry.begin_periods(now);
            self.add_overtaken(slot, overtaken);
        }
    }

    /// Periods that passed without a frame, as last counted.
    pub const fn overtaken(&self) -> u32 {
        self.overtaken
    }

    /// Resets that counter to zero.
    pub const fn reset_counter(&mut self) {
        self.overtaken = 0;
    }

    /// The frame of the entry that waits longest, with its tag.
    pub fn next_frame(&mut self) -> Option<(u32, Frame)> {
        let slot = *self.waiting.front()?;
        let random = self.next_random();
        let entry = self.entries[usize::from(slot)].as_ref()?;
        Some((
            DEVICE_TAG + u32::from(slot),
            apply(&entry.entry.modifiers, &entry.entry.frame, entry.step, random),
        ))
    }

    /// The frame that [`Self::next_frame`] returned is in a mailbox.
    pub fn loaded(&mut self, now: u64) {
        let Some(slot) = self.waiting.pop_front().map(usize::from) else { return };
        let Some(entry) = &mut self.entries[slot] else { return };
        let overtaken = entry.begin_periods(now);
        entry.step = entry.step.wrapping_add(1);
        entry.left = entry.left.map(|left| left.saturating_sub(1));
        if entry.left == Some(0) {
            self.entries[slot] = None;
        } else {
            self.due = self.due.min(entry.next_due.max(self.look_from));
            self.idle |= 1 << slot;
        }
        self.add_overtaken(slot, overtaken);
    }

    /// Once a millisecond: reports how many periods of one entry passed without a frame. It waits until there is room, rather than
    /// use the reserve that is kept for explaining missing frames.
    pub fn tick<const N: usize>(&mut self, recorder: &mut Recorder<'_, N>, now: u64) {
        if now >= self.tell_from {
            self.tell_from = now + TELL_EVERY_TICKS;
            self.count_overtaken(now);
            self.telling = self.owed;
        }
        if self.telling != 0 && recorder.takes_frames() {
            self.tell(recorder, now, 1);
        }
    }

    /// Whether there are periods that no record has reported yet.
    pub const fn owes(&self) -> bool {
        self.owed != 0
    }

    /// Reports what is left, a few records per call; returns whether there was room for these.
    pub fn tell_rest<const N: usize>(&mut self, recorder: &mut Recorder<'_, N>, now: u64) -> bool {
        self.telling = self.owed;
        self.tell(recorder, now, RECORDS_PER_CALL)
    }

    /// Writes up to `most` of the records that are due now; returns whether there was room.
    fn tell<const N: usize>(&mut self, recorder: &mut Recorder<'_, N>, now: u64, most: usize) -> bool {
        for slot in slots(self.telling).take(most) {
            let tag = DEVICE_TAG + slot as u32;
            let reason = TransmitFailure::Overtaken { periods: self.untold[slot] };
            if !recorder.event(&Event::TransmitFailed { channel: self.channel, tag, reason }, now) {
                return false;
            }
            self.untold[slot] = 0;
            self.owed &= !(1 << slot);
            self.telling &= !(1 << slot);
        }
        true
    }

    /// Periods of an entry passed without a frame.
    fn add_overtaken(&mut self, slot: usize, periods: u32) {
        if periods > 0 {
            self.overtaken = self.overtaken.wrapping_add(periods);
            self.untold[slot] = self.untold[slot].saturating_add(periods);
            self.owed |= 1 << slot;
        }
    }

    /// xorshift32 (Marsaglia, "Xorshift RNGs", 2003).
    fn next_random(&mut self) -> u32 {
        self.random ^= self.random << 13;
        self.random ^= self.random >> 17;
        self.random ^= self.random << 5;
        self.random
    }
}

/// The slots whose bits are set, in order.
fn slots(mut bits: u32) -> impl Iterator<Item = usize> {
    core::iter::from_fn(move || {
        let slot = bits.trailing_zeros() as usize;
        bits &= bits.wrapping_sub(1);
        (slot < PERIODIC_SLOTS).then_some(slot)
    })
}

/// A frame with modifiers applied. `step` is how often that was done before.
pub fn apply(modifiers: &[Modifier], frame: &Frame, step: u32, mut random: u32) -> Frame {
    let mut data = frame.padded_data();
    let len = frame.data_len();
    for modifier in modifiers {
        match *modifier {
            Modifier::Counter { byte, low_bit, bits } => {
                let mask = ((1u16 << bits) - 1) as u8;
                if let Some(value) = data[..len].get_mut(byte as usize) {
                    let counted = (*value >> low_bit).wrapping_add(step as u8) & mask;
                    *value = *value & !(mask << low_bit) | counted << low_bit;
                }
            }
            Modifier::Checksum { byte, algorithm } => {
                let sum = checksum(algorithm, &data[..len], byte as usize);
                if let Some(value) = data[..len].get_mut(byte as usize) {
                    *value = sum;
                }
            }
            Modifier::Random { byte } => {
                if let Some(value) = data[..len].get_mut(byte as usize) {
                    *value = random as u8;
                }
                random = random.rotate_right(8);
            }
        }
    }
    Frame::from_bus(frame.id(), frame.is_remote(), frame.dlc(), data)
}

/// Whether an entry can be applied: a period, and modifiers inside the frame's data.
pub fn is_valid(entry: &Periodic) -> bool {
    let len = entry.frame.data_len();
    entry.period_ticks >= MIN_PERIOD_TICKS && entry.modifiers.iter().all(|modifier| modifier.fits(len))
}
