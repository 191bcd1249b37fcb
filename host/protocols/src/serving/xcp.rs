//! A slave of XCP on CAN: commands in, responses and data packets out. Its numbers are in Intel's order, its packets of eight bytes.
//!
//! Lists are dynamic, their packets have absolute identifiers, and stamps of four bytes in microseconds where a master asks for them. It
//! neither programs nor stimulates, and has no pages.

use crate::calibration::lists::{ListEntry, Lists};
use crate::calibration::parts::ByteOrder;
use crate::xcp::codec::{ERR, LEAST_COMMAND, RES, command, error};

/// The memory of an ECU, as masters read and write it.
pub trait Memory {
    /// So many bytes; `None` if there are not so many.
    fn read(&self, extension: u8, address: u32, length: usize) -> Option<Vec<u8>>;

    /// Writes bytes; false if they are not there, or not to be written.
    fn write(&mut self, extension: u8, address: u32, bytes: &[u8]) -> bool;
}

/// An event of the ECU, with which lists are sampled.
#[derive(Clone, Debug)]
pub struct ServedEvent {
    /// Its name.
    pub name: String,
    /// Its period in milliseconds, at most 255.
    pub period_ms: u8,
}

const MAX_CTO: usize = 8;
const ORDER: ByteOrder = ByteOrder::Little;
/// Packet identifiers above are not data's.
const MOST_PACKETS: usize = 252;
const CALIBRATION: u8 = 0x01;
const DAQ: u8 = 0x04;
const STAMPED: u8 = 0x10;
/// Where the memory transfer address is: in the memory, or within a text that was asked for.
#[derive(Clone, Debug)]
enum Mta {
    Memory(u8, u32),
    Text(Vec<u8>, usize),
}

/// A slave.
#[derive(Clone, Debug)]
pub struct XcpServer {
    identification: String,
    events: Vec<ServedEvent>,
    is_connected: bool,
    mta: Option<Mta>,
    lists: Lists,
    /// Packets of the lists, as they were allocated.
    allocated: usize,
    /// Resources that need a key, and the seed that was given last.
    protected: u8,
    seed: Option<(u8, [u8; 4])>,
    seeds: u32,
    /// Bytes of a download in a block that are still to come.
    to_come: Option<(Vec<u8>, usize)>,
    now_us: u32,
}

type Answer = Result<Vec<u8>, u8>;

impl XcpServer {
    /// One that identifies itself with this name, with these events. `protected` are resources (1 calibration, 4 DAQ) that need a key,
    /// which is [`Self::key`] of the seed.
    pub fn new(identification: impl Into<String>, events: Vec<ServedEvent>, protected: u8) -> Self {
        Self {
            identification: identification.into(),
            events,
            is_connected: false,
            mta: None,
            lists: Lists::default(),
            allocated: 0,
            protected,
            seed: None,
            seeds: 0,
            to_come: None,
            now_us: 0,
        }
    }

    /// The key for a seed.
    pub fn key(seed: &[u8]) -> Vec<u8> {
        seed.iter().map(|byte| byte ^ 0xA5).collect()
    }

    /// Takes what a master sends; returns the frames of the answer, in order.
    pub fn hear(&mut self, data: &[u8], memory: &mut dyn Memory, now_us: u32) -> Vec<Vec<u8>> {
        self.now_us = now_us;
        let Some(&code) = data.first().filter(|code| **code >= LEAST_COMMAND) else { return Vec::new() };
        if !self.is_connected && code != command::CONNECT {
            return Vec::new();
        }
        if code == command::DOWNLOAD_NEXT {
            return self.download_next(data, memory).map_or_else(Vec::new, |answer| vec![frame(answer)]);
        }
        self.to_come = None;
        match code {
            command::UPLOAD => self.upload(data, memory),
            command::DOWNLOAD => {
                self.download(data, memory).map_or_else(Vec::new, |answer| vec![frame(answer)])
            }
            _ => vec![frame(self.answer(data, memory))],
        }
    }

