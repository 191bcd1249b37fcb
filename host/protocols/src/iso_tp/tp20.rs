//! Volkswagen's transport protocol 2.0 (SAE J2819), below KWP2000 and UDS in cars of its makes until about 2010.
//!
//! A tester asks for a channel on 200 to 2EF with the address of an ECU, which answers on 200 plus that address and gives the identifiers
//! of both sides. Only after such an agreement are frames read by this protocol, and until either side ends it: other traffic does not look
//! like that. Of a channel whose beginning was not heard, nothing is read.
//!
//! Memory: 64 channels with a message of at most 64 KiB for each side, and 16 requests for one.

use cantap_trace::{Id, TraceRecord};

use super::pairs::Endpoint;
use super::transfer::Transfer;
use crate::{Bytes, Trouble};

/// The first identifier of requests for a channel; addresses are added to it.
const BASE: u32 = 0x200;
/// Addresses end before this one.
const ADDRESSES: u32 = 0xF0;
/// Request and answer of a channel have this many bytes.
const SETUP_BYTES: usize = 7;
const SETUP: u8 = 0xC0;
const ACCEPTED: u8 = 0xD0;
/// How long the answer to a request for a channel may take: more than the 50 ms after which testers repeat it.
const SETUP_NS: i64 = 500_000_000;
/// How long the next frame of a message may take.
const NEXT_NS: i64 = 1_000_000_000;
/// Testers test an idle channel several times a second. One that is silent for this long has ended, and others may use its identifiers.
const IDLE_NS: i64 = 10_000_000_000;
const MOST_CHANNELS: usize = 64;
const MOST_REQUESTS: usize = 16;
const MOST_BYTES: usize = 1 << 16;
/// A message's length comes before its bytes.
const LENGTH_BYTES: usize = 2;

/// One side of a channel as a sender.
#[derive(Clone, Debug)]
struct Side {
    id: Id,
    /// The number of its next data frame; unknown after a loss, until a message has ended.
    next: Option<u8>,
    /// That frames are the rest of a message has been reported.
    is_reported: bool,
    open: Option<Open>,
}

/// A message under way.
#[derive(Clone, Debug)]
struct Open {
    start_ns: i64,
    last_ns: i64,
    /// With the length in front.
    bytes: Bytes,
    frames: u32,
    frames_lost: bool,
}

/// An agreed channel; the tester is the first side.
#[derive(Clone, Debug)]
struct Channel {
    /// The bus's channel, from 1.
    bus: u8,
    last_ns: i64,
    sides: [Side; 2],
}

/// A request for a channel.
#[derive(Clone, Copy, Debug)]
struct Request {
    channel: u8,
    time_ns: i64,
    from: u32,
    address: u8,
    application: u8,
    /// The identifier that the tester wants to receive, if it says one.
    receives: Option<u32>,
}

/// The channels that were agreed on.
#[derive(Clone, Debug, Default)]
pub(super) struct Channels {
    requests: Vec<Request>,
    channels: Vec<Channel>,
}

impl Channels {
    /// Takes a data frame, and passes on the message that ends with it. Returns whether the frame is one of this protocol's.
    pub fn take(
        &mut self,
        record: &TraceRecord,
        id: Id,
        bytes: &[u8],
        out: &mut impl FnMut(Transfer),
    ) -> bool {
        if id.is_extended() {
            return false;
        }
        if !self.channels.is_empty()
            && let Some(place) = self.of(record.channel, id)
        {
            return self.frame(place, record, id, bytes, out);
        }
        let is_setup = (BASE..BASE + ADDRESSES).contains(&id.raw()) && bytes.len() == SETUP_BYTES;
        is_setup && self.setup(record, id.raw(), bytes, out)
    }

    fn of(&self, channel: u8, id: Id) -> Option<usize> {
        let has = |of: &Channel| of.bus == channel && of.sides.iter().any(|side| side.id == id);
        self.channels.iter().position(has)
    }

