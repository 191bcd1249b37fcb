//! Transfers of many frames: ISO 15765-2 in normal, extended and mixed addressing, on classical CAN and CAN FD; and Volkswagen's transport
//! protocol 2.0 in channels that were agreed on.
//!
//! The identifiers that take part are those reserved by the standards (7DF, 7E0 to 7EF, 18DAxxyy, 18DBxxyy, 18CExxyy,
//! 18CDxxyy), those of the given pairs, and those that [`Transport`] finds by their behaviour: by transfers of many frames, and by
//! requests of diagnostics with their answers. What was heard of a pair before it was found is read when it has been.
//!
//! Memory: at most 256 transfers in progress, each of at most 64 KiB, 1024 pairs that were found, and 4096 frames of senders that may
//! turn out to be one of a pair. A transfer holds only the bytes that arrived, so first frames without successors cost next to nothing.

mod exchanges;
mod finder;
mod makers;
mod marks;
mod pairs;
mod pci;
#[cfg(test)]
mod tests;
mod tp20;
mod transfer;

pub use makers::{BadPairs, KnownPairs, Maker};
pub use pairs::{BadPair, Endpoint, Pair};
pub use pci::{FlowStatus, Pci, parse, separation_us};
pub use transfer::Transfer;

use std::ops::RangeInclusive;

use cantap_trace::{Id, TraceRecord};
use rustc_hash::FxHashMap;

use self::exchanges::{Client, Exchanges, Found, Held, is_expected};
use self::finder::Finder;
use self::pairs::{Pairs, Reading};
use self::tp20::Channels;
use crate::{Assembler, Bytes, Event, EventKind, Field, Party, Protocol, Trouble, UnderWay, is_gap};

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
    exchanges: Exchanges,
    /// Channels of Volkswagen's own transport protocol.
    tp20: Channels,
    /// The next transfer comes after a loss that has not been reported.
    after_loss: bool,
    open: FxHashMap<(u8, Endpoint), Open>,
    /// Runs of consecutive frames without a first frame: the last number of each, so that a run is reported
    /// once.
    headless: FxHashMap<(u8, Endpoint), u8>,
    sweep_ns: i64,
}

impl Transport {
    /// With pairs that are known on all channels; `finds` enables the search for others.
    pub fn new(pairs: &[KnownPairs], finds: bool) -> Self {
        let mut transport = Self { finder: finds.then(Finder::default), ..Self::default() };
        for pair in pairs {
            match pair {
                KnownPairs::One(pair) => {
                    transport.pairs.add(0, *pair);
                }
                KnownPairs::Of(maker) => transport.exchanges.give(makers::rules_of(*maker)),
            }
        }
        transport
    }

    /// The other side of a sender, if it is known and unique.
    pub fn partner(&self, channel: u8, from: Endpoint) -> Option<Endpoint> {
        self.pairs.partner(channel, from)
    }

    /// The ECU, if this sender talks in a channel of Volkswagen's transport protocol.
    pub(crate) fn server_of_tp20(&self, channel: u8, from: Endpoint) -> Option<Endpoint> {
        self.tp20.server(channel, from)
    }