    fn answer(&mut self, data: &[u8], memory: &dyn Memory) -> Answer {
        let byte = |at: usize| data.get(at).copied().ok_or(error::CMD_SYNTAX);
        let long =
            |at: usize| data.get(at..at + 4).map(|bytes| ORDER.number(bytes) as u32).ok_or(error::CMD_SYNTAX);
        match data[0] {
            command::CONNECT => {
                self.is_connected = true;
                self.stop();
                self.mta = None;
                Ok(vec![CALIBRATION | DAQ, 0xC0, MAX_CTO as u8, MAX_CTO as u8, 0, 1, 1])
            }
            command::DISCONNECT => {
                self.is_connected = false;
                self.stop();
                Ok(Vec::new())
            }
            command::GET_STATUS => {
                let is_running = self.lists.all().any(|(_, list)| list.is_running);
                Ok(vec![if is_running { 0x40 } else { 0 }, self.protected, 0, 0, 0])
            }
            command::SYNCH => Err(error::CMD_SYNCH),
            // Blocks of any number of frames from the slave; 43 in a download, as many as 255 bytes take.
            command::GET_COMM_MODE_INFO => Ok(vec![0, 1, 0, 43, 0, 0, 0x10]),
            command::GET_ID => {
                let length = if byte(1)? <= 2 { self.identification.len() } else { 0 };
                self.mta = Some(Mta::Text(self.identification.clone().into_bytes(), 0));
                Ok([&[0, 0, 0][..], &ORDER.bytes(length as u64, 4)].concat())
            }
            command::GET_SEED => {
                let resource = byte(2)?;
                if byte(1)? != 0 {
                    return Err(error::SEQUENCE);
                }
                if self.protected & resource == 0 {
                    return Ok(vec![0]);
                }
                self.seeds = self.seeds.wrapping_add(0x1234_5677);
                let seed = self.seeds.to_le_bytes();
                self.seed = Some((resource, seed));
                Ok([&[4][..], &seed].concat())
            }
            command::UNLOCK => {
                let length = usize::from(byte(1)?);
                let key = data.get(2..2 + length).ok_or(error::CMD_SYNTAX)?;
                match self.seed.take() {
                    None => Err(error::SEQUENCE),
                    Some((resource, seed)) if key == Self::key(&seed) => {
                        self.protected &= !resource;
                        Ok(vec![self.protected])
                    }
                    Some(_) => {
                        // A wrong key ends the session.
                        self.is_connected = false;
                        self.stop();
                        Err(error::ACCESS_LOCKED)
                    }
                }
            }
            command::SET_MTA => {
                self.mta = Some(Mta::Memory(byte(3)?, long(4)?));
                Ok(Vec::new())
            }
            command::SHORT_UPLOAD => {
                let count = usize::from(byte(1)?);
                let (extension, address) = (byte(3)?, long(4)?);
                if count == 0 || count >= MAX_CTO {
                    return Err(error::OUT_OF_RANGE);
                }
                let bytes = memory.read(extension, address, count).ok_or(error::ACCESS_DENIED)?;
                self.mta = Some(Mta::Memory(extension, address.wrapping_add(count as u32)));
                Ok(bytes)
            }
            code => self.answer_of_lists(code, data, memory),
        }
    }