    /// A request for a channel, or the answer to one.
    fn setup(
        &mut self,
        record: &TraceRecord,
        raw: u32,
        bytes: &[u8],
        out: &mut impl FnMut(Transfer),
    ) -> bool {
        let &[address, operation, a, b, c, d, application] = bytes else { return false };
        let (channel, time_ns) = (record.channel, record.time_ns);
        self.requests.retain(|request| time_ns.saturating_sub(request.time_ns) <= SETUP_NS);
        match operation {
            SETUP if u32::from(address) < ADDRESSES && raw != BASE + u32::from(address) => {
                if self.requests.len() == MOST_REQUESTS {
                    self.requests.remove(0);
                }
                let receives = identifier(c, d);
                let request = Request { channel, time_ns, from: raw, address, application, receives };
                self.requests.push(request);
                true
            }
            ACCEPTED => {
                let place = self.requests.iter().position(|request| {
                    request.channel == channel
                        && raw == BASE + u32::from(request.address)
                        && u32::from(address) == request.from - BASE
                        && application == request.application
                });
                let (Some(place), Some(server), Some(client)) = (place, identifier(a, b), identifier(c, d))
                else {
                    return false;
                };
                if server == client || self.requests[place].receives.is_some_and(|wanted| wanted != server) {
                    return false;
                }
                self.requests.remove(place);
                self.open(channel, time_ns, [client, server].map(Id::standard_truncated), out);
                true
            }
            _ => false,
        }
    }

    fn open(&mut self, channel: u8, time_ns: i64, ids: [Id; 2], out: &mut impl FnMut(Transfer)) {
        for id in ids {
            if let Some(place) = self.of(channel, id) {
                self.close(place, Trouble::Overlapped, out);
            }
        }
        if self.channels.len() == MOST_CHANNELS
            && let Some(oldest) = (0..MOST_CHANNELS).min_by_key(|place| self.channels[*place].last_ns)
        {
            self.close(oldest, Trouble::GivenUp, out);
        }
        let sides = ids.map(|id| Side { id, next: Some(0), is_reported: false, open: None });
        self.channels.push(Channel { bus: channel, last_ns: time_ns, sides });
    }

    /// A frame with an identifier of a channel; false if it cannot be one of this protocol, which ends the channel.
    fn frame(
        &mut self,
        place: usize,
        record: &TraceRecord,
        id: Id,
        bytes: &[u8],
        out: &mut impl FnMut(Transfer),
    ) -> bool {
        if record.time_ns.saturating_sub(self.channels[place].last_ns) > IDLE_NS {
            let after_ms = (IDLE_NS / 1_000_000) as u32;
            self.close(place, Trouble::Timeout { after_ms }, out);
            return false;
        }
        let channel = &mut self.channels[place];
        channel.last_ns = record.time_ns;
        let [sender, receiver] = if channel.sides[0].id == id { [0, 1] } else { [1, 0] };
        let to = channel.sides[receiver].id;
        let side = &mut channel.sides[sender];
        match bytes {
            // Parameters of the connection, their answer (which also answers a test), and a test.
            [0xA0 | 0xA1, _, _, _, _, _] | [0xA3] => {
                if bytes[0] == 0xA0 {
                    for side in &mut channel.sides {
                        side.next = Some(0);
                    }
                }
            }
            // The receiver has had enough: the sender repeats from the last one that was acknowledged.
            [0xA4] => {
                let (bus, from) = (channel.bus, id);
                let other = &mut channel.sides[receiver];
                if let Some(open) = other.open.take() {
                    let trouble = Trouble::Aborted("the receiver asked for a break");
                    out(open.transfer(bus, other.id, from, Some(trouble)));
                    (other.next, other.is_reported) = (None, true);
                }
            }
            [0xA8] => {
                self.close(place, Trouble::Aborted("the channel was closed"), out);
            }
            // Acknowledgements: not yet, and go on.
            [operation] if matches!(operation >> 4, 0x9 | 0xB) => {}
            [operation, data @ ..] if *operation < 0x40 && !data.is_empty() => {
                side.data(record, *operation, data, to, out);
            }
            _ => {
                self.close(place, Trouble::Malformed("a frame that the protocol does not have"), out);
                return false;
            }
        }
        true
    }

    fn close(&mut self, place: usize, trouble: Trouble, out: &mut impl FnMut(Transfer)) {
        let Channel { bus, sides, .. } = self.channels.swap_remove(place);
        let [a, b] = sides;
        let (a_id, b_id) = (a.id, b.id);
        for (side, to) in [(a, b_id), (b, a_id)] {
            if let Some(open) = side.open {
                out(open.transfer(bus, side.id, to, Some(trouble)));
            }
        }
    }

