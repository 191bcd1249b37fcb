//! SDO transfers: expedited, in segments, or in blocks (CiA 301, 7.2.4.3).
//!
//! Memory: one transfer for each of 127 nodes on each channel, of at most 64 KiB.

use crate::{Bytes, Trouble};

/// How long either side may take. CiA 301 gives no time; masters use 0.3 to 2 s.
pub const TIMEOUT_NS: i64 = 2_000_000_000;
const MOST_BYTES: usize = 1 << 16;

/// How the bytes were sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// In the first frame.
    Expedited,
    /// Frame by frame, each confirmed.
    Segmented,
    /// Up to 127 frames per confirmation.
    Block,
}

impl Mode {
    /// The name for display.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Expedited => "expedited",
            Self::Segmented => "segmented",
            Self::Block => "block",
        }
    }
}

/// A transfer, complete or as far as it got.
#[derive(Clone, Debug)]
pub struct SdoTransfer {
    pub start_ns: i64,
    pub time_ns: i64,
    pub index: u16,
    pub sub: u8,
    pub is_write: bool,
    pub mode: Mode,
    pub data: Bytes,
    /// The expected number of bytes, if known.
    pub size: Option<u32>,
    pub frames: u32,
    /// From the request to the first answer, in nanoseconds.
    pub response_ns: Option<i64>,
    pub abort: Option<u32>,
    pub trouble: Option<Trouble>,
    pub frames_lost: bool,
}

/// The meaning of the bytes in the current frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// Commands.
    Command,
    /// Segments of a block from the client.
    FromClient,
    /// Segments of a block from the server.
    FromServer,
}

/// One node's server.
#[derive(Clone, Debug)]
pub struct Sdo {
    pub open: Option<SdoTransfer>,
    phase: Phase,
    toggle: bool,
    /// Number of bytes before the current block, number of its frames received in order, and whether one was
    /// out of order.
    block_start: usize,
    block_next: u8,
    last_segment: bool,
    /// What follows belongs to a transfer that has ended or was not observed, which was reported.
    is_orphan: bool,
    /// Whether each side supports a CRC.
    crc: [bool; 2],
}

impl Default for Sdo {
    fn default() -> Self {
        Self {
            open: None,
            phase: Phase::Command,
            toggle: false,
            block_start: 0,
            block_next: 1,
            last_segment: false,
            is_orphan: false,
            crc: [false; 2],
        }
    }
}

impl Sdo {
    /// Takes a frame from the client or the server; returns what it ends: an abandoned transfer, and a completed one.
    pub fn take(&mut self, time_ns: i64, from_client: bool, data: &[u8]) -> [Option<SdoTransfer>; 2] {
        let short = Trouble::Malformed("an SDO frame has 8 bytes");
        let Some(bytes) = self.padded(from_client, data) else {
            return [None, Some(headless(time_ns, data, short))];
        };
        let mut ended = self.take_whole(time_ns, from_client, bytes);
        if data.len() < bytes.len()
            && let Some(transfer) = ended[1].as_mut().or(self.open.as_mut())
        {
            transfer.trouble.get_or_insert(short);
        }
        ended
    }

    /// With the unused bytes, which some devices leave out. `None` if others are missing, or there are too many.
    fn padded(&self, from_client: bool, data: &[u8]) -> Option<[u8; 8]> {
        let mut bytes = [0; 8];
        bytes.get_mut(..data.len())?.copy_from_slice(data);
        let used = match (self.phase, from_client) {
            (Phase::FromClient, true) | (Phase::FromServer, false) => 8,
            _ => used(bytes[0], from_client),
        };
        (!data.is_empty() && data.len() >= used).then_some(bytes)
    }

