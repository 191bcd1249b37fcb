//! Compares what two devices recorded of one bus at the same time: which frames each has, in which order, and how far apart their stamps are.
//!
//! A frame is recognised by its content. Equal frames whose stamps are near each other form a group. A group of one frame of each device is a frame that
//! both have; a group of one device alone is a frame that the other missed. In every other group it is not clear which belongs to which: how many there are
//! is counted, and nothing else is derived from them.
//!
//! What counts as near is measured: twice the difference that the stamps of 99 % of the frames have of which there is one alone in a second. Those are pairs
//! however far apart they are in it.
//!
//! A bus has one order. So what lies between two frames that both devices have was on the bus while both were listening, whatever their stamps say.

use std::collections::HashMap;

use cantap_trace::{TraceEvent, TraceFrame, TraceRecord};

use super::chain::FEWEST;
use super::{AlignError, Alignment, ClockMap, RUN_LENGTHS, Sketch, align};

/// Equal frames farther apart than this, in nanoseconds, are never the same: no device takes that long to hand a frame over.
const APART_NS: i64 = 1_000_000_000;
/// The smallest distance that is called near, in nanoseconds: stamps have microseconds.
const NEAR_NS: i64 = 2_000;

/// What a comparison found.
#[derive(Clone, Debug)]
pub struct Comparison {
    /// Converts the second device's times to the first one's.
    pub map: ClockMap,
    /// Channels of the first device, each with that of the second on the same bus.
    pub channels: Vec<(u8, u8)>,
    /// From the first to the last frame that both have, in the first one's time.
    pub common_ns: (i64, i64),
    /// What concerns each of the two.
    pub sides: [Side; 2],
    /// Frames that both have.
    pub both: u64,
    /// Of these, those that repeat so soon that it is not clear which of the first device's is which of the second one's. They are left out of the order and
    /// of the differences.
    pub ambiguous: u64,
    /// Of the frames in both, how many at least would have to be moved for both to have the same order.
    pub out_of_order: u64,
    /// How far apart the stamps of a frame are once offset and drift are taken out; `None` if every frame is ambiguous.
    pub differences: Option<Differences>,
    /// Equal frames that are no farther apart than this, in nanoseconds, are in one group.
    pub near_ns: i64,
}

/// What concerns one of two devices.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Side {
    /// Frames that only the other has, on a bus and in a time that both recorded.
    pub missed: u64,
    /// Of these, remote frames: some devices and protocols have none.
    pub missed_remote: u64,
    /// How many frames more than the other it has of frames that both have: it received them twice, or the other missed some of them.
    pub surplus: u64,
    /// Frames before the first that both have.
    pub before: u64,
    /// Frames after the last that both have.
    pub after: u64,
    /// How long that is, in nanoseconds.
    pub after_ns: i64,
    /// Frames on channels that have nothing in common with any of the other.
    pub other_bus: u64,
}

/// How far apart the two stamps of a frame are, in nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Differences {
    /// The median.
    pub median_ns: u64,
    /// The 99th percentile.
    pub p99_ns: u64,
    /// The maximum.
    pub max_ns: u64,
}

/// A frame on one channel of one device: its time by the first one's clock, and its place in the channel's order.
#[derive(Clone, Copy)]
struct Place {
    time_ns: i64,
    index: usize,
}

/// The places of equal frames at about the same time, of each device.
type Group = [Vec<Place>; 2];

/// Compares two recordings, each in the order in which it was received. Stamps that are only upper bounds count like others: many devices have no better.
///
/// # Errors
/// As for [`align`]: nothing in common, or nothing by which one frame could be told from another.
pub fn compare(first: &[TraceRecord], second: &[TraceRecord]) -> Result<Comparison, AlignError> {
    let Alignment { map, channels, tolerance_ns, .. } = find(first, second)?;
    let buses: Vec<_> = channels
        .iter()
        .map(|&(a, b)| {
            Bus::new([on_channel(first, a, |ns| ns), on_channel(second, b, |ns| map.to_first(ns))])
        })
        .collect();
    let near_ns = near_ns(&buses).unwrap_or(tolerance_ns).max(NEAR_NS);
    let mut found = Comparison {
        map,
        channels,
        common_ns: (i64::MAX, i64::MIN),
        sides: [Side::default(); 2],
        both: 0,
        ambiguous: 0,
        out_of_order: 0,
        differences: None,
        near_ns,
    };
    let mut differences = Vec::new();
    for bus in &buses {
        found.take(bus, &mut differences);
    }
    found.differences = Differences::of(differences);
    for (side, records) in [first, second].into_iter().enumerate() {
        let paired = |channel| found.channels.iter().any(|&(a, b)| [a, b][side] == channel);
        let frames = records.iter().filter(|record| matches!(record.event, TraceEvent::Frame { .. }));
        found.sides[side].other_bus += frames.filter(|record| !paired(record.channel)).count() as u64;
    }
    Ok(found)
}

