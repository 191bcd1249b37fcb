//! The SDO server: expedited, in segments and in blocks, in both directions (CiA 301, 7.2.4.3).

use cantap_protocols::canopen::crc_of;

use super::dictionary::{Dictionary, MOST_BYTES, abort};

/// Bytes of a segment.
const SEGMENT: usize = 7;
/// Frames in a block that is written: few, so that a short transfer has several blocks.
const BLOCK: u8 = 16;
/// After this silence of the client, a transfer ends.
const PATIENCE_NS: u64 = 3_000_000_000;

/// The current transfer.
#[derive(Debug)]
enum State {
    Idle,
    Read {
        data: Vec<u8>,
        at: usize,
        toggle: bool,
    },
    Write {
        data: Vec<u8>,
        size: Option<usize>,
        toggle: bool,
    },
    /// A block is about to be sent or was sent: where it starts, how many frames it has, and how many of them
    /// were sent.
    ReadBlocks {
        data: Vec<u8>,
        at: usize,
        block: u8,
        sent: u8,
        ends: bool,
    },
    /// `next`: the number of the next segment; `ended`: the last one has come.
    WriteBlocks {
        data: Vec<u8>,
        size: Option<usize>,
        next: u8,
        with_crc: bool,
        ended: bool,
    },
}

/// A node's server, for one client at a time.
#[derive(Debug)]
pub struct Server {
    state: State,
    object: (u16, u8),
    until_ns: u64,
    /// The segment of the next block to lose on purpose; 0 for none.
    pub loses: u8,
}

/// Frames to send, and what was written.
#[derive(Debug, Default)]
pub struct Said {
    pub frames: Vec<[u8; 8]>,
    pub written: Option<(u16, u8)>,
}

impl Default for Server {
    fn default() -> Self {
        Self { state: State::Idle, object: (0, 0), until_ns: 0, loses: 0 }
    }
}

impl Server {
    /// When silence of the client ends the current transfer.
    pub fn due(&self) -> Option<u64> {
        (!matches!(self.state, State::Idle)).then_some(self.until_ns)
    }

    /// The client has been silent for too long.
    pub fn give_up(&mut self) -> [u8; 8] {
        self.abort(abort::TIMEOUT)
    }

    fn abort(&mut self, code: u32) -> [u8; 8] {
        self.state = State::Idle;
        self.frame(0x80, code.to_le_bytes())
    }

    fn frame(&self, command: u8, last: [u8; 4]) -> [u8; 8] {
        let ([low, high], sub) = (self.object.0.to_le_bytes(), self.object.1);
        let [a, b, c, d] = last;
        [command, low, high, sub, a, b, c, d]
    }

    /// Takes a frame from the client.
    pub fn take(&mut self, bytes: [u8; 8], dictionary: &mut Dictionary, now_ns: u64) -> Said {
        self.until_ns = now_ns + PATIENCE_NS;
        let mut said = Said::default();
        if let Err(code) = self.command(bytes, dictionary, &mut said) {
            said.frames = vec![self.abort(code)];
            said.written = None;
        }
        said
    }