    fn answer_of_lists(&mut self, code: u8, data: &[u8], memory: &dyn Memory) -> Answer {
        let byte = |at: usize| data.get(at).copied().ok_or(error::CMD_SYNTAX);
        let word =
            |at: usize| data.get(at..at + 2).map(|bytes| ORDER.number(bytes) as u16).ok_or(error::CMD_SYNTAX);
        if self.protected & DAQ != 0 && (0xD3..=0xE3).contains(&code) {
            return Err(error::ACCESS_LOCKED);
        }
        let has_list = |this: &Self, number: u16| this.lists.get(number).is_some();
        match code {
            command::GET_DAQ_PROCESSOR_INFO => {
                let events = ORDER.bytes(self.events.len() as u64, 2);
                Ok([&[0x11, 0, 0][..], &events, &[0, 0]].concat())
            }
            command::GET_DAQ_RESOLUTION_INFO => Ok(vec![1, 7, 1, 7, 0x34, 1, 0]),
            command::GET_DAQ_EVENT_INFO => {
                let event = self.events.get(usize::from(word(2)?)).ok_or(error::OUT_OF_RANGE)?;
                self.mta = Some(Mta::Text(event.name.clone().into_bytes(), 0));
                Ok(vec![0x04, 0xFF, event.name.len() as u8, event.period_ms, 6, 0])
            }
            command::GET_DAQ_CLOCK => Ok([&[0, 0, 0][..], &self.now_us.to_le_bytes()].concat()),
            command::FREE_DAQ => {
                self.stop();
                Ok(Vec::new())
            }
            command::ALLOC_DAQ => {
                self.stop();
                for number in 0..word(2)? {
                    self.lists.list(number).ok_or(error::MEMORY_OVERFLOW)?.mode = Some(0);
                }
                Ok(Vec::new())
            }
            command::ALLOC_ODT => {
                let (daq, count) = (word(2)?, byte(4)?);
                if !has_list(self, daq) {
                    return Err(error::OUT_OF_RANGE);
                }
                if self.allocated + usize::from(count) > MOST_PACKETS {
                    return Err(error::MEMORY_OVERFLOW);
                }
                let first_pid = self.allocated as u8;
                self.allocated += usize::from(count);
                self.lists.allocate_packets(daq, count);
                self.lists.list(daq).ok_or(error::OUT_OF_RANGE)?.first_pid = Some(first_pid);
                Ok(Vec::new())
            }
            command::ALLOC_ODT_ENTRY => {
                let (daq, odt) = (word(2)?, byte(4)?);
                if self.lists.get(daq).is_none_or(|list| usize::from(odt) >= list.packets()) {
                    return Err(error::OUT_OF_RANGE);
                }
                self.lists.allocate_entries(daq, odt, byte(5)?);
                Ok(Vec::new())
            }
            command::SET_DAQ_PTR => {
                let (daq, odt) = (word(2)?, byte(4)?);
                if self.lists.get(daq).is_none_or(|list| usize::from(odt) >= list.packets()) {
                    return Err(error::OUT_OF_RANGE);
                }
                self.lists.point_to(daq, odt, byte(5)?);
                Ok(Vec::new())
            }
            command::WRITE_DAQ => {
                if !self.lists.is_pointing() {
                    return Err(error::SEQUENCE);
                }
                let address = data.get(4..8).ok_or(error::CMD_SYNTAX)?;
                let (size, extension) = (usize::from(byte(2)?), byte(3)?);
                let address = ORDER.number(address) as u32;
                if size == 0 || size > 7 || memory.read(extension, address, size).is_none() {
                    return Err(error::OUT_OF_RANGE);
                }
                self.lists.write(ListEntry { extension, address, size, bit: None });
                Ok(Vec::new())
            }
            command::SET_DAQ_LIST_MODE => {
                let (mode, event) = (byte(1)?, word(4)?);
                if usize::from(event) >= self.events.len() || !has_list(self, word(2)?) {
                    return Err(error::OUT_OF_RANGE);
                }
                if mode & !STAMPED != 0 {
                    return Err(0x27);
                }
                let list = self.lists.list(word(2)?).ok_or(error::OUT_OF_RANGE)?;
                (list.mode, list.event) = (Some(mode), Some(event));
                Ok(Vec::new())
            }
            command::START_STOP_DAQ_LIST => {
                let (mode, daq) = (byte(1)?, word(2)?);
                if mode != 0 && !self.fits(daq) {
                    return Err(error::DAQ_CONFIG);
                }
                let list = self.lists.list(daq).ok_or(error::OUT_OF_RANGE)?;
                match mode {
                    0 => list.is_running = false,
                    1 => list.is_running = true,
                    _ => list.is_selected = true,
                }
                Ok(vec![list.first_pid.ok_or(error::DAQ_CONFIG)?])
            }
            command::START_STOP_SYNCH => {
                let mode = byte(1)?;
                for (_, list) in self.lists.all() {
                    match mode {
                        0 => list.is_running = false,
                        1 => list.is_running |= list.is_selected,
                        2 => list.is_running &= !list.is_selected,
                        _ => return Err(0x27),
                    }
                    list.is_selected = false;
                }
                Ok(Vec::new())
            }
            _ => Err(error::CMD_UNKNOWN),
        }
    }

    /// Whether all packets of a list are known, and no longer than a frame.
    fn fits(&self, daq: u16) -> bool {
        let Some(list) = self.lists.get(daq) else { return false };
        list.event.is_some() && (0..list.packets()).all(|odt| self.packet_fits(daq, odt as u8))
    }

    fn packet_fits(&self, daq: u16, odt: u8) -> bool {
        let Some(list) = self.lists.get(daq) else { return false };
        let is_stamped = odt == 0 && list.mode.is_some_and(|mode| mode & STAMPED != 0);
        let head = if is_stamped { 5 } else { 1 };
        let used =
            list.packet(odt).map(|entries| entries.iter().flatten().map(|entry| entry.size).sum::<usize>());
        used.is_some_and(|used| head + used <= MAX_CTO)
    }

