//! Transfers of many frames: ISO 15765-2 in normal, extended and mixed addressing, on classical CAN and CAN FD.
//!
//! The identifiers that take part are those reserved by the standards (7DF, 7E0 to 7EF, 18DAxxyy, 18DBxxyy, 18CExxyy,
//! 18CDxxyy), those of the given pairs, and those that [`Transport`] finds by their behaviour.
//!
//! Memory: at most 256 transfers in progress, each of at most 64 KiB, and 1024 pairs that were found. A transfer holds only the
//! bytes that arrived, so first frames without successors cost next to nothing.

mod finder;
mod pairs;
mod pci;
#[cfg(test)]
mod tests;
mod transfer;

pub use pairs::{BadPair, Endpoint, Pair};
pub use pci::{FlowStatus, Pci, parse};
pub use transfer::Transfer;

use cantap_trace::TraceRecord;
use rustc_hash::FxHashMap;

use self::finder::Finder;
use self::pairs::Pairs;
use crate::{Assembler, Bytes, Event, Field, Party, Protocol, Trouble, UnderWay, is_gap};

/// How long the receiver waits for the next frame: N_Cr.
const NEXT_TIMEOUT_NS: i64 = 1_000_000_000;
/// How often to check for timeouts.
const SWEEP_NS: i64 = 100_000_000;
/// How many transfers may be in progress at a time.
const MOST_OPEN: usize = 256;
/// How many bytes of a transfer are kept.
const MOST_BYTES: usize = 1 << 16;
/// A transfer of a pair that was only just found is reported as broken only from this many frames on; with fewer, it
/// was probably not a transfer.
const FRAMES_THAT_CONVINCE: u32 = 4;

/// A transfer in progress.
#[derive(Clone, Debug)]
struct Open {
    transfer: Transfer,
    /// The next sequence number.
    next: u8,
    /// Its pair was found through this very transfer.
    is_new: bool,
    /// Length of the first frame including address and control information: the following ones have the same length, except
    /// for the last one.
    frame_bytes: usize,
    /// When the last consecutive frame came; frames of one block have a minimum separation.
    last_ns: Option<i64>,
}

/// Reassembles transfers.
#[derive(Clone, Debug, Default)]
pub struct Transport {
    pairs: Pairs,
    finder: Option<Finder>,
    open: FxHashMap<(u8, Endpoint), Open>,
    /// Runs of consecutive frames without a first frame: the last number of each, so that a run is reported
    /// once.
    headless: FxHashMap<(u8, Endpoint), u8>,
    sweep_ns: i64,
}

impl Transport {
    /// With pairs that are known on all channels; `finds` enables the search for others.
    pub fn new(pairs: &[Pair], finds: bool) -> Self {
        let mut transport = Self { finder: finds.then(Finder::default), ..Self::default() };
        for pair in pairs {
            transport.pairs.add(0, *pair);
        }
        transport
    }

    /// The other side of a sender, if it is known and unique.
    pub fn partner(&self, channel: u8, from: Endpoint) -> Option<Endpoint> {
        self.pairs.partner(channel, from)
    }

    /// Whether such a sender has begun a message in this time and not completed it.
    pub fn has_begun(
        &self,
        channel: u8,
        time_ns: std::ops::RangeInclusive<i64>,
        is_sender: impl Fn(Endpoint) -> bool,
    ) -> bool {
        let mut open = self.open.values().map(|open| &open.transfer);
        open.any(|open| open.channel == channel && time_ns.contains(&open.start_ns) && is_sender(open.from))
    }