    fn command(&mut self, bytes: [u8; 8], dictionary: &mut Dictionary, said: &mut Said) -> Result<(), u32> {
        let command = bytes[0];
        if command == 0x80 {
            self.state = State::Idle;
            return Ok(());
        }
        if let State::WriteBlocks { ended: false, .. } = self.state {
            return self.block_segment(bytes, said);
        }
        let named = (u16::from_le_bytes([bytes[1], bytes[2]]), bytes[3]);
        let size = u32::from_le_bytes([bytes[4], bytes[5], bytes[6], bytes[7]]) as usize;
        match (command >> 5, command & 3) {
            (1, kind) => {
                self.object = named;
                self.state = State::Idle;
                if kind & 2 != 0 {
                    let unused = if kind & 1 == 0 { 0 } else { usize::from(command >> 2 & 3) };
                    self.write(&bytes[4..8 - unused], dictionary, said)?;
                } else {
                    let size = (kind & 1 != 0).then_some(size);
                    dictionary.may_write(named.0, named.1, size)?;
                    self.state = State::Write { data: Vec::new(), size, toggle: false };
                }
                said.frames.push(self.frame(0x60, [0; 4]));
                Ok(())
            }
            (0, _) => self.written_segment(bytes, dictionary, said),
            (2, _) => {
                self.object = named;
                self.state = State::Idle;
                let data = dictionary.read(named.0, named.1)?.to_vec();
                self.begin_reading(data, said);
                Ok(())
            }
            (3, _) => self.read_segment(command, said),
            (5, 0) => {
                self.object = named;
                self.state = State::Idle;
                let data = dictionary.read(named.0, named.1)?.to_vec();
                let (block, threshold) = (bytes[4], usize::from(bytes[5]));
                if !(1..=127).contains(&block) {
                    return Err(abort::BLOCK_SIZE);
                }
                // So short that the client wants it without blocks.
                if data.len() <= threshold {
                    self.begin_reading(data, said);
                    return Ok(());
                }
                said.frames.push(self.frame(0xC6, (data.len() as u32).to_le_bytes()));
                self.state = State::ReadBlocks { data, at: 0, block, sent: 0, ends: false };
                Ok(())
            }
            (5, 3) => {
                self.send_block(said);
                Ok(())
            }
            (5, 2) => self.block_confirmed(bytes[1], bytes[2], said),
            (5, _) => {
                self.state = State::Idle;
                Ok(())
            }
            (6, kind) if kind & 1 == 0 => {
                self.object = named;
                self.state = State::Idle;
                let size = (kind & 2 != 0).then_some(size);
                dictionary.may_write(named.0, named.1, size)?;
                let with_crc = command & 4 != 0;
                self.state = State::WriteBlocks { data: Vec::new(), size, next: 1, with_crc, ended: false };
                said.frames.push(self.frame(0xA4, [BLOCK, 0, 0, 0]));
                Ok(())
            }
            (6, _) => self.end_of_blocks(bytes, dictionary, said),
            _ => Err(abort::COMMAND),
        }
    }

    fn write(&self, value: &[u8], dictionary: &mut Dictionary, said: &mut Said) -> Result<(), u32> {
        let (index, sub) = self.object;
        dictionary.write(index, sub, value)?;
        said.written = Some(self.object);
        Ok(())
    }

    fn begin_reading(&mut self, data: Vec<u8>, said: &mut Said) {
        if (1..=4).contains(&data.len()) {
            let mut last = [0; 4];
            last[..data.len()].copy_from_slice(&data);
            said.frames.push(self.frame(0x43 | (4 - data.len() as u8) << 2, last));
        } else {
            said.frames.push(self.frame(0x41, (data.len() as u32).to_le_bytes()));
            self.state = State::Read { data, at: 0, toggle: false };
        }
    }

    fn read_segment(&mut self, command: u8, said: &mut Said) -> Result<(), u32> {
        let State::Read { data, at, toggle } = &mut self.state else { return Err(abort::COMMAND) };
        if (command & 0x10 != 0) != *toggle {
            return Err(abort::TOGGLE);
        }
        let part = &data[*at..data.len().min(*at + SEGMENT)];
        let is_last = *at + part.len() == data.len();
        let mut frame = [0; 8];
        frame[0] = u8::from(*toggle) << 4 | ((SEGMENT - part.len()) as u8) << 1 | u8::from(is_last);
        frame[1..=part.len()].copy_from_slice(part);
        said.frames.push(frame);
        (*at, *toggle) = (*at + part.len(), !*toggle);
        if is_last {
            self.state = State::Idle;
        }
        Ok(())
    }

