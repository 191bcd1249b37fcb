//! How two traces differ: identifiers, periods, lengths, bits.
//!
//! Each trace is reduced to a [`Profile`] as it is read, so memory depends on the number of identifiers and
//! not on the length of the traces; [`compare`] compares two profiles.

use std::collections::BTreeMap;

use cantap_can::Id;

use crate::fd::FD_MAX_BYTES;
use crate::{TraceFrame, TraceRecord};

/// A kind of frame: channel, identifier, and whether it is a remote or an FD frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Key {
    /// From 1; 0 if channels are not distinguished.
    pub channel: u8,
    /// The identifier.
    pub id: Id,
    /// Whether these are remote frames.
    pub remote: bool,
    /// Whether these are CAN FD frames.
    pub fd: bool,
}

/// Everything about one kind of frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IdProfile {
    /// Number of frames.
    pub count: u64,
    first_ns: i64,
    last_ns: i64,
    /// Bit n: a frame with DLC n occurred.
    dlcs: u16,
    /// Bit n: an FD frame with flags n occurred.
    flags: u8,
    /// Bits that were 1 in every frame that had them.
    always: [u8; FD_MAX_BYTES],
    /// Bits that were 1 in any frame.
    ever: [u8; FD_MAX_BYTES],
    /// Number of bytes in the longest frame.
    len: u8,
}

/// A trace reduced to what is compared.
#[derive(Clone, Debug, Default)]
pub struct Profile {
    kinds: BTreeMap<Key, IdProfile>,
    ignore_channels: bool,
}

impl IdProfile {
    fn new(time_ns: i64) -> Self {
        Self {
            count: 0,
            first_ns: time_ns,
            last_ns: time_ns,
            dlcs: 0,
            flags: 0,
            always: [0xFF; FD_MAX_BYTES],
            ever: [0; FD_MAX_BYTES],
            len: 0,
        }
    }

    fn add(&mut self, time_ns: i64, frame: &TraceFrame) {
        self.count += 1;
        self.first_ns = self.first_ns.min(time_ns);
        self.last_ns = self.last_ns.max(time_ns);
        self.dlcs |= 1 << frame.dlc();
        if let Some(frame) = frame.fd() {
            self.flags |= 1 << frame.flags();
        }
        self.len = self.len.max(frame.data_len() as u8);
        for (at, &byte) in frame.data().iter().enumerate() {
            self.always[at] &= byte;
            self.ever[at] |= byte;
        }
    }

    /// The mean period in nanoseconds, if there are at least two frames.
    pub fn period_ns(&self) -> Option<f64> {
        (self.count > 1).then(|| (self.last_ns - self.first_ns) as f64 / (self.count - 1) as f64)
    }

    /// The length codes that occurred, in order.
    pub fn dlcs(&self) -> Vec<u8> {
        (0..16).filter(|dlc| self.dlcs >> dlc & 1 == 1).collect()
    }

    /// The flags of FD frames that occurred, in order: 1 for a switched bit rate, 2 for an error passive sender.
    pub fn flags(&self) -> Vec<u8> {
        (0..4).filter(|flags| self.flags >> flags & 1 == 1).collect()
    }

    /// A byte's bits from the highest: `0` and `1` for those that never changed, `x` for those that did; `None`
    /// if no frame has the byte.
    pub fn bits(&self, byte: usize) -> Option<String> {
        let (always, ever) = (self.always.get(byte)?, self.ever.get(byte)?);
        let bit = |bit: u32| match (always >> bit & 1, ever >> bit & 1) {
            (1, _) => '1',
            (_, 0) => '0',
            _ => 'x',
        };
        (byte < self.len.into()).then(|| (0..8).rev().map(bit).collect())
    }
}

impl Profile {
    /// A profile that does not distinguish channels.
    pub fn ignoring_channels() -> Self {
        Self { ignore_channels: true, ..Self::default() }
    }

    /// Takes the next record.
    pub fn add(&mut self, record: &TraceRecord) {
        if let Some(frame) = record.frame() {
            let channel = if self.ignore_channels { 0 } else { record.channel };
            let (remote, fd) = (frame.is_remote(), frame.is_fd());
            let key = Key { channel, id: frame.id(), remote, fd };
            let new = IdProfile::new(record.time_ns);
            self.kinds.entry(key).or_insert(new).add(record.time_ns, frame);
        }
    }

    /// All kinds of frames, by channel and identifier.
    pub fn kinds(&self) -> impl Iterator<Item = (&Key, &IdProfile)> {
        self.kinds.iter()
    }
}