    /// Takes the next record, and passes on the transfers that end with it, complete or not.
    pub fn take(&mut self, record: &TraceRecord, out: &mut impl FnMut(Transfer)) {
        if !self.open.is_empty() && record.time_ns >= self.sweep_ns {
            self.sweep(record.time_ns, out);
        }
        let channel = record.channel;
        let Some(frame) = record.frame() else {
            if is_gap(&record.event) {
                self.interrupt(channel);
            }
            return;
        };
        if frame.is_remote() {
            return;
        }
        let (id, bytes, time_ns) = (frame.id(), frame.data(), record.time_ns);
        let Some(offset) = self.pairs.offset(channel, id) else {
            let found = self.finder.as_mut().and_then(|finder| finder.take(channel, id, bytes, time_ns));
            let Some((pair, transfer)) = found else { return };
            if self.pairs.add(channel, pair) {
                let offset = usize::from(pair.a.address.is_some());
                // For a transfer that was only just found, the first frame is no longer available.
                let frame_bytes = first_frame_bytes(&transfer, offset);
                self.begin(Open { transfer, next: 1, is_new: true, frame_bytes, last_ns: None }, out);
                self.frame(record, offset, bytes, out);
            }
            return;
        };
        self.frame(record, offset, bytes, out);
    }

    /// The trace has ended: passes on whatever was in progress.
    pub fn finish(&mut self, out: &mut impl FnMut(Transfer)) {
        let mut open: Vec<_> = self.open.drain().map(|(_, open)| open).collect();
        open.sort_by_key(|open| open.transfer.start_ns);
        for open in open {
            end(open, Trouble::Unfinished, out);
        }
        self.headless.clear();
    }

    /// Appends the transfers in progress.
    pub fn under_way(&self, out: &mut Vec<UnderWay>) {
        out.extend(self.open.values().map(|Open { transfer, .. }| UnderWay {
            channel: transfer.channel,
            protocol: Protocol::IsoTp,
            from: transfer.from.into(),
            to: transfer.to.map_or(Party::Unknown, Party::from),
            start_ns: transfer.start_ns,
            received: transfer.data.len() as u32,
            length: Some(transfer.length),
        }));
    }

    /// Frames on the channel are missing.
    fn interrupt(&mut self, channel: u8) {
        for open in self.open.values_mut().filter(|open| open.transfer.channel == channel) {
            open.transfer.frames_lost = true;
        }
        if let Some(finder) = &mut self.finder {
            finder.interrupt(channel);
        }
    }

    /// Ends whatever has timed out.
    fn sweep(&mut self, now_ns: i64, out: &mut impl FnMut(Transfer)) {
        self.sweep_ns = now_ns.saturating_add(SWEEP_NS);
        let over = |open: &Open| now_ns.saturating_sub(open.transfer.time_ns) > NEXT_TIMEOUT_NS;
        if !self.open.values().any(over) {
            return;
        }
        let mut late: Vec<_> = self.open.extract_if(|_, open| over(open)).map(|(_, open)| open).collect();
        late.sort_by_key(|open| open.transfer.time_ns);
        for mut open in late {
            let after_ms = (NEXT_TIMEOUT_NS / 1_000_000) as u32;
            open.transfer.time_ns = open.transfer.time_ns.saturating_add(NEXT_TIMEOUT_NS);
            end(open, Trouble::Timeout { after_ms }, out);
        }
    }

    fn begin(&mut self, open: Open, out: &mut impl FnMut(Transfer)) {
        let key = (open.transfer.channel, open.transfer.from);
        if self.open.len() >= MOST_OPEN
            && let Some(oldest) =
                self.open.iter().min_by_key(|(_, open)| open.transfer.time_ns).map(|(key, _)| *key)
            && let Some(oldest) = self.open.remove(&oldest)
        {
            end(oldest, Trouble::GivenUp, out);
        }
        if self.open.is_empty() {
            self.sweep_ns = open.transfer.time_ns.saturating_add(SWEEP_NS);
        }
        self.open.insert(key, open);
    }