    /// Ends messages whose next frame does not come.
    pub fn advance(&mut self, now_ns: i64, out: &mut impl FnMut(Transfer)) {
        for Channel { bus, sides, .. } in &mut self.channels {
            let ids = [sides[1].id, sides[0].id];
            for (side, to) in sides.iter_mut().zip(ids) {
                let is_late = |open: &mut Open| now_ns.saturating_sub(open.last_ns) > NEXT_NS;
                if let Some(mut open) = side.open.take_if(is_late) {
                    open.last_ns = open.last_ns.saturating_add(NEXT_NS);
                    (side.next, side.is_reported) = (None, true);
                    let after_ms = (NEXT_NS / 1_000_000) as u32;
                    out(open.transfer(*bus, side.id, to, Some(Trouble::Timeout { after_ms })));
                }
            }
        }
    }

    /// The ECU of the channel to which a sender belongs.
    pub fn server(&self, channel: u8, from: Endpoint) -> Option<Endpoint> {
        let place = self.of(channel, from.id)?;
        Some(Endpoint { id: self.channels[place].sides[1].id, address: None })
    }

    /// Whether any channel is agreed on.
    pub const fn is_empty(&self) -> bool {
        self.channels.is_empty()
    }

    /// Frames of the channel are missing.
    pub fn interrupt(&mut self, channel: u8) {
        for side in self.channels.iter_mut().filter(|of| of.bus == channel).flat_map(|of| &mut of.sides) {
            if let Some(open) = &mut side.open {
                open.frames_lost = true;
            } else {
                (side.next, side.is_reported) = (None, false);
            }
        }
    }

    /// The trace has ended.
    pub fn finish(&mut self, out: &mut impl FnMut(Transfer)) {
        while !self.channels.is_empty() {
            self.close(0, Trouble::Unfinished, out);
        }
    }
}

/// The identifier in two bytes, if they say that there is one.
const fn identifier(low: u8, high: u8) -> Option<u32> {
    if high > 7 { None } else { Some((high as u32) << 8 | low as u32) }
}

impl Side {
    fn data(
        &mut self,
        record: &TraceRecord,
        operation: u8,
        data: &[u8],
        to: Id,
        out: &mut impl FnMut(Transfer),
    ) {
        let number = operation & 15;
        // Without an acknowledgement, a sender repeats its last frame.
        if self.next.is_some_and(|next| number == (next + 15) & 15) {
            return;
        }
        let time_ns = record.time_ns;
        if let Some(expected) = self.next.filter(|next| *next != number)
            && let Some(open) = self.open.take()
        {
            let trouble = Trouble::Sequence { expected: expected.into(), got: number.into() };
            out(Open { last_ns: time_ns, ..open }.transfer(record.channel, self.id, to, Some(trouble)));
            // What follows is the rest of it, up to its last frame.
            (self.next, self.is_reported) = (None, true);
        }
        let is_last = operation & 0x10 != 0;
        let new = || Open {
            start_ns: time_ns,
            last_ns: time_ns,
            bytes: Bytes::new(),
            frames: 0,
            frames_lost: false,
        };
        // A message of one frame says its length.
        let is_whole = || {
            let length = data.first_chunk::<LENGTH_BYTES>().map(|length| u16::from_be_bytes(*length));
            is_last && length.is_some_and(|length| usize::from(length) + LENGTH_BYTES == data.len())
        };
        if self.open.is_none() && self.next != Some(number) && !is_whole() {
            // The next message begins after the last frame of this one.
            self.next = is_last.then_some((number + 1) & 15);
            if !std::mem::replace(&mut self.is_reported, !is_last) {
                let rest = Open { bytes: Bytes::from_slice(&[&[0, 0], data].concat()), frames: 1, ..new() };
                out(rest.transfer(record.channel, self.id, to, Some(Trouble::Headless)));
            }
            return;
        }
        let mut open = self.open.take().unwrap_or_else(new);
        let room = MOST_BYTES.saturating_sub(open.bytes.len());
        open.bytes.extend_from_slice(&data[..data.len().min(room)]);
        (open.last_ns, open.frames) = (time_ns, open.frames + 1);
        self.next = Some((number + 1) & 15);
        if is_last {
            out(open.transfer(record.channel, self.id, to, None));
        } else {
            self.open = Some(open);
        }
    }
}