    fn take_whole(&mut self, time_ns: i64, from_client: bool, bytes: [u8; 8]) -> [Option<SdoTransfer>; 2] {
        let [b0, low, high, sub, ..] = bytes;
        let mut behind = None;
        let initiates = match b0 >> 5 {
            1 | 2 => true,
            5 => matches!(b0 & 3, 0),
            6 => matches!(b0 & 1, 0),
            _ => false,
        };
        // If the client starts a new transfer while a block comes from the server, it has abandoned the
        // block.
        let begins = from_client && self.phase != Phase::FromClient && initiates;
        if begins {
            behind = self.end(Trouble::Overlapped);
            self.phase = Phase::Command;
            self.is_orphan = false;
        }
        // The first answer names the object. One that names another is not to this request.
        let answers_by_name = match b0 >> 5 {
            2 | 3 => true,
            5 => matches!(b0 & 3, 0),
            6 => matches!(b0 & 1, 0),
            _ => false,
        };
        if !from_client
            && answers_by_name
            && self.phase == Phase::Command
            && self.open.is_some()
            && !self.names(low, high, sub)
        {
            return [None, Some(unasked(time_ns, bytes))];
        }
        if let Some(open) = &mut self.open {
            open.time_ns = time_ns;
            open.frames += 1;
            if !from_client && open.response_ns.is_none() {
                open.response_ns = Some(time_ns.saturating_sub(open.start_ns));
            }
        }
        let done = match (self.phase, from_client) {
            (_, _) if b0 == 0x80 && (self.phase == Phase::Command || self.names(low, high, sub)) => {
                Some(self.abort(time_ns, bytes))
            }
            (Phase::FromClient, true) | (Phase::FromServer, false) => self.block_segment(bytes),
            (_, true) => self.client(time_ns, bytes),
            (_, false) => self.server(time_ns, bytes),
        };
        [behind, done]
    }

    fn names(&self, low: u8, high: u8, sub: u8) -> bool {
        let object = (u16::from_le_bytes([low, high]), sub);
        self.open.as_ref().is_some_and(|open| (open.index, open.sub) == object)
    }

    /// Ends the current transfer.
    pub fn end(&mut self, trouble: Trouble) -> Option<SdoTransfer> {
        let open = self.open.take()?;
        self.phase = Phase::Command;
        // Whatever still arrives of it has been reported with it.
        self.is_orphan = true;
        Some(SdoTransfer { trouble: open.trouble.or(Some(trouble)), ..open })
    }

    fn abort(&mut self, time_ns: i64, bytes: [u8; 8]) -> SdoTransfer {
        let code = u32::from_le_bytes([bytes[4], bytes[5], bytes[6], bytes[7]]);
        self.phase = Phase::Command;
        let open = self.open.take().unwrap_or_else(|| fresh(time_ns, bytes, false, Mode::Expedited));
        SdoTransfer { abort: Some(code), trouble: Some(Trouble::Aborted(super::names::abort(code))), ..open }
    }

    fn done(&mut self) -> Option<SdoTransfer> {
        let mut open = self.open.take()?;
        self.phase = Phase::Command;
        let short = open.size.is_some_and(|size| size as usize != open.data.len());
        if short && open.trouble.is_none() {
            open.trouble = Some(Trouble::Malformed("the number of bytes is another than was said"));
        }
        Some(open)
    }

    fn client(&mut self, time_ns: i64, bytes: [u8; 8]) -> Option<SdoTransfer> {
        let b0 = bytes[0];
        match b0 >> 5 {
            1 => {
                let (expedited, sized) = (b0 & 2 != 0, b0 & 1 != 0);
                let mode = if expedited { Mode::Expedited } else { Mode::Segmented };
                let mut transfer = fresh(time_ns, bytes, true, mode);
                first_bytes(&mut transfer, b0, expedited, sized, bytes);
                (self.toggle, self.open) = (false, Some(transfer));
                None
            }
            0 => {
                // A segment, which is completed by its confirmation.
                let Some(open) =
                    self.open.as_mut().filter(|open| open.is_write && open.mode == Mode::Segmented)
                else {
                    return self.orphan(headless(time_ns, &bytes, Trouble::Headless));
                };
                if (b0 & 0x10 != 0) != self.toggle {
                    return self.end(wrong_toggle(self.toggle));
                }
                let unused = usize::from(b0 >> 1 & 7);
                append(open, &bytes[1..8 - unused]);
                self.last_segment = b0 & 1 != 0;
                None
            }
            2 => {
                (self.toggle, self.open) = (false, Some(fresh(time_ns, bytes, false, Mode::Expedited)));
                None
            }
            3 => {
                self.open.as_ref()?;
                if (b0 & 0x10 != 0) != self.toggle {
                    return self.end(wrong_toggle(self.toggle));
                }
                None
            }
            5 => match b0 & 3 {
                0 => {
                    self.open = Some(fresh(time_ns, bytes, false, Mode::Block));
                    self.crc = [b0 & 4 != 0, false];
                    None
                }
                1 => self.done(),
                2 => {
                    self.confirm_block(bytes[1]);
                    if !self.last_segment {
                        self.phase = Phase::FromServer;
                    }
                    None
                }
                _ => {
                    self.begin_block();
                    self.phase = Phase::FromServer;
                    None
                }
            },
            6 if b0 & 1 == 0 => {
                let mut transfer = fresh(time_ns, bytes, true, Mode::Block);
                transfer.size =
                    (b0 & 2 != 0).then(|| u32::from_le_bytes([bytes[4], bytes[5], bytes[6], bytes[7]]));
                (self.open, self.crc) = (Some(transfer), [b0 & 4 != 0, false]);
                None
            }
            6 => {
                self.end_block(b0, bytes);
                None
            }
            _ => None,
        }
    }