    fn frame(&mut self, record: &TraceRecord, offset: usize, bytes: &[u8], out: &mut impl FnMut(Transfer)) {
        let (channel, time_ns) = (record.channel, record.time_ns);
        let Some(id) = record.frame().map(cantap_trace::TraceFrame::id) else { return };
        let Some(address) =
            (offset == 1).then(|| bytes.first().copied()).map_or(Some(None), |byte| byte.map(Some))
        else {
            return;
        };
        let from = Endpoint { id, address };
        let key = (channel, from);
        let to = self.pairs.partner(channel, from);
        let fresh =
            Transfer { time_ns, start_ns: time_ns, channel, from, to, frames: 1, ..Transfer::empty() };
        let pci = match pci::parse(bytes, offset) {
            Ok(Some(pci)) => pci,
            Ok(None) => return,
            Err(fault) => {
                let data = Bytes::from_slice(&bytes[offset..]);
                out(Transfer { data, trouble: Some(Trouble::Malformed(fault)), ..fresh });
                return;
            }
        };
        match pci {
            Pci::Single(data) => {
                self.overlap(key, out);
                out(Transfer { data: Bytes::from_slice(data), length: data.len() as u32, ..fresh });
            }
            Pci::First { length, data } => {
                self.overlap(key, out);
                let transfer = Transfer { data: Bytes::from_slice(data), length, ..fresh };
                let frame_bytes = bytes.len();
                self.begin(Open { transfer, next: 1, is_new: false, frame_bytes, last_ns: None }, out);
            }
            Pci::Consecutive { number, data } => {
                self.consecutive(key, number, data, bytes.len(), &fresh, out);
            }
            Pci::Flow { status, block_size, separation_us } => {
                let Some(of) = to else { return };
                let Some(open) = self.open.get_mut(&(channel, of)) else { return };
                let transfer = &mut open.transfer;
                transfer.to.get_or_insert(from);
                transfer.frames += 1;
                transfer.time_ns = time_ns;
                open.last_ns = None;
                match status {
                    FlowStatus::Go => {
                        transfer.block_size = Some(block_size);
                        transfer.separation_us = Some(separation_us);
                    }
                    FlowStatus::Wait => transfer.waits += 1,
                    FlowStatus::Overflow => {
                        if let Some(open) = self.open.remove(&(channel, of)) {
                            end(open, Trouble::Overflow, out);
                        }
                    }
                }
            }
        }
    }

    /// The same sender begins a new transfer.
    fn overlap(&mut self, key: (u8, Endpoint), out: &mut impl FnMut(Transfer)) {
        if !self.headless.is_empty() {
            self.headless.remove(&key);
        }
        if self.open.is_empty() {
            return;
        }
        if let Some(open) = self.open.remove(&key) {
            end(open, Trouble::Overlapped, out);
        }
    }

    fn consecutive(
        &mut self,
        key: (u8, Endpoint),
        number: u8,
        data: &[u8],
        frame_bytes: usize,
        fresh: &Transfer,
        out: &mut impl FnMut(Transfer),
    ) {
        let Some(open) = self.open.get_mut(&key) else {
            // The rest of a transfer that has already ended, or whose beginning was not observed, is reported
            // once.
            if self.headless.len() >= MOST_OPEN {
                self.headless.clear();
            }
            let before = self.headless.insert(key, number);
            if before.is_none_or(|before| (before + 1) & 15 != number) {
                out(Transfer {
                    data: Bytes::from_slice(data),
                    trouble: Some(Trouble::Headless),
                    ..fresh.clone()
                });
            }
            return;
        };
        let transfer = &mut open.transfer;
        transfer.frames += 1;
        if let (Some(last_ns), Some(separation_us)) = (open.last_ns, transfer.separation_us) {
            // From the end of one frame to the beginning of the next: between two stamps there is also one
            // frame.
            let least_ns = i64::from(separation_us) * 1000;
            transfer.too_early += u32::from(fresh.time_ns.saturating_sub(last_ns) < least_ns);
        }
        open.last_ns = Some(fresh.time_ns);
        transfer.time_ns = fresh.time_ns;
        if number != open.next {
            let trouble = Trouble::Sequence { expected: open.next.into(), got: number.into() };
            if let Some(open) = self.open.remove(&key) {
                // What follows belongs to what has just been reported.
                self.headless.insert(key, number);
                end(open, trouble, out);
            }
            return;
        }
        open.next = (number + 1) & 15;
        let missing = (transfer.length as usize).saturating_sub(transfer.data.len());
        if data.len() < missing && frame_bytes < open.frame_bytes {
            if let Some(open) = self.open.remove(&key) {
                self.headless.insert(key, number);
                end(open, Trouble::Malformed("a frame in the middle is shorter than the first one"), out);
            }
            return;
        }
        let room = MOST_BYTES.saturating_sub(transfer.data.len());
        transfer.data.extend_from_slice(&data[..data.len().min(missing).min(room)]);
        let all = transfer.data.len() == transfer.length as usize;
        if (all || transfer.data.len() == MOST_BYTES)
            && let Some(open) = self.open.remove(&key)
        {
            if all {
                out(open.transfer);
            } else {
                self.headless.insert(key, number);
                end(open, Trouble::Cut, out);
            }
        }
    }
}

