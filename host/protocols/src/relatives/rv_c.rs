//! RV-C has J1939's frames at J1939's rate, and groups of its own where J1939 and NMEA 2000 have those of makers.

use cantap_trace::TraceFrame;
use rustc_hash::{FxHashMap, FxHashSet};

use crate::j1939::{Header, rv_c_name as name};
use crate::nmea2000;

/// So many different groups show it, with so many messages.
const GROUPS_ENOUGH: usize = 4;
const MESSAGES_ENOUGH: u32 = 12;
/// So many senders and groups are watched for fast packets.
const MOST_WATCHED: usize = 4096;

/// Counts on a channel.
#[derive(Clone, Debug, Default)]
pub(super) struct Signs {
    /// Frames of the second page.
    second: u32,
    /// Of those, with a group of RV-C and eight bytes.
    own: u32,
    groups: FxHashSet<u32>,
    /// Groups that only NMEA 2000 has, and its fast packets: it uses the same numbers for groups of makers.
    marine: u32,
    /// The first byte of the last frame of each group and sender.
    last: FxHashMap<u32, u8>,
}

impl Signs {
    /// Takes a frame of 29 bits.
    pub fn take(&mut self, frame: &TraceFrame) {
        let Some(header) = Header::of(frame.id()).filter(|header| header.pgn >= 0x1_0000) else { return };
        let data = frame.data();
        self.second += 1;
        if nmea2000::is_known(header.pgn) && name(header.pgn).is_none() {
            self.marine += 1;
        }
        if data.len() != 8 || name(header.pgn).is_none() {
            return;
        }
        self.own += 1;
        self.groups.insert(header.pgn);
        let key = header.pgn << 8 | u32::from(header.source);
        if self.last.len() < MOST_WATCHED || self.last.contains_key(&key) {
            // Fast packets begin with 0, 32, 64, … and then count on. RV-C has an instance there: the first tank's is 0, the second one's 1.
            let before = self.last.insert(key, data[0]).filter(|before| *before > 0);
            let is_next = before.is_some_and(|before| before.is_multiple_of(32) && before + 1 == data[0]);
            self.marine += u32::from(is_next);
        }
    }

    /// Up to three of its groups, and how many there were, if it is RV-C.
    pub fn found(&self) -> Option<([Option<u32>; 3], u32)> {
        let is_one = self.groups.len() >= GROUPS_ENOUGH
            && self.own >= MESSAGES_ENOUGH
            && self.own > self.second / 2
            && self.marine == 0;
        if !is_one {
            return None;
        }
        let mut groups: Vec<_> = self.groups.iter().copied().collect();
        groups.sort_unstable_by(|a, b| b.cmp(a));
        let mut examples = [None; 3];
        examples.iter_mut().zip(&groups).for_each(|(example, pgn)| *example = Some(*pgn));
        Some((examples, groups.len() as u32))
    }
}

#[cfg(test)]
mod tests {
    use super::super::Relative;
    use super::*;

    fn found(frames: &[&str]) -> Option<Relative> {
        let mut signs = Signs::default();
        for frame in frames.iter().cycle().take(frames.len() * 4) {
            signs.take(&frame.parse().unwrap());
        }
        signs.found().map(|(examples, groups)| Relative::RvC { examples, groups })
    }

    /// Batteries, dimmers, an air conditioner and tanks, as in a motor home.
    #[test]
    fn four_groups_of_a_motor_home_are_rv_c() {
        let home = [
            "19FFFD46#017810D000E0B177",
            "19FEDA96#017CC8FCFFFF04FF",
            "19FEDA96#027CC8FCFFFF04FF",
            "19FFE096#0101FFFF64C8FFFF",
            "19FFB79C#0005FFFFFFFFFFFF",
            "19FFB79C#0109FFFFFFFFFFFF",
            "18FECA46#0545FFFFFFFFFFFF",
        ];
        let relative = found(&home).unwrap();
        assert_eq!(
            relative.to_string(),
            "RV-C (4 of its groups: 1FFFD DC_SOURCE_STATUS_1, 1FFE0 AIR_CONDITIONER_COMMAND, 1FFB7 TANK_STATUS)"
        );
        assert_eq!(found(&home[..4]), None, "three groups");
        // A boat: position beside groups of makers, or these alone in fast packets.
        assert_eq!(found(&[&home[..], &["09F80102#1122334455667788"]].concat()), None);
        assert_eq!(
            found(&[&home[..], &["19FFB71C#200EFFFFFFFFFFFF", "19FFB71C#21FFFFFFFFFFFFFF"]].concat()),
            None
        );
        // A truck with groups of its maker, of other lengths.
        let truck = ["19FFFD46#01", "19FEDA96#0102", "19FFE096#0101FFFF64C8FF", "19FFB79C#0005"];
        assert_eq!(found(&truck), None);
    }
}