    fn written_segment(
        &mut self,
        bytes: [u8; 8],
        dictionary: &mut Dictionary,
        said: &mut Said,
    ) -> Result<(), u32> {
        let State::Write { data, size, toggle } = &mut self.state else { return Err(abort::COMMAND) };
        if (bytes[0] & 0x10 != 0) != *toggle {
            return Err(abort::TOGGLE);
        }
        data.extend_from_slice(&bytes[1..8 - usize::from(bytes[0] >> 1 & 7)]);
        if data.len() > MOST_BYTES {
            return Err(abort::MEMORY);
        }
        let answer = [0x20 | u8::from(*toggle) << 4, 0, 0, 0, 0, 0, 0, 0];
        *toggle = !*toggle;
        if bytes[0] & 1 != 0 {
            if size.is_some_and(|size| size != data.len()) {
                return Err(abort::LENGTH);
            }
            let data = std::mem::take(data);
            self.state = State::Idle;
            self.write(&data, dictionary, said)?;
        }
        said.frames.push(answer);
        Ok(())
    }

    /// Sends a block, from where the last one was confirmed.
    fn send_block(&mut self, said: &mut Said) {
        let loses = std::mem::take(&mut self.loses);
        let State::ReadBlocks { data, at, block, sent, ends } = &mut self.state else { return };
        (*sent, *ends) = (0, false);
        while *sent < *block && !*ends {
            let from = *at + usize::from(*sent) * SEGMENT;
            let part = &data[from.min(data.len())..data.len().min(from + SEGMENT)];
            *ends = from + SEGMENT >= data.len();
            *sent += 1;
            let mut frame = [0; 8];
            frame[0] = u8::from(*ends) << 7 | *sent;
            frame[1..=part.len()].copy_from_slice(part);
            if *sent != loses {
                said.frames.push(frame);
            }
        }
    }

    fn block_confirmed(&mut self, taken: u8, next: u8, said: &mut Said) -> Result<(), u32> {
        let State::ReadBlocks { data, at, block, sent, ends } = &mut self.state else {
            return Err(abort::COMMAND);
        };
        if taken > *sent {
            return Err(abort::SEQUENCE);
        }
        if *ends && taken == *sent {
            let unused = (SEGMENT - data.len() % SEGMENT) % SEGMENT;
            let unused = if data.is_empty() { SEGMENT } else { unused };
            let [low, high] = crc_of(data).to_le_bytes();
            said.frames.push([0xC1 | (unused as u8) << 2, low, high, 0, 0, 0, 0, 0]);
            return Ok(());
        }
        if !(1..=127).contains(&next) {
            return Err(abort::BLOCK_SIZE);
        }
        (*at, *block) = (*at + usize::from(taken) * SEGMENT, next);
        self.send_block(said);
        Ok(())
    }

    fn block_segment(&mut self, bytes: [u8; 8], said: &mut Said) -> Result<(), u32> {
        let State::WriteBlocks { data, next, ended, .. } = &mut self.state else {
            return Err(abort::COMMAND);
        };
        let (number, is_last) = (bytes[0] & 0x7F, bytes[0] & 0x80 != 0);
        if number == 0 || number > BLOCK {
            return Err(abort::SEQUENCE);
        }
        if number == self.loses {
            self.loses = 0;
        } else if number == *next {
            data.extend_from_slice(&bytes[1..]);
            *next += 1;
            *ended = is_last;
        }
        if data.len() > MOST_BYTES + SEGMENT {
            return Err(abort::MEMORY);
        }
        if number == BLOCK || is_last {
            said.frames.push([0xA2, *next - 1, BLOCK, 0, 0, 0, 0, 0]);
            *next = 1;
        }
        Ok(())
    }

    fn end_of_blocks(
        &mut self,
        bytes: [u8; 8],
        dictionary: &mut Dictionary,
        said: &mut Said,
    ) -> Result<(), u32> {
        let State::WriteBlocks { data, size, with_crc, .. } = &mut self.state else {
            return Err(abort::COMMAND);
        };
        data.truncate(data.len().saturating_sub(usize::from(bytes[0] >> 2 & 7)));
        if *with_crc && crc_of(data) != u16::from_le_bytes([bytes[1], bytes[2]]) {
            return Err(abort::CRC);
        }
        if size.is_some_and(|size| size != data.len()) {
            return Err(abort::LENGTH);
        }
        let data = std::mem::take(data);
        self.state = State::Idle;
        self.write(&data, dictionary, said)?;
        said.frames.push([0xA1, 0, 0, 0, 0, 0, 0, 0]);
        Ok(())
    }
}