    fn server(&mut self, time_ns: i64, bytes: [u8; 8]) -> Option<SdoTransfer> {
        let b0 = bytes[0];
        let Some(open) = &mut self.open else {
            // An answer to an unobserved request.
            let transfer = unasked(time_ns, bytes);
            // Segments and their confirmations do not name an object.
            return if matches!(b0 >> 5, 0 | 1) { self.orphan(transfer) } else { Some(transfer) };
        };
        match b0 >> 5 {
            3 => (open.mode == Mode::Expedited).then(|| self.done()).flatten(),
            2 => {
                let (expedited, sized) = (b0 & 2 != 0, b0 & 1 != 0);
                open.mode = if expedited { Mode::Expedited } else { Mode::Segmented };
                // Also in answer to a request for blocks, which a server need not support.
                self.toggle = false;
                first_bytes(open, b0, expedited, sized, bytes);
                if expedited { self.done() } else { None }
            }
            1 => {
                if (b0 & 0x10 != 0) != self.toggle {
                    return self.end(wrong_toggle(self.toggle));
                }
                self.toggle = !self.toggle;
                if std::mem::take(&mut self.last_segment) { self.done() } else { None }
            }
            0 => {
                if (b0 & 0x10 != 0) != self.toggle {
                    return self.end(wrong_toggle(self.toggle));
                }
                self.toggle = !self.toggle;
                let unused = usize::from(b0 >> 1 & 7);
                append(open, &bytes[1..8 - unused]);
                if b0 & 1 != 0 { self.done() } else { None }
            }
            5 => match b0 & 3 {
                0 => {
                    self.crc[1] = b0 & 4 != 0;
                    self.begin_block();
                    self.phase = Phase::FromClient;
                    None
                }
                2 => {
                    self.confirm_block(bytes[1]);
                    if !self.last_segment {
                        self.phase = Phase::FromClient;
                    }
                    None
                }
                _ => self.done(),
            },
            6 if b0 & 1 == 0 => {
                open.size =
                    (b0 & 2 != 0).then(|| u32::from_le_bytes([bytes[4], bytes[5], bytes[6], bytes[7]]));
                self.crc[1] = b0 & 4 != 0;
                None
            }
            6 => {
                self.end_block(b0, bytes);
                None
            }
            _ => None,
        }
    }

    /// Segments of a transfer that is not in progress are reported once.
    fn orphan(&mut self, transfer: SdoTransfer) -> Option<SdoTransfer> {
        (!std::mem::replace(&mut self.is_orphan, true)).then_some(transfer)
    }

    fn begin_block(&mut self) {
        self.block_start = self.open.as_ref().map_or(0, |open| open.data.len());
        (self.block_next, self.last_segment) = (1, false);
    }

    fn block_segment(&mut self, bytes: [u8; 8]) -> Option<SdoTransfer> {
        let number = bytes[0] & 0x7F;
        let open = self.open.as_mut()?;
        // The receiver also rejects frames that are out of order, and requests them again.
        if number == self.block_next {
            self.block_next += 1;
            append(open, &bytes[1..]);
            self.last_segment = bytes[0] & 0x80 != 0;
        } else if bytes[0] & 0x80 != 0 {
            self.last_segment = true;
        }
        if bytes[0] & 0x80 != 0 || number == 127 {
            self.phase = Phase::Command;
        }
        None
    }

