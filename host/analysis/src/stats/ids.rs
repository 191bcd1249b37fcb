//! Statistics of identifiers: how often each comes, how evenly, and how long its frames are.

use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};

use cantap_trace::{DeviceNs, Direction, Id, Moment, TraceFrame};

/// How many identifiers are tracked individually on each channel. Random or hostile traffic may have half a
/// billion; frames of identifiers beyond this number are counted together.
pub const MOST_IDS: usize = 65_536;

/// The intervals between one identifier's frames.
#[derive(Clone, Copy, Debug, Default)]
pub struct Period {
    count: u64,
    min_ns: i64,
    max_ns: i64,
    /// The first interval. Deviations are summed relative to it, because their squares would otherwise
    /// cancel.
    base_ns: i64,
    sum: f64,
    squares: f64,
}

impl Period {
    #[inline]
    fn add(&mut self, interval_ns: i64) {
        if self.count == 0 {
            self.base_ns = interval_ns;
            self.min_ns = interval_ns;
            self.max_ns = interval_ns;
        }
        self.count += 1;
        self.min_ns = self.min_ns.min(interval_ns);
        self.max_ns = self.max_ns.max(interval_ns);
        let deviation = interval_ns.saturating_sub(self.base_ns) as f64;
        self.sum += deviation;
        self.squares += deviation * deviation;
    }

    /// The number of intervals measured.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// The shortest, in nanoseconds.
    pub fn min_ns(&self) -> Option<i64> {
        (self.count > 0).then_some(self.min_ns)
    }

    /// The longest, in nanoseconds.
    pub fn max_ns(&self) -> Option<i64> {
        (self.count > 0).then_some(self.max_ns)
    }

    /// Their mean, in nanoseconds.
    pub fn mean_ns(&self) -> Option<f64> {
        (self.count > 0).then(|| self.base_ns as f64 + self.sum / self.count as f64)
    }

    /// Their standard deviation, in nanoseconds: the jitter.
    pub fn jitter_ns(&self) -> Option<f64> {
        let count = self.count as f64;
        (self.count > 0).then(|| {
            let mean = self.sum / count;
            (self.squares / count - mean * mean).max(0.0).sqrt()
        })
    }
}

/// Statistics of one identifier on one channel.
#[derive(Clone, Copy, Debug)]
pub struct IdStatistics {
    /// The identifier.
    pub id: Id,
    /// Its frames, remote frames too.
    pub frames: u64,
    /// Its remote frames.
    pub remote: u64,
    /// Its frames sent by the device itself.
    pub sent: u64,
    /// Bits of its frames, with stuff bits and intermission.
    pub bits: u64,
    /// Intervals between its frames, by the device's clock where both have its time. An interval in which frames were lost on the channel is
    /// left out.
    pub period: Period,
    /// End of the first frame, in nanoseconds.
    pub first_ns: i64,
    /// End of the last frame, in nanoseconds.
    pub last_ns: i64,
    /// The last DLC, as on the bus.
    pub dlc: u8,
    /// Bit n is set if DLC n occurred.
    pub dlcs_seen: u16,
    /// How often a frame's DLC differed from the one before.
    pub dlc_changes: u64,
    /// The device's time of that end, if it is known.
    last_device_ns: Option<DeviceNs>,
    /// The channel's number of gaps at its last frame.
    generation: u32,
}

impl IdStatistics {
    fn new(frame: &TraceFrame, end: Moment, generation: u32) -> Self {
        Self {
            id: frame.id(),
            frames: 0,
            remote: 0,
            sent: 0,
            bits: 0,
            period: Period::default(),
            first_ns: end.time_ns,
            last_ns: end.time_ns,
            last_device_ns: end.device_ns,
            dlc: frame.dlc(),
            dlcs_seen: 0,
            dlc_changes: 0,
            generation,
        }
    }

    #[inline]
    fn add(&mut self, frame: &TraceFrame, direction: Direction, bits: u32, end: Moment, generation: u32) {
        if self.frames > 0 && self.generation == generation {
            let interval = end.since_ns(Moment { time_ns: self.last_ns, device_ns: self.last_device_ns });
            if interval >= 0 {
                self.period.add(interval);
            }
        }
        self.frames += 1;
        self.remote += u64::from(frame.is_remote());
        self.sent += u64::from(direction == Direction::Tx);
        self.bits += u64::from(bits);
        self.last_ns = end.time_ns;
        self.last_device_ns = end.device_ns;
        self.generation = generation;
        self.dlc_changes += u64::from(self.dlc != frame.dlc());
        self.dlc = frame.dlc();
        self.dlcs_seen |= 1 << frame.dlc();
    }

    /// The DLCs that occurred, in ascending order.
    pub fn dlcs(&self) -> impl Iterator<Item = u8> + use<> {
        let seen = self.dlcs_seen;
        (0..16).filter(move |dlc| seen >> dlc & 1 != 0)
    }
}

/// All identifiers of one channel.
#[derive(Clone, Debug, Default)]
pub(super) struct Ids {
    place_of: HashMap<u32, u32, BuildHasherDefault<IdHasher>>,
    listed: Vec<IdStatistics>,
    /// Frames of identifiers for which there was no room.
    pub(super) unlisted_frames: u64,
}