/// How the clocks and channels relate. Single frames come second: they survive any loss, but fewer of them occur only once. Of equal frames in a row the
/// first stands for all, since a device may hand each frame over twice.
fn find(first: &[TraceRecord], second: &[TraceRecord]) -> Result<Alignment, AlignError> {
    let sketch = |records: &[TraceRecord], length| {
        let mut sketch = Sketch::new(length).with_bounds();
        let mut last = HashMap::new();
        for record in records {
            let TraceEvent::Frame { frame, .. } = record.event else { continue };
            if last.insert(record.channel, frame) != Some(frame) {
                sketch.add(record);
            }
        }
        sketch
    };
    let [short, longer @ ..] = RUN_LENGTHS;
    let mut unclear = AlignError::NothingInCommon;
    for length in [short, 1].into_iter().chain(longer) {
        match align(&sketch(first, length), &sketch(second, length)) {
            Ok(alignment) => return Ok(alignment),
            // Why frames that both have do not help says more than that they have none.
            Err(AlignError::NothingInCommon) => {}
            Err(error) => unclear = error,
        }
    }
    Err(unclear)
}

/// A channel's frames, by the first device's clock.
fn on_channel(
    records: &[TraceRecord],
    channel: u8,
    to_first: impl Fn(i64) -> i64,
) -> Vec<(TraceFrame, Place)> {
    let of_channel = records.iter().filter_map(|record| match &record.event {
        TraceEvent::Frame { frame, .. } if record.channel == channel => Some((*frame, record.time_ns)),
        _ => None,
    });
    let place = |(index, (frame, time_ns))| (frame, Place { time_ns: to_first(time_ns), index });
    of_channel.enumerate().map(place).collect()
}

/// What both devices have of one bus.
struct Bus {
    frames: [Vec<(TraceFrame, Place)>; 2],
    /// Where each content occurs, in order of time.
    by_content: HashMap<TraceFrame, Vec<(usize, Place)>>,
}

impl Bus {
    fn new(frames: [Vec<(TraceFrame, Place)>; 2]) -> Self {
        let mut by_content: HashMap<TraceFrame, Vec<(usize, Place)>> = HashMap::new();
        for (side, frames) in frames.iter().enumerate() {
            for (frame, place) in frames {
                by_content.entry(*frame).or_default().push((side, *place));
            }
        }
        for places in by_content.values_mut() {
            places.sort_by_key(|(_, place)| place.time_ns);
        }
        Self { frames, by_content }
    }

    /// Equal frames of which each is at most [`APART_NS`] from the next.
    fn loose_groups(&self) -> impl Iterator<Item = &[(usize, Place)]> {
        self.by_content.values().flat_map(|places| chunks(places, APART_NS))
    }

    /// Equal frames of which each is at most this far from the next, or which are alone.
    fn groups(&self, near_ns: i64) -> Vec<Group> {
        let mut groups = Vec::new();
        for loose in self.loose_groups() {
            let all = group(loose);
            if pair(&all).is_some() {
                groups.push(all);
            } else {
                groups.extend(chunks(loose, near_ns).map(group));
            }
        }
        groups
    }

    /// Whether equal frames are remote frames.
    fn is_remote(&self, group: &Group) -> bool {
        let frames = self.frames.iter().zip(group);
        let mut all = frames.flat_map(|(frames, places)| places.iter().map(|place| &frames[place.index].0));
        all.any(|frame| frame.classic().is_some_and(cantap_can::Frame::is_remote))
    }

    /// Which part of each device's frames the other can have, too: from the first to the last that certainly both have.
    fn common(groups: &[Group]) -> Option<[(usize, usize); 2]> {
        let clear = groups.iter().filter(|group| pair(group).is_some());
        let shared = groups.iter().filter(|group| group.iter().all(|side| !side.is_empty()));
        let range = |groups: &[&Group], side: usize| {
            let indices = || groups.iter().flat_map(|group| &group[side]).map(|place| place.index);
            Some((indices().min()?, indices().max()?))
        };
        let clear: Vec<_> = clear.collect();
        let of = if clear.is_empty() { shared.collect() } else { clear };
        Some([range(&of, 0)?, range(&of, 1)?])
    }
}

