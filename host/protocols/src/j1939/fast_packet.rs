//! NMEA 2000's fast packets: up to 223 bytes in up to 32 frames.
//!
//! Memory: at most 256 in progress, each of at most 223 bytes.

use cantap_can::Frame;
use rustc_hash::FxHashMap;

use super::header::Header;
use super::transport::{Assembled, Way};
use crate::{Bytes, Trouble};

/// Maximum time between two frames of a packet.
const NEXT_NS: i64 = 750_000_000;
const SWEEP_NS: i64 = 100_000_000;
const MOST_OPEN: usize = 256;
const MOST_BYTES: u8 = MOST_FAST_BYTES as u8;
/// The longest message by fast packet, in bytes.
pub const MOST_FAST_BYTES: usize = 223;

/// Channel, sender, receiver, group and sequence counter of the packet.
type Key = (u8, u8, u8, u32, u8);

/// The frames of a message by fast packet, of at most [`MOST_FAST_BYTES`]; bytes beyond are left out, places without data are FF. `counter` tells
/// one message of a sender and group from the next; its three low bits count.
pub fn fast_frames(header: Header, counter: u8, data: &[u8]) -> Vec<Frame> {
    let data = &data[..data.len().min(MOST_FAST_BYTES)];
    let (first, rest) = data.split_at(data.len().min(6));
    let parts = std::iter::once(first).chain(rest.chunks(7));
    let frame = |(number, part): (usize, &[u8])| {
        let mut bytes = [0xFF; 8];
        bytes[0] = counter << 5 | number as u8;
        let from = if number == 0 { 2 } else { 1 };
        if number == 0 {
            bytes[1] = data.len() as u8;
        }
        bytes[from..from + part.len()].copy_from_slice(part);
        Frame::from_bus(header.id(), false, 8, bytes)
    };
    parts.enumerate().map(frame).collect()
}

/// Reassembles fast packets.
#[derive(Clone, Debug, Default)]
pub struct FastPackets {
    /// Each with the number of the next frame.
    open: FxHashMap<Key, (Assembled, u8)>,
    /// Packets that ended early, or whose beginning was not observed: the rest of each is reported once.
    headless: FxHashMap<Key, u8>,
    sweep_ns: i64,
}

impl FastPackets {
    /// Frames on the channel are missing.
    pub fn interrupt(&mut self, channel: u8) {
        for (message, _) in self.open.values_mut().filter(|(message, _)| message.channel == channel) {
            message.frames_lost = true;
        }
    }

    /// Those in progress.
    pub fn open(&self) -> impl Iterator<Item = &Assembled> {
        self.open.values().map(|(message, _)| message)
    }

    /// Ends whatever has timed out.
    pub fn advance(&mut self, now_ns: i64, out: &mut impl FnMut(Assembled)) {
        if self.open.is_empty() || now_ns < self.sweep_ns {
            return;
        }
        self.sweep_ns = now_ns.saturating_add(SWEEP_NS);
        let over = |message: &Assembled| now_ns.saturating_sub(message.time_ns) > NEXT_NS;
        let mut late: Vec<_> =
            self.open.extract_if(|_, (message, _)| over(message)).map(|(_, (message, _))| message).collect();
        late.sort_by_key(|message| message.time_ns);
        for mut message in late {
            message.time_ns = message.time_ns.saturating_add(NEXT_NS);
            let after_ms = (NEXT_NS / 1_000_000) as u32;
            out(Assembled { trouble: Some(Trouble::Timeout { after_ms }), ..message });
        }
    }

    /// The trace has ended.
    pub fn finish(&mut self, out: &mut impl FnMut(Assembled)) {
        let mut open: Vec<_> = self.open.drain().map(|(_, (message, _))| message).collect();
        open.sort_by_key(|message| message.start_ns);
        for message in open {
            out(Assembled { trouble: Some(Trouble::Unfinished), ..message });
        }
    }