/// How two traces differ.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Difference {
    /// Kinds of frames only in the first, with their number.
    pub only_a: Vec<(Key, u64)>,
    /// Kinds of frames only in the second, with their number.
    pub only_b: Vec<(Key, u64)>,
    /// Kinds of frames in both that differ.
    pub changed: Vec<Changed>,
    /// How many kinds of frames are the same.
    pub same: usize,
}

/// How one kind of frame differs.
#[derive(Clone, Debug, PartialEq)]
pub struct Changed {
    /// The kind of frame.
    pub key: Key,
    /// Mean periods in nanoseconds, if they differ.
    pub period_ns: Option<(f64, f64)>,
    /// Length codes, if they differ.
    pub dlcs: Option<(Vec<u8>, Vec<u8>)>,
    /// Flags of FD frames, if they differ.
    pub flags: Option<(Vec<u8>, Vec<u8>)>,
    /// Bytes that differ, by position.
    pub bytes: Vec<ChangedByte>,
}

/// How one byte differs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChangedByte {
    /// Its position, from 0.
    pub byte: usize,
    /// Its bits in the first trace as [`IdProfile::bits`] gives them, empty if it has no such byte.
    pub a: String,
    /// Its bits in the second.
    pub b: String,
}

impl Difference {
    /// Whether there is no difference.
    pub fn is_none(&self) -> bool {
        self.only_a.is_empty() && self.only_b.is_empty() && self.changed.is_empty()
    }
}

/// Compares two profiles. Mean periods differ if one is longer than the other by more than `tolerance`
/// (0.1 is 10 %).
pub fn compare(a: &Profile, b: &Profile, tolerance: f64) -> Difference {
    let mut difference = Difference::default();
    for (&key, in_a) in a.kinds() {
        match b.kinds.get(&key) {
            None => difference.only_a.push((key, in_a.count)),
            Some(in_b) => match changed(key, in_a, in_b, tolerance) {
                Some(changed) => difference.changed.push(changed),
                None => difference.same += 1,
            },
        }
    }
    let new = b.kinds().filter(|(key, _)| !a.kinds.contains_key(key));
    difference.only_b = new.map(|(&key, in_b)| (key, in_b.count)).collect();
    difference
}