/// Cut where two are farther apart than this.
fn chunks(places: &[(usize, Place)], apart_ns: i64) -> impl Iterator<Item = &[(usize, Place)]> {
    places.chunk_by(move |one, next| next.1.time_ns.saturating_sub(one.1.time_ns) <= apart_ns)
}

fn group(places: &[(usize, Place)]) -> Group {
    let of = |side| places.iter().filter(|(of, _)| *of == side).map(|(_, place)| *place).collect();
    [of(0), of(1)]
}

/// The two stamps of a frame that occurs once at each device.
fn pair(group: &Group) -> Option<(Place, Place)> {
    match group.each_ref().map(Vec::as_slice) {
        [[first], [second]] => Some((*first, *second)),
        _ => None,
    }
}

/// How far apart the stamps of one frame may be: measured where there is no doubt.
fn near_ns(buses: &[Bus]) -> Option<i64> {
    let alone = buses.iter().flat_map(Bus::loose_groups).filter_map(|places| pair(&group(places)));
    let differences: Vec<u64> = alone.map(|(first, second)| first.time_ns.abs_diff(second.time_ns)).collect();
    let is_enough = differences.len() >= FEWEST;
    let most = Differences::of(differences).filter(|_| is_enough)?.p99_ns;
    Some((2 * most as i64).min(APART_NS))
}

impl Side {
    fn misses(&mut self, frames: u64, is_remote: bool) {
        self.missed += frames;
        self.missed_remote += if is_remote { frames } else { 0 };
    }
}

impl Comparison {
    fn take(&mut self, bus: &Bus, differences: &mut Vec<u64>) {
        let groups = bus.groups(self.near_ns);
        let Some(common) = Bus::common(&groups) else {
            for (side, frames) in bus.frames.iter().enumerate() {
                self.sides[side].other_bus += frames.len() as u64;
            }
            return;
        };
        for (side, (frames, (begin, end))) in bus.frames.iter().zip(common).enumerate() {
            let (found, after) = (&mut self.sides[side], &frames[end + 1..]);
            found.before += begin as u64;
            found.after += after.len() as u64;
            let last_ns = frames[end].1.time_ns;
            let after_ns = after.last().map_or(0, |(_, place)| place.time_ns.saturating_sub(last_ns));
            found.after_ns = found.after_ns.max(after_ns);
            if side == 0 {
                let (begin_ns, end_ns) = self.common_ns;
                self.common_ns = (begin_ns.min(frames[begin].1.time_ns), end_ns.max(last_ns));
            }
        }
        let mut pairs = Vec::new();
        for group in &groups {
            if let Some((first, second)) = pair(group) {
                self.both += 1;
                pairs.push((first.index, second.index));
                differences.push(first.time_ns.abs_diff(second.time_ns));
                continue;
            }
            let [first, second] = [0, 1].map(|side| {
                let (begin, end) = common[side];
                group[side].iter().filter(|place| (begin..=end).contains(&place.index)).count() as u64
            });
            let both = first.min(second);
            self.both += both;
            self.ambiguous += both;
            match (first - both, second - both) {
                (missed, 0) if both == 0 => self.sides[1].misses(missed, bus.is_remote(group)),
                (0, missed) if both == 0 => self.sides[0].misses(missed, bus.is_remote(group)),
                (first, second) => {
                    self.sides[0].surplus += first;
                    self.sides[1].surplus += second;
                }
            }
        }
        pairs.sort_unstable();
        self.out_of_order += (pairs.len() - longest_rise(pairs.iter().map(|pair| pair.1))) as u64;
    }
}

/// How many of the numbers, all different, can stay where they are if the others are moved so that all rise.
fn longest_rise(numbers: impl Iterator<Item = usize>) -> usize {
    // The lowest number with which a rise of this length ends.
    let mut ends: Vec<usize> = Vec::new();
    for number in numbers {
        let at = ends.partition_point(|end| *end < number);
        match ends.get_mut(at) {
            Some(end) => *end = number,
            None => ends.push(number),
        }
    }
    ends.len()
}

impl Differences {
    fn of(mut differences: Vec<u64>) -> Option<Self> {
        differences.sort_unstable();
        let quantile = |part: f64| {
            let at = (differences.len() as f64 * part).ceil() as usize;
            differences.get(at.saturating_sub(1)).copied()
        };
        Some(Self { median_ns: quantile(0.5)?, p99_ns: quantile(0.99)?, max_ns: quantile(1.0)? })
    }
}