/// The length of the first frame, derived from how much of the message it contained.
fn first_frame_bytes(transfer: &Transfer, offset: usize) -> usize {
    let control = if transfer.length > 4095 { 6 } else { 2 };
    offset + control + transfer.data.len()
}

/// Passes on an incomplete transfer.
fn end(open: Open, trouble: Trouble, out: &mut impl FnMut(Transfer)) {
    let mut transfer = open.transfer;
    if !open.is_new || transfer.frames >= FRAMES_THAT_CONVINCE {
        transfer.trouble = Some(trouble);
        out(transfer);
    }
}

/// Transfers as events, without interpreting them.
#[derive(Clone, Debug, Default)]
pub struct IsoTp {
    transport: Transport,
}

impl IsoTp {
    /// With pairs that are known on all channels; `finds` enables the search for others.
    pub fn new(pairs: &[Pair], finds: bool) -> Self {
        Self { transport: Transport::new(pairs, finds) }
    }
}

impl Assembler for IsoTp {
    fn take(&mut self, record: &TraceRecord, events: &mut Vec<Event>) {
        self.transport.take(record, &mut |transfer| events.push(transfer.into()));
    }

    fn finish(&mut self, events: &mut Vec<Event>) {
        self.transport.finish(&mut |transfer| events.push(transfer.into()));
    }

    fn under_way(&self, out: &mut Vec<UnderWay>) {
        self.transport.under_way(out);
    }
}

impl From<Transfer> for Event {
    fn from(transfer: Transfer) -> Self {
        let mut fields = Vec::new();
        let is_whole = transfer.is_whole();
        if transfer.length > 0 {
            fields.push(Field::number("length", transfer.length).unit("bytes"));
        }
        if !is_whole {
            fields.push(Field::number("received", transfer.data.len() as i64).unit("bytes"));
        }
        if let (Some(block_size), Some(separation_us)) = (transfer.block_size, transfer.separation_us) {
            fields.push(Field::number("block_size", block_size));
            fields.push(Field::number("separation_us", separation_us));
        }
        for (name, count) in [("waits", transfer.waits), ("too_early", transfer.too_early)] {
            if count > 0 {
                fields.push(Field::number(name, count).unit("frames"));
            }
        }
        fields.push(Field::bytes("data", &transfer.data));
        Self {
            time_ns: transfer.time_ns,
            start_ns: transfer.start_ns,
            channel: transfer.channel,
            protocol: Protocol::IsoTp,
            from: transfer.from.into(),
            to: transfer.to.map_or(Party::Unknown, Party::from),
            kind: if is_whole { "transfer" } else { "broken" },
            title: if is_whole { "transfer".into() } else { "broken transfer".into() },
            fields,
            data: transfer.data,
            response_ns: None,
            frames: transfer.frames,
            trouble: transfer.trouble,
            frames_lost: transfer.frames_lost,
        }
    }
}