    fn stop(&mut self) {
        self.lists.clear();
        self.allocated = 0;
    }

    fn upload(&mut self, data: &[u8], memory: &dyn Memory) -> Vec<Vec<u8>> {
        let count = data.get(1).map_or(0, |count| usize::from(*count));
        let bytes = match self.mta.take() {
            _ if count == 0 => return vec![frame(Err(error::OUT_OF_RANGE))],
            None => return vec![frame(Err(error::SEQUENCE))],
            Some(Mta::Memory(extension, address)) => {
                self.mta = Some(Mta::Memory(extension, address.wrapping_add(count as u32)));
                memory.read(extension, address, count)
            }
            Some(Mta::Text(text, from)) => {
                let bytes = text.get(from..from + count).map(<[u8]>::to_vec);
                self.mta = Some(Mta::Text(text, from + count));
                bytes
            }
        };
        match bytes {
            Some(bytes) => bytes.chunks(MAX_CTO - 1).map(|part| frame(Ok(part.to_vec()))).collect(),
            None => vec![frame(Err(error::ACCESS_DENIED))],
        }
    }

    fn download(&mut self, data: &[u8], memory: &mut dyn Memory) -> Option<Answer> {
        let count = data.get(1).map_or(0, |count| usize::from(*count));
        let bytes = &data[2.min(data.len())..];
        if count == 0 {
            return Some(Err(error::OUT_OF_RANGE));
        }
        if count > bytes.len() {
            self.to_come = Some((bytes.to_vec(), count));
            return None;
        }
        Some(self.write(&bytes[..count], memory))
    }

    fn download_next(&mut self, data: &[u8], memory: &mut dyn Memory) -> Option<Answer> {
        let Some((mut bytes, count)) = self.to_come.take() else { return Some(Err(error::SEQUENCE)) };
        // It names how many are left, of which the first are in this frame.
        if data.get(1).is_none_or(|left| usize::from(*left) != count - bytes.len()) {
            return Some(Err(error::SEQUENCE));
        }
        bytes.extend_from_slice(&data[2..]);
        if bytes.len() < count {
            self.to_come = Some((bytes, count));
            return None;
        }
        Some(self.write(&bytes[..count], memory))
    }

    fn write(&mut self, bytes: &[u8], memory: &mut dyn Memory) -> Answer {
        if self.protected & CALIBRATION != 0 {
            return Err(error::ACCESS_LOCKED);
        }
        let Some(Mta::Memory(extension, address)) = self.mta else { return Err(error::SEQUENCE) };
        if !memory.write(extension, address, bytes) {
            return Err(0x23);
        }
        self.mta = Some(Mta::Memory(extension, address.wrapping_add(bytes.len() as u32)));
        Ok(Vec::new())
    }

    /// The events that running lists wait for.
    pub fn sampled(&mut self) -> Vec<u16> {
        let running = self.lists.all().filter(|(_, list)| list.is_running);
        let mut events: Vec<_> = running.filter_map(|(_, list)| list.event).collect();
        events.sort_unstable();
        events.dedup();
        events
    }

    /// An event has happened: the data packets of all lists that wait for it.
    pub fn sample(&mut self, event: u16, memory: &dyn Memory, now_us: u32) -> Vec<Vec<u8>> {
        let mut frames = Vec::new();
        for (_, list) in self.lists.all().filter(|(_, list)| list.is_running && list.event == Some(event)) {
            for odt in 0..list.packets() as u8 {
                let mut data = vec![list.first_pid.unwrap_or_default().wrapping_add(odt)];
                if odt == 0 && list.mode.is_some_and(|mode| mode & STAMPED != 0) {
                    data.extend(now_us.to_le_bytes());
                }
                for entry in list.packet(odt).into_iter().flatten().flatten() {
                    let bytes = memory.read(entry.extension, entry.address, entry.size);
                    data.extend(bytes.unwrap_or_else(|| vec![0; entry.size]));
                }
                frames.push(data);
            }
        }
        frames
    }
}

/// The frame of an answer.
fn frame(answer: Answer) -> Vec<u8> {
    match answer {
        Ok(bytes) => [&[RES][..], &bytes].concat(),
        Err(code) => vec![ERR, code],
    }
}
