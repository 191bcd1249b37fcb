//! cannelloni: CAN frames in UDP datagrams, as its `doc/udp_format.md` and `udpthread.cpp` describe version 2; or over TCP, as its
//! `doc/tcp_protocol.md` and `decoder.cpp` describe version 1.
//!
//! Version, operation 0, a sequence number of eight bits, a count of frames; each frame an identifier as Linux has it, a length, the data unless it
//! is remote. There is no time in it, UDP may lose or reorder, and nothing says who sent it.
//!
//! Over TCP each side begins with the same greeting, and the same frames follow one after the other, with nothing between them: after one that cannot
//! be, nobody knows where the next begins.

use std::hash::{DefaultHasher, Hasher as _};
use std::io;
use std::net::{SocketAddr, UdpSocket};

use cantap_can::fd::{FLAG_BRS, FLAG_ESI};
use cantap_can::{FdFrame, Frame, Id};

/// cannelloni's usual port.
pub const PORT: u16 = 20_000;
/// The most bytes of a datagram that is sent: what Ethernet carries in one piece.
pub const MOST_BYTES: usize = 1472;

/// What both sides of a TCP connection send first.
pub const GREETING: &[u8; 12] = b"CANNELLONIv1";

const VERSION: u8 = 2;
const DATA: u8 = 0;
const HEADER: usize = 5;
/// Bytes of the longest frame that is written.
const FRAME_BYTES: usize = 4 + 1 + 1 + 64;

const EXTENDED: u32 = 1 << 31;
const REMOTE: u32 = 1 << 30;
const ERROR: u32 = 1 << 29;
/// In the length: a CAN FD frame, with a byte of flags after it.
const FD: u8 = 0x80;

/// What a datagram says first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// Its number, modulo 256.
    pub sequence: u8,
    /// Frames that are said to follow.
    pub count: u16,
}

/// Why a datagram is none of this protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NoDatagram {
    /// It has less than a header.
    TooShort,
    /// It is of another version, or no data.
    Other,
}

/// Waits for the next datagram of a peer to which the socket is connected, and returns its length; `None` if it was somebody else's, which arrived
/// before the socket was connected, and which the system then hands over as the peer's.
pub fn receive(socket: &UdpSocket, peer: SocketAddr, buffer: &mut [u8]) -> io::Result<Option<usize>> {
    let (len, from) = socket.recv_from(buffer)?;
    Ok((from == peer).then_some(len))
}

/// One of a datagram's frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Item {
    /// A frame.
    Frame(Frame),
    /// An error frame.
    Error,
    /// A CAN FD frame.
    Fd(FdFrame),
    /// A length or an identifier that no frame has.
    Impossible,
}

/// A datagram's header, and its frames for [`item`].
pub fn datagram(bytes: &[u8]) -> Result<(Header, &[u8]), NoDatagram> {
    let (&[version, operation, sequence, high, low], rest) =
        bytes.split_first_chunk::<HEADER>().ok_or(NoDatagram::TooShort)?;
    if (version, operation) != (VERSION, DATA) {
        return Err(NoDatagram::Other);
    }
    Ok((Header { sequence, count: u16::from_be_bytes([high, low]) }, rest))
}

/// The first frame, and what follows it; `None` if it is not whole.
pub fn item(bytes: &[u8]) -> Option<(Item, &[u8])> {
    let (raw, rest) = bytes.split_first_chunk()?;
    let raw = u32::from_be_bytes(*raw);
    let (&length, rest) = rest.split_first()?;
    let (is_fd, len) = (length & FD != 0, usize::from(length & !FD));
    let (flags, rest) =
        if is_fd { rest.split_first().map(|(flags, rest)| (*flags, rest))? } else { (0, rest) };
    if raw & REMOTE != 0 && !is_fd {
        let frame = id_of(raw).and_then(|id| Frame::remote_frame(id, len as u8));
        return Some((frame.map_or(Item::Impossible, Item::Frame), rest));
    }
    let (data, rest) = rest.split_at_checked(len)?;
    let item = match id_of(raw) {
        _ if raw & ERROR != 0 => Item::Error,
        // CAN FD has no remote frames.
        _ if raw & REMOTE != 0 => Item::Impossible,
        id if is_fd => id
            .and_then(|id| FdFrame::new(id, flags & FLAG_BRS != 0, flags & FLAG_ESI != 0, data))
            .map_or(Item::Impossible, Item::Fd),
        id => id.and_then(|id| Frame::data_frame(id, data)).map_or(Item::Impossible, Item::Frame),
    };
    Some((item, rest))
}