    /// Takes a frame.
    pub fn take(
        &mut self,
        channel: u8,
        time_ns: i64,
        header: Header,
        data: &[u8],
        out: &mut impl FnMut(Assembled),
    ) {
        let Some((&first, rest)) = data.split_first() else { return };
        let (counter, number) = (first >> 5, first & 31);
        let key = (channel, header.source, header.destination, header.pgn, counter);
        let fresh = || Assembled {
            time_ns,
            start_ns: time_ns,
            channel,
            header,
            way: Way::FastPacket,
            data: Bytes::new(),
            size: 0,
            frames: 1,
            cleared_ns: None,
            trouble: None,
            frames_lost: false,
        };
        if number == 0 {
            if !self.headless.is_empty() {
                self.headless.remove(&key);
            }
            if let Some((before, _)) = self.open.remove(&key) {
                out(Assembled { trouble: Some(Trouble::Overlapped), ..before });
            }
            let Some((&size, bytes)) = rest.split_first().filter(|(size, _)| **size <= MOST_BYTES) else {
                let fault = "a fast packet has at most 223 bytes";
                out(Assembled {
                    data: Bytes::from_slice(data),
                    trouble: Some(Trouble::Malformed(fault)),
                    ..fresh()
                });
                return;
            };
            let data = Bytes::from_slice(&bytes[..bytes.len().min(usize::from(size))]);
            let message = Assembled { size: size.into(), data, ..fresh() };
            self.go_on(key, message, 1, out);
            return;
        }
        let Some((mut message, next)) = self.open.remove(&key) else {
            if self.headless.len() >= MOST_OPEN {
                self.headless.clear();
            }
            if self.headless.insert(key, number).is_none_or(|before| before + 1 != number) {
                out(Assembled { data: Bytes::from_slice(rest), trouble: Some(Trouble::Headless), ..fresh() });
            }
            return;
        };
        message.time_ns = time_ns;
        message.frames += 1;
        if number != next {
            let trouble = Trouble::Sequence { expected: next.into(), got: number.into() };
            self.headless.insert(key, number);
            out(Assembled { trouble: Some(trouble), ..message });
            return;
        }
        let missing = message.size as usize - message.data.len();
        message.data.extend_from_slice(&rest[..rest.len().min(missing)]);
        self.go_on(key, message, number + 1, out);
    }

    fn go_on(&mut self, key: Key, message: Assembled, next: u8, out: &mut impl FnMut(Assembled)) {
        if message.data.len() == message.size as usize {
            out(message);
            return;
        }
        if next > 31 {
            let fault = "a frame was shorter than its place";
            out(Assembled { trouble: Some(Trouble::Malformed(fault)), ..message });
            return;
        }
        if self.open.len() >= MOST_OPEN
            && let Some(oldest) =
                self.open.iter().min_by_key(|(_, (message, _))| message.time_ns).map(|(key, _)| *key)
            && let Some((oldest, _)) = self.open.remove(&oldest)
        {
            out(Assembled { trouble: Some(Trouble::GivenUp), ..oldest });
        }
        if self.open.is_empty() {
            self.sweep_ns = message.time_ns.saturating_add(SWEEP_NS);
        }
        self.open.insert(key, (message, next));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_length_is_reassembled_as_it_was_cut() {
        let header =
            Header { priority: 6, pgn: 129_029, source: 35, destination: super::super::header::GLOBAL };
        for length in 0..=MOST_FAST_BYTES {
            let data: Vec<u8> = (0..length).map(|at| at as u8).collect();
            let frames = fast_frames(header, 9, &data);
            assert_eq!(frames.len(), if length < 7 { 1 } else { 1 + (length - 6).div_ceil(7) });
            let (mut packets, mut whole) = (FastPackets::default(), Vec::new());
            for frame in frames {
                packets.take(1, 0, header, frame.data(), &mut |message| whole.push(message));
            }
            assert_eq!(whole.len(), 1, "{length}");
            assert!(whole[0].trouble.is_none() && whole[0].data[..] == data[..], "{length}");
        }
    }
}
