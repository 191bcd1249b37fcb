//! Signs of DroneCAN and Cyphal on one channel: last bytes of frames that follow each other as only theirs do.

use cantap_trace::TraceFrame;
use rustc_hash::FxHashMap;

use super::header::{Header, Purpose, Tail};
use super::message::crc_of;
use super::nodes::status_port;
use crate::Protocol;
use crate::crc::crc16;
use crate::dsdl::{DataTypes, Generation};

/// How many identifiers are followed; a bus of theirs has fewer.
const MOST_IDS: usize = 2048;
/// The most bytes that are kept of a transfer.
const MOST_BYTES: usize = 512;
/// So many frames that do not follow show that it is other traffic.
const MOST_BREAKS: u32 = 64;
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
        if self.is_hopeless() {
            return 0;
        }
        let Some((tail, payload)) = Tail::of(frame.data()) else { return 0 };
        let id = frame.id();
        let room = self.ids.len() < MOST_IDS;
        let before = self.ids.get_mut(&id.raw());
        let generation = match (tail.starts, &before) {
            (true, _) => tail.generation(),
            (false, Some(before)) => before.generation,
            (false, None) => return 0,
        };
        let Some(header) = Header::of(id, generation) else { return 0 };
        let counts = match generation {
            Generation::DroneCan => &mut self.dronecan,
            Generation::Cyphal => &mut self.cyphal,
        };
        let uptime_s = uptime(generation, header, tail, payload);
        let Some(before) = before else {
            if room {
                let payload = if tail.ends { Vec::new() } else { payload.to_vec() };
                let uptime_s = uptime_s.unwrap_or_default();
                self.ids.insert(id.raw(), Followed { tail, generation, uptime_s, payload });
            }
            return protocol(generation).bit();
        };
        let follows = before.is_followed_by(tail, generation);
        if follows {
            counts.follows += 1;
            counts.wraps += u32::from(tail.starts && tail.transfer == 0);
        } else {
            counts.breaks += 1;
        }
        if let Some(uptime_s) = uptime_s {
            let is_next = follows && (0..=3).contains(&uptime_s.wrapping_sub(before.uptime_s));
            counts.proofs += u32::from(is_next);
            before.uptime_s = uptime_s;
        }
        if tail.starts || !follows {
            before.payload.clear();
        }
        if !(tail.starts && tail.ends) && (follows || tail.starts) {
            // One that is too long to be kept is not checked.
            if before.payload.len() + payload.len() > MOST_BYTES {
                before.payload.clear();
            }
            before.payload.extend_from_slice(payload);
            if tail.ends && is_whole(generation, header, &before.payload) {
                counts.proofs += 1;
            }
        }
        (before.tail, before.generation) = (tail, generation);
        if follows { protocol(generation).bit() } else { 0 }
    }

    /// Other traffic, of which there is enough to say so.
    const fn is_hopeless(&self) -> bool {
        let breaks = self.dronecan.breaks + self.cyphal.breaks;
        breaks > MOST_BREAKS && breaks / 4 > self.dronecan.follows + self.cyphal.follows
    }

    /// Nothing of them is there.
    pub const fn is_empty(&self) -> bool {
        self.dronecan.follows + self.cyphal.follows == 0 || self.is_hopeless()
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

impl Followed {
    /// Whether a frame is as this one asks for.
    fn is_followed_by(&self, tail: Tail, generation: Generation) -> bool {
        if tail.starts {
            return self.tail.ends
                && self.generation == generation
                && tail.transfer == (self.tail.transfer + 1) % 32;
        }
        !self.tail.ends && tail.transfer == self.tail.transfer && tail.toggle != self.tail.toggle
    }
}

/// The time since its start that a node reports, in seconds, if that is what the frame is.
fn uptime(generation: Generation, header: Header, tail: Tail, payload: &[u8]) -> Option<u32> {
    let is_status = header.purpose == Purpose::Message
        && header.port == status_port(generation)
        && header.source.is_some()
        && tail.starts
        && tail.ends;
    match payload {
        &[a, b, c, d, _, _, _] if is_status => Some(u32::from_le_bytes([a, b, c, d])),
        _ => None,
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