fn id_of(raw: u32) -> Option<Id> {
    let id = raw & !(EXTENDED | REMOTE | ERROR);
    if raw & EXTENDED != 0 { Id::extended(id) } else { Id::standard(id) }
}

/// Appends a frame as it is sent.
pub fn put(frame: &Frame, out: &mut Vec<u8>) {
    let remote = if frame.is_remote() { REMOTE } else { 0 };
    begin(raw_of(frame.id()) | remote, frame.dlc().min(8), out);
    out.extend_from_slice(frame.data());
}

/// Appends a CAN FD frame as it is sent.
pub fn put_fd(frame: &FdFrame, out: &mut Vec<u8>) {
    begin(raw_of(frame.id()), frame.data_len() as u8 | FD, out);
    out.push(frame.flags());
    out.extend_from_slice(frame.data());
}

/// Appends an error frame as it is sent: its classes as an identifier, and its data.
pub fn put_error(id: u32, data: [u8; 8], out: &mut Vec<u8>) {
    begin(id | ERROR, 8, out);
    out.extend_from_slice(&data);
}

fn raw_of(id: Id) -> u32 {
    id.raw() | if id.is_extended() { EXTENDED } else { 0 }
}

fn begin(raw: u32, len: u8, out: &mut Vec<u8>) {
    out.extend_from_slice(&raw.to_be_bytes());
    out.push(len);
}

/// What comes over a TCP connection.
#[derive(Clone, Debug, Default)]
pub struct Stream {
    bytes: Vec<u8>,
    is_greeted: bool,
}

/// The other side of a TCP connection does not speak the protocol, or nobody knows any more where its next frame begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BadStream {
    /// It began with something else than the [`GREETING`].
    NoGreeting,
    /// It sent a length or an identifier that no frame has.
    NoFrame,
}

impl Stream {
    /// Takes what has arrived.
    pub fn push(&mut self, bytes: &[u8]) {
        self.bytes.extend_from_slice(bytes);
    }

    /// Whether the whole greeting has come.
    pub fn is_greeted(&mut self) -> Result<bool, BadStream> {
        if !self.is_greeted {
            let len = self.bytes.len().min(GREETING.len());
            if self.bytes[..len] != GREETING[..len] {
                return Err(BadStream::NoGreeting);
            }
            if len == GREETING.len() {
                self.bytes.drain(..len);
                self.is_greeted = true;
            }
        }
        Ok(self.is_greeted)
    }

    /// The frames that are whole, error frames among them, as far as the first fault.
    pub fn frames(&mut self, mut take: impl FnMut(Item)) -> Result<(), BadStream> {
        if !self.is_greeted()? {
            return Ok(());
        }
        let mut rest = &self.bytes[..];
        let mut fault = Ok(());
        while let Some((item, after)) = item(rest) {
            if item == Item::Impossible {
                fault = Err(BadStream::NoFrame);
                break;
            }
            take(item);
            rest = after;
        }
        let used = self.bytes.len() - rest.len();
        self.bytes.drain(..used);
        fault
    }

    /// Whether a frame has begun that is not whole.
    pub const fn is_amid_frame(&self) -> bool {
        self.is_greeted && !self.bytes.is_empty()
    }
}

