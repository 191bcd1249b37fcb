//! A USB/IP client in place of a kernel: it imports a device and submits transfers (Linux's `Documentation/usb/usbip_protocol.rst`).

use std::collections::{BTreeMap, VecDeque};
use std::io::{self, ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

/// Far longer than anything takes, even on a busy machine.
const PATIENCE: Duration = Duration::from_mins(1);
/// Bytes of a message's head.
const HEAD: usize = 48;
const SUBMIT: u32 = 1;
const UNLINK: u32 = 2;
const SUBMITTED: u32 = 3;

/// A transfer that has ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Ended {
    /// Its number.
    pub seq: u32,
    /// 0, or one of Linux's error numbers, negative.
    pub status: i32,
    /// What came, if it was to come in.
    pub data: Vec<u8>,
}

/// A connection that has asked for a device.
pub struct Kernel {
    stream: TcpStream,
    /// The number of the last message.
    seq: u32,
    /// Each transfer under way, and whether data comes in.
    under_way: BTreeMap<u32, bool>,
    unread: Vec<u8>,
    /// What ended while something else was waited for.
    ended: VecDeque<Ended>,
}

impl Kernel {
    /// Asks a server on this computer for a device by its bus ID, as `usbip attach` does. The answer is read with [`Self::bytes`].
    ///
    /// # Errors
    /// If nobody listens.
    pub fn import(port: u16, bus_id: &str) -> io::Result<Self> {
        let mut stream = TcpStream::connect(("127.0.0.1", port))?;
        stream.set_nodelay(true)?;
        let mut opening = vec![1, 0x11, 0x80, 3, 0, 0, 0, 0];
        opening.extend(bus_id.as_bytes());
        opening.resize(40, 0);
        stream.write_all(&opening)?;
        Ok(Self { stream, seq: 0, under_way: BTreeMap::new(), unread: Vec::new(), ended: VecDeque::new() })
    }

    /// The next so many bytes.
    ///
    /// # Panics
    /// If the connection ends, or they do not come.
    pub fn bytes(&mut self, count: usize) -> Vec<u8> {
        let deadline = Instant::now() + PATIENCE;
        while self.unread.len() < count {
            self.read(deadline).expect("the connection goes on");
            assert!(Instant::now() < deadline, "nothing comes");
        }
        self.unread.drain(..count).collect()
    }

    /// What comes until the connection ends.
    pub fn rest(&mut self) -> Vec<u8> {
        let deadline = Instant::now() + PATIENCE;
        while self.read(deadline).is_ok() && Instant::now() < deadline {}
        std::mem::take(&mut self.unread)
    }

    /// Reads what is there, or comes until `deadline`.
    fn read(&mut self, deadline: Instant) -> io::Result<()> {
        let left = deadline.saturating_duration_since(Instant::now()).max(Duration::from_micros(1));
        self.stream.set_read_timeout(Some(left))?;
        let mut bytes = [0; 4096];
        match self.stream.read(&mut bytes) {
            Ok(0) => Err(ErrorKind::UnexpectedEof.into()),
            Ok(len) => {
                self.unread.extend(&bytes[..len]);
                Ok(())
            }
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => Ok(()),
            Err(error) => Err(error),
        }
    }

    /// The number that the next message has.
    pub const fn next_seq(&self) -> u32 {
        self.seq + 1
    }

    fn send(&mut self, head: [u32; 10], tail: &[u8]) -> io::Result<()> {
        let mut bytes: Vec<u8> = head.iter().flat_map(|word| word.to_be_bytes()).collect();
        bytes.extend(tail);
        bytes.resize(bytes.len().max(HEAD), 0);
        self.stream.write_all(&bytes)
    }

    /// Submits a transfer, which takes up to `length` bytes if `is_in`, and returns its number.
    ///
    /// # Errors
    /// If the connection has ended.
    pub fn submit(
        &mut self,
        endpoint: u32,
        is_in: bool,
        length: u32,
        setup: [u8; 8],
        data: &[u8],
    ) -> io::Result<u32> {
        self.seq += 1;
        let seq = self.seq;
        self.under_way.insert(seq, is_in);
        let head = [SUBMIT, seq, 0x1_0002, is_in.into(), endpoint, 0, length, 0, 0, 0];
        self.send(head, &[&setup, data].concat())?;
        Ok(seq)
    }

