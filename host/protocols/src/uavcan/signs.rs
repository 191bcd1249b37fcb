//! Signs of DroneCAN and Cyphal on one channel: last bytes of frames that follow each other as only theirs do.

use cantap_trace::TraceFrame;
use rustc_hash::FxHashMap;

use super::header::{Header, Purpose, Tail};
use super::message::crc_of;
use super::nodes::status_port;
use crate::Protocol;
use crate::dsdl::{DataTypes, Generation, crc16};

/// How many identifiers are followed; a bus of theirs has fewer.
const MOST_IDS: usize = 2048;
/// The most bytes that are kept of a transfer.
const MOST_BYTES: usize = 512;
/// So often must the number of transfers have begun anew behind 31, where there is neither a node's report nor a CRC: other bytes that count go on.
const ENOUGH_WRAPS: u32 = 2;

/// Counts on one channel.
#[derive(Clone, Debug, Default)]
pub(crate) struct UavcanSigns {
    ids: FxHashMap<u32, Followed>,
    all: u32,
    dronecan: Counts,
    cyphal: Counts,
}

#[derive(Clone, Copy, Debug, Default)]
struct Counts {
    /// Frames that are as the ones before them ask for.
    follows: u32,
    /// Frames that are not.
    breaks: u32,
    /// Transfers with number 0 that follow those with 31.
    wraps: u32,
    /// Reports of a node that follow each other, and CRCs that fit.
    proofs: u32,
}

/// The last frame with an identifier.
#[derive(Clone, Debug)]
struct Followed {
    tail: Tail,
    generation: Generation,
    uptime_s: u32,
    payload: Vec<u8>,
}

impl UavcanSigns {
    /// Takes a data frame with 29 bits; returns the protocols whose frame it is.
    pub fn take(&mut self, frame: &TraceFrame) -> u16 {
        self.all += 1;
        let Some((tail, payload)) = Tail::of(frame.data()) else { return 0 };
        let id = frame.id();
        let before = self.ids.get(&id.raw());
        let generation = match (tail.starts, before) {
            (true, _) => tail.generation(),
            (false, Some(before)) => before.generation,
            (false, None) => return 0,
        };
        let Some(header) = Header::of(id, generation) else { return 0 };
        let follows = before.map(|before| {
            let is_next = tail.starts
                && before.tail.ends
                && before.generation == generation
                && tail.transfer == (before.tail.transfer + 1) % 32;
            let goes_on = !tail.starts
                && !before.tail.ends
                && tail.transfer == before.tail.transfer
                && tail.toggle != before.tail.toggle;
            is_next || goes_on
        });
        let counts = match generation {
            Generation::DroneCan => &mut self.dronecan,
            Generation::Cyphal => &mut self.cyphal,
        };
        let is_status = header.purpose == Purpose::Message
            && header.port == status_port(generation)
            && header.source.is_some()
            && tail.starts
            && tail.ends
            && payload.len() == 7;
        let uptime_s = match (is_status, payload) {
            (true, [a, b, c, d, ..]) => u32::from_le_bytes([*a, *b, *c, *d]),
            _ => 0,
        };
        match follows {
            Some(true) => {
                counts.follows += 1;
                counts.wraps += u32::from(tail.starts && tail.transfer == 0);
            }
            Some(false) => counts.breaks += 1,
            None => {}
        }
        if follows == Some(true) && is_status {
            let since = before.map_or(0, |before| uptime_s.wrapping_sub(before.uptime_s));
            counts.proofs += u32::from((0..=3).contains(&since));
        }
        let mut held = if tail.starts {
            Vec::new()
        } else {
            self.ids.get_mut(&id.raw()).map_or_else(Vec::new, |before| std::mem::take(&mut before.payload))
        };
        let is_long = !(tail.starts && tail.ends);
        if is_long && follows != Some(false) && held.len() + payload.len() <= MOST_BYTES {
            held.extend_from_slice(payload);
        } else {
            held.clear();
        }
        if tail.ends && !tail.starts && follows == Some(true) && is_whole(generation, header, &held) {
            counts.proofs += 1;
        }
        if self.ids.len() < MOST_IDS || self.ids.contains_key(&id.raw()) {
            self.ids.insert(id.raw(), Followed { tail, generation, uptime_s, payload: held });
        }
        if follows == Some(false) { 0 } else { protocol(generation).bit() }
    }

    /// Nothing of them is there.
    pub fn is_empty(&self) -> bool {
        self.dronecan.follows + self.cyphal.follows == 0
    }

    /// The number of frames that indicate either; zero for what is not there.
    pub fn found(&self) -> [(Protocol, u32); 2] {
        let count = |counts: Counts| {
            let Counts { follows, breaks, wraps, proofs } = counts;
            let is_most = follows / 4 >= breaks && follows.saturating_mul(8) >= self.all;
            if is_most && (proofs > 0 || wraps >= ENOUGH_WRAPS && breaks == 0) { follows } else { 0 }
        };
        [(Protocol::DroneCan, count(self.dronecan)), (Protocol::Cyphal, count(self.cyphal))]
    }
}

const fn protocol(generation: Generation) -> Protocol {
    match generation {
        Generation::DroneCan => Protocol::DroneCan,
        Generation::Cyphal => Protocol::Cyphal,
    }
}

/// Whether the CRC of a transfer fits.
fn is_whole(generation: Generation, header: Header, payload: &[u8]) -> bool {
    match (generation, payload) {
        (Generation::DroneCan, [low, high, rest @ ..]) => {
            let types = DataTypes::built_in();
            let library = types.of(generation);
            let crc = u16::from_le_bytes([*low, *high]);
            let fits = |signature| crc == crc_of(signature, rest);
            match header.purpose {
                Purpose::Message => library.messages(header.port).any(|known| fits(known.signature)),
                Purpose::Request | Purpose::Response => {
                    library.services(header.port).any(|known| fits(known.signature))
                }
            }
        }
        (Generation::Cyphal, [_, _, _, ..]) => crc16(0xFFFF, payload) == 0,
        _ => false,
    }
}