    /// The receiver has accepted this many frames of the block.
    fn confirm_block(&mut self, taken: u8) {
        self.phase = Phase::Command;
        let ours = self.block_next - 1;
        if let Some(open) = &mut self.open {
            if taken > ours {
                open.trouble
                    .get_or_insert(Trouble::Sequence { expected: self.block_next.into(), got: taken.into() });
            } else if taken < ours {
                open.data.truncate(self.block_start + usize::from(taken) * 7);
                self.last_segment = false;
            }
        }
        let last = self.last_segment;
        self.begin_block();
        self.last_segment = last;
    }

    fn end_block(&mut self, b0: u8, bytes: [u8; 8]) {
        let Some(open) = &mut self.open else { return };
        let unused = usize::from(b0 >> 2 & 7);
        open.data.truncate(open.data.len().saturating_sub(unused));
        let crc = u16::from_le_bytes([bytes[1], bytes[2]]);
        if self.crc == [true; 2]
            && open.trouble.is_none()
            && open.data.len() < MOST_BYTES
            && crc_of(&open.data) != crc
        {
            open.trouble = Some(Trouble::Malformed("the CRC is wrong"));
        }
    }
}

fn headless(time_ns: i64, data: &[u8], trouble: Trouble) -> SdoTransfer {
    SdoTransfer {
        data: Bytes::from_slice(data),
        trouble: Some(trouble),
        ..fresh(time_ns, [0; 8], false, Mode::Expedited)
    }
}

/// A server's answer to a request that was not observed.
fn unasked(time_ns: i64, bytes: [u8; 8]) -> SdoTransfer {
    let b0 = bytes[0];
    let mut transfer = fresh(time_ns, bytes, b0 >> 5 == 3, Mode::Expedited);
    if b0 >> 5 == 2 && b0 & 2 != 0 {
        first_bytes(&mut transfer, b0, true, b0 & 1 != 0, bytes);
    }
    SdoTransfer { trouble: Some(Trouble::Headless), ..transfer }
}

fn wrong_toggle(expected: bool) -> Trouble {
    Trouble::Sequence { expected: expected.into(), got: (!expected).into() }
}

fn append(open: &mut SdoTransfer, bytes: &[u8]) {
    let room = MOST_BYTES.saturating_sub(open.data.len());
    if bytes.len() > room {
        open.trouble.get_or_insert(Trouble::Cut);
    }
    open.data.extend_from_slice(&bytes[..bytes.len().min(room)]);
}

/// How many bytes of a command's frame count.
fn used(b0: u8, from_client: bool) -> usize {
    match (b0 >> 5, from_client) {
        // A segment.
        (0, _) => 8 - usize::from(b0 >> 1 & 7),
        // The begin of a transfer, with its bytes or how many they are.
        (1, true) | (2, false) => match b0 & 3 {
            0 => 4,
            3 => 8 - usize::from(b0 >> 2 & 3),
            _ => 8,
        },
        // A request for a segment, or the confirmation of one.
        (1, false) | (3, true) => 1,
        (2, true) | (3, false) => 4,
        _ => 8,
    }
}

/// The data in the frame that begins a transfer.
fn first_bytes(transfer: &mut SdoTransfer, b0: u8, expedited: bool, sized: bool, bytes: [u8; 8]) {
    if expedited {
        let unused = if sized { usize::from(b0 >> 2 & 3) } else { 0 };
        transfer.data = Bytes::from_slice(&bytes[4..8 - unused]);
    } else if sized {
        transfer.size = Some(u32::from_le_bytes([bytes[4], bytes[5], bytes[6], bytes[7]]));
    }
}

fn fresh(time_ns: i64, bytes: [u8; 8], is_write: bool, mode: Mode) -> SdoTransfer {
    SdoTransfer {
        start_ns: time_ns,
        time_ns,
        index: u16::from_le_bytes([bytes[1], bytes[2]]),
        sub: bytes[3],
        is_write,
        mode,
        data: Bytes::new(),
        size: None,
        frames: 1,
        response_ns: None,
        abort: None,
        trouble: None,
        frames_lost: false,
    }
}

/// CRC-16 with the polynomial 1021, from 0 (CiA 301, 7.2.4.3.16).
pub fn crc_of(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0, |crc, byte| {
        (0..8).fold(
            crc ^ u16::from(*byte) << 8,
            |crc, _| {
                if crc & 0x8000 == 0 { crc << 1 } else { crc << 1 ^ 0x1021 }
            },
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_crc_is_the_standards() {
        assert_eq!(crc_of(b"123456789"), 0x31C3);
    }
}
