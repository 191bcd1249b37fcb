//! Finds pairs by their behaviour: a first frame, a flow control frame from the other side, and the first consecutive
//! frame.
//!
//! Every frame on a bus whose identifier belongs to no pair passes through here, and most are not part of any transfer. So
//! whatever a frame shows on its own is checked before the candidates, and a candidate allocates no memory.

use std::ops::RangeInclusive;

use cantap_trace::fd::FD_MAX_BYTES;
use cantap_trace::{Id, TraceRecord};

use super::exchanges::{is_expected, is_padded};
use super::marks::Marks;
use super::pairs::{Endpoint, Pair};
use super::pci::{self, FlowStatus, Pci};
use super::transfer::Transfer;
use crate::Bytes;

/// How long the sender waits for flow control: N_Bs (ISO 15765-2:2016, table 21).
const FLOW_TIMEOUT_NS: i64 = 1_000_000_000;
/// How many first frames may wait for their flow control, on all channels together.
const MOST_CANDIDATES: usize = 64;

/// The longest message whose first frame is taken for one, in bytes: lengths of four bytes are more often other data.
const MOST_LENGTH: u32 = 1 << 24;

/// A frame that may be a first frame.
#[derive(Clone, Debug)]
struct Candidate {
    channel: u8,
    from: Endpoint,
    time_ns: i64,
    length: u32,
    /// The first bytes, and their number.
    data: ([u8; FD_MAX_BYTES], u8),
    flow: Option<(Endpoint, u8, u32)>,
}

/// Looks for pairs among the identifiers that belong to none.
#[derive(Clone, Debug, Default)]
pub(super) struct Finder {
    candidates: Vec<Candidate>,
    marks: Marks,
}

impl Finder {
    /// Takes a frame; if it is the first consecutive frame, returns the pair and the transfer that has begun, which must then still
    /// take this frame. There are so many bytes of address, as far as that is known.
    pub fn take(
        &mut self,
        record: &TraceRecord,
        id: Id,
        bytes: &[u8],
        readings: RangeInclusive<usize>,
    ) -> Option<(Pair, Transfer)> {
        let (channel, time_ns) = (record.channel, record.time_ns);
        // A sender that sends anything else before its first consecutive frame is not sending a transfer.
        if self.marks.may_have(id) {
            let goes_on = |candidate: &Candidate| {
                let place = usize::from(candidate.from.address.is_some());
                bytes.get(place) == Some(&0x21) && candidate.flow.is_some()
            };
            let before = self.candidates.len();
            self.candidates.retain(|candidate| {
                (candidate.channel, candidate.from.id) != (channel, id) || goes_on(candidate)
            });
            if self.candidates.len() < before {
                self.mark();
            }
        }
        // There may or may not be an address before it.
        for offset in readings {
            let Some(&first) = bytes.get(offset) else { continue };
            match first >> 4 {
                1 | 3 => {}
                2 if self.marks.may_have(id) => {}
                _ => continue,
            }
            let Ok(Some(pci)) = pci::parse(bytes, offset) else { continue };
            let from = Endpoint { id, address: (offset == 1).then(|| bytes[0]) };
            match pci {
                Pci::First { length, data } if length <= MOST_LENGTH => {
                    if self.candidates.len() == MOST_CANDIDATES {
                        // The oldest one, which is the first to become too old.
                        self.candidates.swap_remove(self.oldest());
                    }
                    let mut kept = [0; FD_MAX_BYTES];
                    kept[..data.len()].copy_from_slice(data);
                    let data = (kept, data.len() as u8);
                    self.candidates.push(Candidate { channel, from, time_ns, length, data, flow: None });
                    self.marks.set(id);
                }
                Pci::Flow { status: FlowStatus::Go, block_size, separation_us }
                    if is_padded(&bytes[offset + 3..]) =>
                {
                    // The last one before the first consecutive frame counts: that frame follows immediately.
                    for candidate in &mut self.candidates {
                        if candidate.channel == channel
                            && candidate.from.id != id
                            && candidate.from.id.is_extended() == id.is_extended()
                            && candidate.from.address.is_some() == from.address.is_some()
                            && time_ns.saturating_sub(candidate.time_ns) <= FLOW_TIMEOUT_NS
                        {
                            let before =
                                candidate.flow.map(|(before, ..)| is_expected(before, candidate.from));
                            // Several may be under way: one that is expected is not replaced by another's.
                            if before != Some(true) || is_expected(from, candidate.from) {
                                candidate.flow = Some((from, block_size, separation_us));
                            }
                        }
                    }
                }
                Pci::Consecutive { number: 1, .. } => {
                    let place = self.candidates.iter().position(|candidate| {
                        (candidate.channel, candidate.from) == (channel, from) && candidate.flow.is_some()
                    });
                    if let Some(place) = place {
                        let found = self.candidates.swap_remove(place);
                        self.mark();
                        let (to, block_size, separation_us) = found.flow?;
                        let transfer = Transfer {
                            time_ns: found.time_ns,
                            start_ns: found.time_ns,
                            channel,
                            from,
                            to: Some(to),
                            data: Bytes::from_slice(&found.data.0[..usize::from(found.data.1)]),
                            length: found.length,
                            frames: 2,
                            block_size: Some(block_size),
                            separation_us: Some(separation_us),
                            ..Transfer::empty()
                        };
                        return Some((Pair { a: from, b: to }, transfer));
                    }
                }
                _ => {}
            }
        }
        None
    }

    /// This sender is one of a pair by now.
    pub fn forget(&mut self, channel: u8, from: Endpoint) {
        self.candidates.retain(|candidate| (candidate.channel, candidate.from) != (channel, from));
        self.mark();
    }

    /// Frames on the channel are missing: what comes next may belong to others.
    pub fn interrupt(&mut self, channel: u8) {
        self.candidates.retain(|candidate| candidate.channel != channel);
        self.mark();
    }

    fn oldest(&self) -> usize {
        let times = self.candidates.iter().enumerate().map(|(place, candidate)| (candidate.time_ns, place));
        times.min().map_or(0, |(_, place)| place)
    }

    /// Sets the marks of the remaining candidates.
    fn mark(&mut self) {
        self.marks = Marks::default();
        self.candidates.iter().for_each(|candidate| self.marks.set(candidate.from.id));
    }
}