    /// Withdraws the transfer `victim`, and returns the number of that message.
    ///
    /// # Errors
    /// If the connection has ended.
    pub fn take_back(&mut self, victim: u32) -> io::Result<u32> {
        self.seq += 1;
        self.send([UNLINK, self.seq, 0x1_0002, 0, 0, victim, 0, 0, 0, 0], &[])?;
        Ok(self.seq)
    }

    /// The next transfer that has ended, or message that was answered, if one does within `wait`.
    ///
    /// # Errors
    /// If the connection has ended.
    pub fn next(&mut self, wait: Duration) -> io::Result<Option<Ended>> {
        if let Some(ended) = self.ended.pop_front() {
            return Ok(Some(ended));
        }
        let deadline = Instant::now() + wait;
        loop {
            if let Some(ended) = self.parse() {
                return Ok(Some(ended));
            }
            self.read(deadline)?;
            if Instant::now() >= deadline {
                return Ok(self.parse());
            }
        }
    }

    fn parse(&mut self) -> Option<Ended> {
        let head = self.unread.get(..HEAD)?;
        let word = |n: usize| {
            let bytes = head[4 * n..4 * n + 4].try_into();
            u32::from_be_bytes(bytes.expect("there are four"))
        };
        let (seq, status) = (word(1), word(5).cast_signed());
        let is_in = word(0) == SUBMITTED && self.under_way.get(&seq).is_some_and(|is_in| *is_in);
        let len = if is_in { word(6) as usize } else { 0 };
        if self.unread.len() < HEAD + len {
            return None;
        }
        self.under_way.remove(&seq);
        let data = self.unread.drain(..HEAD + len).skip(HEAD).collect();
        Some(Ended { seq, status, data })
    }

    /// Submits a control transfer and waits for its end: its status and what came. What ends meanwhile is kept for [`Self::next`].
    ///
    /// # Errors
    /// If the connection has ended, or it does not end within `wait`.
    pub fn control(&mut self, setup: [u8; 8], data: &[u8], wait: Duration) -> io::Result<(i32, Vec<u8>)> {
        let length = u16::from_le_bytes([setup[6], setup[7]]).into();
        let seq = self.submit(0, setup[0] & 0x80 != 0, length, setup, data)?;
        let deadline = Instant::now() + wait;
        let mut others = VecDeque::new();
        let ended = loop {
            match self.next(deadline.saturating_duration_since(Instant::now()))? {
                Some(ended) if ended.seq == seq => break Ok((ended.status, ended.data)),
                Some(other) => others.push_back(other),
                None => break Err(ErrorKind::TimedOut.into()),
            }
        };
        self.ended.append(&mut others);
        ended
    }

    /// Enumerates the device as Linux does and sets its configuration. Returns the whole configuration.
    ///
    /// # Panics
    /// If it is not there, or does not enumerate.
    pub fn enumerate(&mut self) -> Vec<u8> {
        let mut control = |setup: [u8; 8]| {
            let (status, data) = self.control(setup, &[], PATIENCE).expect("the connection goes on");
            assert_eq!(status, 0, "{setup:02x?}");
            data
        };
        let device = control([0x80, 6, 0, 1, 0, 0, 64, 0]);
        // One packet: Linux wants to know its size.
        assert!(device.len() >= 8, "{device:02x?}");
        let whole = control([0x80, 6, 0, 1, 0, 0, 18, 0]);
        assert!(whole.len() == 18 && whole.starts_with(&device), "{whole:02x?}");
        let configuration = control([0x80, 6, 0, 2, 0, 0, 255, 0]);
        assert_eq!(control([0, 9, 1, 0, 0, 0, 0, 0]), []);
        configuration
    }
}

/// The number of the bulk endpoint of a direction, 0x80 for in, in a configuration.
///
/// # Panics
/// If there is none.
pub fn bulk(configuration: &[u8], direction: u8) -> u32 {
    let mut rest = configuration;
    while let [length, kind, ..] = *rest {
        if kind == 5 && rest[3] == 2 && rest[2] & 0x80 == direction {
            return (rest[2] & 15).into();
        }
        rest = &rest[usize::from(length)..];
    }
    panic!("no bulk endpoint");
}