fn changed(key: Key, a: &IdProfile, b: &IdProfile, tolerance: f64) -> Option<Changed> {
    let period_ns =
        a.period_ns().zip(b.period_ns()).filter(|(a, b)| a.max(*b) > a.min(*b) * (1.0 + tolerance));
    let dlcs = (a.dlcs != b.dlcs).then(|| (a.dlcs(), b.dlcs()));
    let flags = (a.flags != b.flags).then(|| (a.flags(), b.flags()));
    let differing = (0..usize::from(a.len.max(b.len))).filter_map(|byte| {
        let (a, b) = (a.bits(byte).unwrap_or_default(), b.bits(byte).unwrap_or_default());
        (a != b).then_some(ChangedByte { byte, a, b })
    });
    let bytes: Vec<_> = differing.collect();
    let differs = period_ns.is_some() || dlcs.is_some() || flags.is_some() || !bytes.is_empty();
    differs.then_some(Changed { key, period_ns, dlcs, flags, bytes })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Direction, TraceEvent};

    fn profile(frames: &[(i64, &str)]) -> Profile {
        let mut profile = Profile::default();
        for &(time_ms, frame) in frames {
            let event =
                TraceEvent::Frame { frame: frame.parse().unwrap(), direction: Direction::Rx, late: false };
            profile.add(&TraceRecord { time_ns: time_ms * 1_000_000, device_ns: None, channel: 1, event });
        }
        profile
    }

    fn key(id: &str) -> Key {
        Key { channel: 1, id: id.parse().unwrap(), remote: false, fd: false }
    }

    #[test]
    fn everything_that_differs_is_found_and_nothing_else() {
        let a = profile(&[
            (0, "100#0011"),
            (10, "100#0011"),
            (20, "100#0111"),
            (0, "200#AA"),
            (10, "200#AA"),
            (0, "300#"),
            (5, "00000100#"),
        ]);
        let b = profile(&[
            (0, "100#0011"),
            (20, "100#0012"),
            (40, "100#0111"),
            (5, "200#AA"),
            (16, "200#AA"),
            (0, "400#"),
            (1, "400#R"),
            (5, "00000100#01"),
        ]);
        let difference = compare(&a, &b, 0.1);
        assert_eq!(difference.only_a, [(key("300"), 1)]);
        assert_eq!(difference.only_b, [(key("400"), 1), (Key { remote: true, ..key("400") }, 1)]);
        let byte = |byte, a: &str, b: &str| ChangedByte { byte, a: a.to_owned(), b: b.to_owned() };
        assert_eq!(
            difference.changed,
            [
                Changed {
                    key: key("100"),
                    period_ns: Some((10e6, 20e6)),
                    dlcs: None,
                    flags: None,
                    bytes: vec![byte(1, "00010001", "000100xx")]
                },
                Changed {
                    key: key("00000100"),
                    period_ns: None,
                    dlcs: Some((vec![0], vec![1])),
                    flags: None,
                    bytes: vec![byte(0, "", "00000001")]
                },
            ]
        );
        assert_eq!(difference.same, 1, "200's period is 10 % longer: within the tolerance");
        assert!(compare(&a, &a, 0.0).is_none());
    }

    #[test]
    fn fd_frames_are_compared_to_their_last_byte_and_with_their_flags() {
        let with = |flags, last| format!("100##{flags}{}{last:02X}", "00".repeat(63));
        let fd = Key { fd: true, ..key("100") };
        let a = profile(&[(0, &with(1, 0x10)), (10, "200##0"), (20, "300#")]);
        let b = profile(&[(0, &with(3, 0x11)), (10, "200#"), (20, "300#")]);
        let difference = compare(&a, &b, 0.1);
        let byte = ChangedByte { byte: 63, a: "00010000".to_owned(), b: "00010001".to_owned() };
        let flags = Some((vec![1], vec![3]));
        assert_eq!(
            difference.changed,
            [Changed { key: fd, period_ns: None, dlcs: None, flags, bytes: vec![byte] }]
        );
        assert_eq!(difference.only_a, [(Key { fd: true, ..key("200") }, 1)]);
        assert_eq!(difference.only_b, [(key("200"), 1)]);
        assert_eq!(difference.same, 1);
    }

    #[test]
    fn each_difference_alone_is_one() {
        let whole = |a: &[(i64, &str)], b: &[(i64, &str)]| compare(&profile(a), &profile(b), 0.1);
        let a: &[(i64, &str)] = &[(0, "100##011"), (10, "100##011")];
        for (b, [period, dlcs, flags, bytes]) in [
            (&[(0, "100##011"), (20, "100##011")][..], [true, false, false, false]),
            (&[(0, "100##111"), (10, "100##111")], [false, false, true, false]),
            (&[(0, "100##012"), (10, "100##012")], [false, false, false, true]),
            // Only a longer frame has other lengths, and then it has other bytes, too.
            (&[(0, "100##01100"), (10, "100##01100")], [false, true, false, true]),
        ] {
            let difference = whole(a, b);
            assert!(!difference.is_none() && difference.same == 0);
            let [changed] = &difference.changed[..] else { panic!("{difference:?}") };
            let differs = [
                changed.period_ns.is_some(),
                changed.dlcs.is_some(),
                changed.flags.is_some(),
                !changed.bytes.is_empty(),
            ];
            assert_eq!(differs, [period, dlcs, flags, bytes]);
        }
        // Lengths differ without any byte that does: remote frames.
        let difference = whole(&[(0, "100#R1")], &[(0, "100#R2")]);
        assert_eq!(difference.changed[0].dlcs, Some((vec![1], vec![2])));
        // What is on one side only is a difference, on either.
        assert!(!whole(a, &[]).is_none() && !whole(&[], a).is_none() && whole(&[], &[]).is_none());
        // One frame has no period.
        assert!(whole(&[(0, "100#")], &[(5, "100#")]).is_none());
    }

    #[test]
    fn channels_are_told_apart_unless_they_are_to_be_ignored() {
        let on = |channel, mut profile: Profile| {
            let event =
                TraceEvent::Frame { frame: "100#".parse().unwrap(), direction: Direction::Rx, late: false };
            profile.add(&TraceRecord { time_ns: 0, device_ns: None, channel, event });
            profile
        };
        assert!(!compare(&on(1, Profile::default()), &on(2, Profile::default()), 0.1).is_none());
        let ignoring = on(1, Profile::ignoring_channels());
        assert_eq!(ignoring.kinds().map(|(key, _)| key.channel).collect::<Vec<_>>(), [0]);
        assert!(compare(&ignoring, &on(2, Profile::ignoring_channels()), 0.1).is_none());
    }
}