impl Ids {
    #[inline]
    pub(super) fn add(
        &mut self,
        frame: &TraceFrame,
        direction: Direction,
        bits: u32,
        end: Moment,
        generation: u32,
    ) {
        let id = frame.id();
        let key = id.raw() | u32::from(id.is_extended()) << 31;
        let place = match self.place_of.get(&key) {
            Some(place) => *place as usize,
            None if self.listed.len() < MOST_IDS => {
                self.place_of.insert(key, self.listed.len() as u32);
                self.listed.push(IdStatistics::new(frame, end, generation));
                self.listed.len() - 1
            }
            None => {
                self.unlisted_frames += 1;
                return;
            }
        };
        self.listed[place].add(frame, direction, bits, end, generation);
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &IdStatistics> {
        self.listed.iter()
    }

    pub(super) fn get(&self, id: Id) -> Option<&IdStatistics> {
        let place = self.place_of.get(&(id.raw() | u32::from(id.is_extended()) << 31))?;
        self.listed.get(*place as usize)
    }

    pub(super) fn len(&self) -> usize {
        self.listed.len()
    }
}

/// Hashes an identifier by one multiplication: the map is accessed once per frame.
#[derive(Clone, Copy, Debug, Default)]
struct IdHasher(u64);

impl Hasher for IdHasher {
    fn finish(&self) -> u64 {
        self.0
    }

    fn write(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.write_u32(u32::from(*byte));
        }
    }

    fn write_u32(&mut self, value: u32) {
        // 2^64 divided by the golden ratio (Knuth); the fold moves the well-mixed high bits down to the table's
        // index.
        let product = (self.0 ^ u64::from(value)).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        self.0 = product ^ product >> 32;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn add(ids: &mut Ids, text: &str, end_ns: i64, generation: u32) {
        let frame: TraceFrame = text.parse().unwrap();
        ids.add(&frame, Direction::Rx, 50, Moment { time_ns: end_ns, device_ns: None }, generation);
    }

    #[test]
    fn the_period_is_minimum_mean_maximum_and_standard_deviation() {
        let mut ids = Ids::default();
        for end in [0, 10, 22, 30, 40] {
            add(&mut ids, "123#", end, 0);
        }
        let period = &ids.iter().next().unwrap().period;
        assert_eq!((period.min_ns(), period.mean_ns(), period.max_ns()), (Some(8), Some(10.0), Some(12)));
        assert!((period.jitter_ns().unwrap() - 2f64.sqrt()).abs() < 1e-9);
    }

    #[test]
    fn an_interval_with_a_loss_in_it_is_no_period() {
        let mut ids = Ids::default();
        for (end, generation) in [(0, 0), (10, 0), (50, 1), (60, 1)] {
            add(&mut ids, "123#", end, generation);
        }
        let period = &ids.iter().next().unwrap().period;
        assert_eq!((period.count(), period.max_ns()), (2, Some(10)));
    }

    /// UTC is corrected by up to 100 ppm: 10 us in a period of 100 ms, which is no jitter of the bus.
    #[test]
    fn a_period_is_as_the_device_measured_it() {
        let mut ids = Ids::default();
        let frame: TraceFrame = "123#".parse().unwrap();
        for n in 0..50_u64 {
            let corrected = if n % 2 == 0 { 0 } else { 10_000 };
            let (time_ns, device_ns) = (n as i64 * 100_000_000 + corrected, 7_000_000 + n * 100_000_000);
            let end = Moment { time_ns, device_ns: DeviceNs::new(device_ns) };
            ids.add(&frame, Direction::Rx, 50, end, 0);
        }
        let period = &ids.iter().next().unwrap().period;
        assert_eq!((period.min_ns(), period.max_ns()), (Some(100_000_000), Some(100_000_000)));
        assert_eq!((period.count(), period.jitter_ns()), (49, Some(0.0)));
    }

    #[test]
    fn one_frame_has_no_period() {
        let mut ids = Ids::default();
        add(&mut ids, "123#", 5, 0);
        let id = ids.iter().next().unwrap();
        assert_eq!((id.period.min_ns(), id.period.mean_ns(), id.period.jitter_ns()), (None, None, None));
        assert_eq!((id.first_ns, id.last_ns, id.frames), (5, 5, 1));
    }

    #[test]
    fn dlc_changes_are_counted_and_listed() {
        let mut ids = Ids::default();
        for text in ["123#00", "123#0000", "123#0000", "123#00", "123#R4"] {
            add(&mut ids, text, 0, 0);
        }
        let id = ids.iter().next().unwrap();
        assert_eq!((id.dlc, id.dlc_changes, id.remote), (4, 3, 1));
        assert_eq!(id.dlcs().collect::<Vec<_>>(), [1, 2, 4]);
    }

    #[test]
    fn a_standard_and_an_extended_identifier_of_the_same_number_are_two() {
        let mut ids = Ids::default();
        add(&mut ids, "123#", 0, 0);
        add(&mut ids, "00000123#", 0, 0);
        assert_eq!(ids.len(), 2);
    }

    #[test]
    fn more_identifiers_than_there_is_room_for_are_counted_together() {
        let mut ids = Ids::default();
        for raw in 0..MOST_IDS as u32 + 10 {
            let frame = cantap_trace::Frame::data_frame(Id::extended_truncated(raw), &[]).unwrap().into();
            ids.add(&frame, Direction::Rx, 50, Moment { time_ns: 0, device_ns: None }, 0);
        }
        assert_eq!((ids.len(), ids.unlisted_frames), (MOST_IDS, 10));
    }
}