    /// Whether a sender asks several others, or nobody knows whom.
    pub fn is_to_all(&self, channel: u8, from: Endpoint) -> bool {
        self.pairs.is_known(channel, from) && self.pairs.partner(channel, from).is_none()
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
        if !self.tp20.is_empty() {
            self.tp20.advance(record.time_ns, out);
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
        let (id, bytes) = (frame.id(), frame.data());
        if self.finder.is_some() {
            if self.tp20.take(record, id, bytes, out) {
                return;
            }
            self.read_unanswered(record.time_ns, out);
        }
        match self.pairs.reading(channel, id, bytes) {
            Reading::Known(offset) => {
                if self.finder.is_some() {
                    let from = Endpoint { id, address: bytes.first().copied().filter(|_| offset == 1) };
                    let pairs = &self.pairs;
                    let asks = || {
                        let server = pairs.partner(channel, from);
                        let is_closed = server.is_some() && !pairs.was_found(channel, from);
                        (if is_closed { Client::Closed } else { Client::Open }, server)
                    };
                    if let Some(found) = self.exchanges.take_known(record, from, bytes, asks) {
                        self.adopt(found, out);
                    }
                }
                self.frame(record, offset, bytes, out);
            }
            Reading::Unknown(readings) => self.find(record, id, bytes, readings, out),
        }
    }

    /// Takes a frame whose sender is not known.
    fn find(
        &mut self,
        record: &TraceRecord,
        id: Id,
        bytes: &[u8],
        readings: RangeInclusive<usize>,
        out: &mut impl FnMut(Transfer),
    ) {
        let Some(finder) = &mut self.finder else { return };
        if let Some(found) = self.exchanges.take(record, id, bytes, readings.clone()) {
            self.adopt(found, out);
            return;
        }
        let Some((pair, transfer)) = finder.take(record, id, bytes, readings) else { return };
        let found = self.exchanges.found(record.channel, pair.a, Some(pair.b));
        // For a transfer that was only just found, the first frame is no longer available. Of one that was asked for, that is no matter.
        let is_new = found.held.is_empty();
        self.adopt(found, out);
        let Reading::Known(offset) = self.pairs.reading(record.channel, id, bytes) else { return };
        let frame_bytes = first_frame_bytes(&transfer, offset);
        self.begin(Open { transfer, next: 1, is_new, frame_bytes, last_ns: None }, out);
        self.frame(record, offset, bytes, out);
    }

    /// From now on, these two are a pair; reads what they have said.
    fn adopt(&mut self, found: Found, out: &mut impl FnMut(Transfer)) {
        let Found { channel, client, server, held } = found;
        let is_added = match server {
            None => self.pairs.add_alone(channel, client),
            Some(server) => self.add(channel, client, server),
        };
        if !is_added {
            return;
        }
        if let Some(finder) = &mut self.finder {
            [Some(client), server].into_iter().flatten().for_each(|one| finder.forget(channel, one));
        }
        for Held { record, after_loss, .. } in held {
            self.after_loss |= after_loss;
            let Some(frame) = record.frame() else { continue };
            if !self.open.is_empty() && record.time_ns >= self.sweep_ns {
                self.sweep(record.time_ns, out);
            }
            if let Reading::Known(offset) = self.pairs.reading(channel, frame.id(), frame.data()) {
                self.frame(&record, offset, frame.data(), out);
            }
        }
        self.after_loss = false;
    }

    /// Adds a pair, or one more server of a client that asks several at once.
    fn add(&mut self, channel: u8, client: Endpoint, server: Endpoint) -> bool {
        let other = |one| self.pairs.partner(channel, one);
        let talks_to_another = |one, this| other(one).is_some_and(|other| other != this);
        if self.pairs.is_known(channel, client) {
            if talks_to_another(client, server) && !self.pairs.was_found(channel, client) {
                // One of the standard's, or given: it has its server, and this one only says the same.
                return self.pairs.add_alone(channel, server);
            }
            if other(client) != Some(server) {
                return self.pairs.add_alone(channel, client) && self.pairs.add_alone(channel, server);
            }
            return true;
        }
        if makers::is_to_all(client) {
            let is_known = self.pairs.is_known(channel, server);
            return self.pairs.add_alone(channel, client)
                && (is_known || self.pairs.add_alone(channel, server));
        }
        if self.pairs.is_known(channel, server)
            && talks_to_another(server, client)
            && !(self.pairs.was_found(channel, server) && is_expected(client, server))
        {
            return self.pairs.add_alone(channel, client);
        }
        self.pairs.add(channel, Pair { a: client, b: server })
    }

    /// Reads requests of known testers that nobody has answered: they may ask a server that is not there.
    fn read_unanswered(&mut self, now_ns: i64, out: &mut impl FnMut(Transfer)) {
        let pairs = &self.pairs;
        let server = |channel, client| {
            let partner = pairs.sibling_partner(channel, client)?;
            Some(Some(partner).filter(|_| !makers::is_to_all(client)))
        };
        if let Some(found) = self.exchanges.unanswered(now_ns, server) {
            self.adopt(found, out);
        }
    }

    /// The trace has ended: passes on whatever was in progress.
    pub fn finish(&mut self, out: &mut impl FnMut(Transfer)) {
        for _ in 0..exchanges::MOST_SENDERS {
            self.read_unanswered(i64::MAX, out);
        }
        let mut open: Vec<_> = self.open.drain().map(|(_, open)| open).collect();
        open.sort_by_key(|open| open.transfer.start_ns);
        for open in open {
            end(open, Trouble::Unfinished, out);
        }
        self.tp20.finish(out);
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
        self.exchanges.interrupt(channel);
        self.tp20.interrupt(channel);
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
        let after_loss = std::mem::take(&mut self.after_loss);
        let fresh = Transfer {
            time_ns,
            start_ns: time_ns,
            channel,
            from,
            to,
            frames: 1,
            after_loss,
            ..Transfer::empty()
        };
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
    pub fn new(pairs: &[KnownPairs], finds: bool) -> Self {
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
            kind: if is_whole { EventKind::Transfer } else { EventKind::Broken },
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