impl Open {
    fn transfer(self, channel: u8, from: Id, to: Id, trouble: Option<Trouble>) -> Transfer {
        let endpoint = |id| Endpoint { id, address: None };
        let (length, data) = match self.bytes.split_first_chunk::<LENGTH_BYTES>() {
            Some((length, data)) => (usize::from(u16::from_be_bytes(*length)), data),
            None => (0, &[][..]),
        };
        let ends = match data.len() {
            got if trouble.is_some() || got == length && length > 0 => None,
            got if got > length => Some(Trouble::Malformed("it is longer than it says")),
            _ => Some(Trouble::Malformed("it is shorter than it says")),
        };
        Transfer {
            time_ns: self.last_ns,
            start_ns: self.start_ns,
            channel,
            from: endpoint(from),
            to: Some(endpoint(to)),
            data: Bytes::from_slice(data),
            length: length as u32,
            frames: self.frames,
            trouble: trouble.or(ends),
            frames_lost: self.frames_lost,
            ..Transfer::empty()
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::diagnostics::Diagnostics;
    use crate::testing::{self, at};

    fn lines(frames: &[&str]) -> Vec<String> {
        let records: Vec<_> = frames.iter().enumerate().map(|(ms, frame)| at(ms as f64, frame)).collect();
        let events = testing::events(Diagnostics::new(&[], true), &records);
        events.iter().map(ToString::to_string).collect()
    }

    const SETUP: [&str; 4] =
        ["200#01C00010000301", "201#00D00003400701", "740#A00F8AFF32FF", "300#A10F8AFF4AFF"];

    fn after_setup(frames: &[&str]) -> Vec<String> {
        lines(&[&SETUP[..], frames].concat())
    }

    /// The exchange that public descriptions of the protocol have: a session, then an identification in several frames.
    #[test]
    fn kwp2000_is_read_in_an_agreed_channel() {
        let said = after_setup(&[
            "740#1000021089",
            "300#B1",
            "300#1000025089",
            "740#B1",
            "740#1100021A9B",
            "300#B2",
            "300#21000B5A9B3148",
            "300#2230393037",
            "300#13313135",
            "740#B4",
            "740#A8",
            "300#A8",
        ]);
        assert_eq!(said.len(), 2, "{said:?}");
        assert!(said[0].starts_with("kwp2000 740 > 300 startDiagnosticSession: sid 0x10"), "{said:?}");
        assert!(said[1].contains("sid 0x1A") && said[1].contains("1H0907115"), "{said:?}");
    }

    #[test]
    fn a_repeated_frame_counts_once_and_a_missing_one_is_reported_once() {
        let said = after_setup(&["740#1000023E01", "740#1000023E01", "300#B1", "300#1000017E", "740#B1"]);
        assert_eq!(said.len(), 1, "{said:?}");
        let said = after_setup(&[
            "740#1000021A9B",
            "300#B1",
            "300#20000B5A9B3148",
            "300#2230393037",
            "300#13313135",
            "740#1100013E",
            "300#B2",
            "300#1400017E",
        ]);
        let broken: Vec<_> = said.iter().filter(|line| line.contains("frame 2 came instead of 1")).collect();
        assert_eq!(broken.len(), 1, "{said:?}");
        assert!(
            said.iter().any(|line| line.contains("testerPresent") && line.contains("after 2 ms")),
            "{said:?}"
        );
    }

    #[test]
    fn a_message_that_does_not_end_is_reported() {
        let said = after_setup(&["740#2000101A9B3148", "740#A8"]);
        assert_eq!(said.len(), 1, "{said:?}");
        assert!(said[0].contains("the channel was closed"), "{said:?}");
        let said = after_setup(&["740#1000091A9B3148"]);
        assert!(said.len() == 1 && said[0].contains("it is shorter than it says"), "{said:?}");
    }

    /// The same frames say nothing without the agreement, or after its end.
    #[test]
    fn nothing_is_claimed_without_an_agreed_channel() {
        let talk = ["740#1000021089", "300#B1", "300#1000025089", "740#B1"];
        for setup in [
            &[][..],
            &SETUP[..1],
            &SETUP[1..],
            // Not the ECU that was asked, not this tester, not this application, an identifier that is none, the same for both.
            &["200#01C00010000301", "202#00D00003400701"],
            &["200#01C00010000301", "201#02D00003400701"],
            &["200#01C00010000301", "201#00D00003400720"],
            &["200#01C00010000301", "201#00D00010400701"],
            &["200#01C00010000301", "201#00D00003000301"],
            &["200#01C00010000301", "201#00D60010001001"],
        ] {
            let said = lines(&[setup, &talk].concat());
            assert!(!said.iter().any(|line| line.starts_with("kwp2000")), "{setup:?}: {said:?}");
        }
        let said = after_setup(&[&["740#A8"][..], &talk].concat());
        assert!(said.is_empty(), "{said:?}");
    }
}