/// What a datagram's number says about those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Order {
    /// It is the next one, or the first.
    Next,
    /// So many before it are missing; each had at least a frame.
    Missing(u8),
    /// Ones with higher numbers came before, and this one did not.
    Late,
    /// The same datagram came before: the network has doubled it.
    Repeated,
    /// The sender has begun anew, or more are missing than numbers of eight bits can tell: nobody knows how many, perhaps none.
    Anew,
}

/// Datagrams that a network may overtake, or double, with others between. One with a number further back is of a sender that has begun anew.
const OVERTAKEN: u8 = 16;

/// Watches the numbers of one sender.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sequence {
    expected: Option<u8>,
    /// Of the last datagrams, by the remainder of their number: the number, and a hash of the bytes.
    last: [Option<(u8, u64)>; OVERTAKEN as usize],
}

impl Sequence {
    /// Takes the next datagram.
    pub fn take(&mut self, sequence: u8, datagram: &[u8]) -> Order {
        let mut hasher = DefaultHasher::new();
        hasher.write(datagram);
        let own = (sequence, hasher.finish());
        let before = self.last[usize::from(sequence % OVERTAKEN)].replace(own);
        let next = sequence.wrapping_add(1);
        let Some(expected) = self.expected.replace(next) else { return Order::Next };
        match (sequence.wrapping_sub(expected), expected.wrapping_sub(sequence)) {
            (0, _) => Order::Next,
            (1..0x80, _) if sequence == 0 => Order::Anew,
            (missing @ 1..0x80, _) => Order::Missing(missing),
            // Another one had this number.
            (_, 1..=OVERTAKEN)
                if before.is_some_and(|(number, hash)| number == sequence && hash != own.1) =>
            {
                Order::Anew
            }
            (_, 1..=OVERTAKEN) => {
                // It changes nothing about what is expected.
                self.expected = Some(expected);
                if before == Some(own) { Order::Repeated } else { Order::Late }
            }
            _ => Order::Anew,
        }
    }
}

/// Makes datagrams, numbered one after the other.
#[derive(Clone, Debug, Default)]
pub struct Writer {
    sequence: u8,
    count: u16,
    bytes: Vec<u8>,
}

impl Writer {
    /// Adds a frame, for which there must be [room](Self::has_room).
    pub fn push(&mut self, frame: &Frame) {
        put(frame, self.next());
    }

    /// Adds a CAN FD frame, for which there must be room.
    pub fn push_fd(&mut self, frame: &FdFrame) {
        put_fd(frame, self.next());
    }

    /// Adds an error frame: its classes as an identifier, the flag included, and its data.
    pub fn push_error(&mut self, id: u32, data: [u8; 8]) {
        put_error(id, data, self.next());
    }

    /// Where another frame goes.
    fn next(&mut self) -> &mut Vec<u8> {
        if self.bytes.is_empty() {
            self.bytes.resize(HEADER, 0);
        }
        self.count += 1;
        &mut self.bytes
    }

    /// Whether nothing was added since the last datagram.
    pub const fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    /// Frames that were added since the last datagram.
    pub const fn count(&self) -> u16 {
        self.count
    }

    /// Whether another frame fits.
    pub const fn has_room(&self) -> bool {
        self.bytes.len() + FRAME_BYTES + HEADER <= MOST_BYTES
    }

    /// The datagram with what was added, if there is anything.
    pub fn take(&mut self) -> Option<Vec<u8>> {
        let mut bytes = std::mem::take(&mut self.bytes);
        let [high, low] = std::mem::take(&mut self.count).to_be_bytes();
        bytes.get_mut(..HEADER)?.copy_from_slice(&[VERSION, DATA, self.sequence, high, low]);
        self.sequence = self.sequence.wrapping_add(1);
        Some(bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::Order::{Anew, Late, Missing, Next, Repeated};
    use super::*;

    proptest::proptest! {
        #[test]
        fn any_bytes_are_a_frame_or_not_whole(bytes: Vec<u8>) {
            if let Some((_, rest)) = item(&bytes) {
                proptest::prop_assert!(rest.len() < bytes.len());
            }
        }
    }

    /// Between binding and connecting, anybody can leave a datagram, which the system hands over afterwards.
    #[test]
    fn what_a_stranger_left_before_the_socket_was_connected_is_not_the_peer_s() {
        let [stranger, peer, socket] = [(); 3].map(|()| UdpSocket::bind("127.0.0.1:0").unwrap());
        let (own, from) = (socket.local_addr().unwrap(), peer.local_addr().unwrap());
        stranger.send_to(&[VERSION, DATA, 0, 0, 0], own).unwrap();
        socket.connect(from).unwrap();
        peer.send_to(&[VERSION, DATA, 1, 0, 0], own).unwrap();
        let mut buffer = [0; 16];
        let received: Vec<_> = (0..2).map(|_| receive(&socket, from, &mut buffer).unwrap()).collect();
        assert_eq!(received, [None, Some(HEADER)]);
    }

    #[test]
    fn what_is_written_is_read_and_datagrams_are_numbered() {
        let mut writer = Writer::default();
        assert_eq!(writer.take(), None);
        let frames: Vec<Frame> = ["123#AA", "1ABCDEF0#0102030405060708", "7FF#R4", "00000001#"]
            .map(|text| text.parse().unwrap())
            .into();
        for frame in &frames {
            writer.push(frame);
        }
        writer.push_error(0x0000_0004, [1; 8]);
        let id = Id::extended(0x18DA_F110).unwrap();
        let fd = [(0, true), (12, false), (64, true)]
            .map(|(len, brs)| FdFrame::new(id, brs, !brs, &[0xA5; 64][..len]).unwrap());
        for frame in &fd {
            writer.push_fd(frame);
        }
        let bytes = writer.take().unwrap();
        assert_eq!(bytes[..11], [2, 0, 0, 0, 8, 0, 0, 1, 0x23, 1, 0xAA]);
        let (header, mut rest) = datagram(&bytes).unwrap();
        assert_eq!(header, Header { sequence: 0, count: 8 });
        let mut read = Vec::new();
        while let Some((item, after)) = item(rest) {
            read.push(item);
            rest = after;
        }
        let mut expected: Vec<Item> = frames.into_iter().map(Item::Frame).collect();
        expected.push(Item::Error);
        expected.extend(fd.map(Item::Fd));
        assert_eq!(read, expected);
        // The longest is no longer than Ethernet carries in one piece.
        while writer.has_room() {
            writer.push(&"1ABCDEF0#0102030405060708".parse().unwrap());
        }
        let bytes = writer.take().unwrap();
        assert!((MOST_BYTES - 2 * FRAME_BYTES..=MOST_BYTES).contains(&bytes.len()), "{}", bytes.len());
        assert_eq!(datagram(&bytes).unwrap().0.sequence, 1);
    }

    #[test]
    fn numbers_say_what_is_missing_and_what_came_late_or_twice() {
        let mut sequence = Sequence::default();
        let mut take = |number: u8, content: u8| sequence.take(number, &[number, content]);
        let orders = [250, 251, 254, 255, 0, 3, 2, 4].map(|number| take(number, 0));
        assert_eq!(orders, [Next, Next, Missing(2), Next, Next, Missing(2), Late, Next]);
        // The same once more, next to each other and with others between.
        assert_eq!([4, 2, 5].map(|number| take(number, 0)), [Repeated, Repeated, Next]);
        // Another one with a number that was there is none of these: its sender has begun anew.
        assert_eq!([take(0, 1), take(1, 1), take(2, 1), take(2, 1)], [Anew, Next, Next, Repeated]);
        // So has one that is far back, or more are missing than the numbers show: 200 in a row, and 250.
        for number in 3..100 {
            assert_eq!(take(number, 0), Next);
        }
        assert_eq!([0, 1, 2].map(|number| take(number, 0)), [Anew, Next, Next]);
        assert_eq!([203, 204].map(|number| take(number, 0)), [Anew, Next]);
        assert_eq!((205..=220).map(|number| take(number, 0)).filter(|order| *order != Next).count(), 0);
        assert_eq!([215, 216].map(|number| take(number, 1)), [Anew, Next]);
        // Number 0 behind a gap is how a sender begins.
        assert_eq!([0, 1, 2].map(|number| take(number, 2)), [Anew, Next, Next]);
        // A number is used again every 256 datagrams, with the same content if a sender repeats itself.
        for number in (3..=255).chain(0..=255) {
            assert_eq!(take(number, 0), Next);
        }
    }

    /// However the bytes are cut: the greeting, then each frame once it is whole, up to one that cannot be.
    #[test]
    fn a_stream_is_read_however_it_is_cut() {
        let frames = ["123#AA", "1ABCDEF0#0102030405060708", "7FF#R4", "00000001#"];
        let fd = FdFrame::new(Id::extended(0x18DA_F110).unwrap(), true, false, &[0xA5; 64]).unwrap();
        let mut bytes = GREETING.to_vec();
        for frame in frames {
            put(&frame.parse().unwrap(), &mut bytes);
        }
        put_fd(&fd, &mut bytes);
        put_error(4, [1; 8], &mut bytes);
        let mut wanted: Vec<_> = frames.map(|frame| Item::Frame(frame.parse().unwrap())).into();
        wanted.extend([Item::Fd(fd), Item::Error]);
        for piece in [1, 2, 5, 13, 1000] {
            let (mut stream, mut read) = (Stream::default(), Vec::new());
            for part in bytes.chunks(piece) {
                stream.push(part);
                stream.frames(|item| read.push(item)).unwrap();
            }
            assert_eq!(read, wanted, "{piece}");
            assert!(!stream.is_amid_frame());
            // Half a frame is waited for; nine bytes of data are no frame, and nothing is read behind them.
            stream.push(&[0, 0, 1, 0x23, 9, 1]);
            stream.frames(|item| panic!("{item:?}")).unwrap();
            assert!(stream.is_amid_frame());
            stream.push(&[0; 8]);
            stream.push(&bytes[GREETING.len()..]);
            assert_eq!(stream.frames(|item| panic!("{item:?}")), Err(BadStream::NoFrame));
            assert_eq!(stream.frames(|item| panic!("{item:?}")), Err(BadStream::NoFrame));
        }
        for other in [&b"SSH-2.0"[..], b"CANNELLONIv2", b"\0"] {
            let mut stream = Stream::default();
            stream.push(other);
            assert_eq!(stream.frames(|item| panic!("{item:?}")), Err(BadStream::NoGreeting));
        }
        let mut stream = Stream::default();
        stream.push(&GREETING[..11]);
        assert_eq!(stream.is_greeted(), Ok(false));
    }

    proptest::proptest! {
        /// Whatever comes, a stream keeps no more than a frame that is not whole.
        #[test]
        fn a_stream_keeps_little_of_any_bytes(pieces: Vec<Vec<u8>>) {
            let mut stream = Stream::default();
            stream.push(GREETING);
            for piece in pieces {
                stream.push(&piece);
                if stream.frames(|_| {}).is_err() {
                    break;
                }
                proptest::prop_assert!(stream.bytes.len() < 4 + 1 + 1 + 127);
            }
        }
    }

    #[test]
    fn what_is_no_datagram_says_why() {
        assert_eq!(datagram(&[2, 0, 1, 0]), Err(NoDatagram::TooShort));
        assert_eq!(datagram(&[1, 0, 1, 0, 0]), Err(NoDatagram::Other));
        assert_eq!(datagram(&[2, 1, 1, 0, 0]), Err(NoDatagram::Other));
    }
}
