//! A slave of CCP 2.1: commands in, answers and data packets out. Its numbers are in Intel's order.
//!
//! It has two lists of three packets each. It neither programs nor has pages, and nothing of it needs a key.

use super::xcp::Memory;
use crate::calibration::lists::{ListEntry, Lists};
use crate::calibration::parts::ByteOrder;
use crate::ccp::codec::{COMMAND_RETURN, command};

const ORDER: ByteOrder = ByteOrder::Little;
const LISTS: u16 = 2;
const PACKETS: u8 = 3;
const ENTRIES: u8 = 7;

const UNKNOWN: u8 = 0x30;
const OUT_OF_RANGE: u8 = 0x32;
const DENIED: u8 = 0x33;

/// A slave.
#[derive(Clone, Debug)]
pub struct CcpServer {
    station: u16,
    identification: Vec<u8>,
    is_connected: bool,
    mta: Option<(u8, u32)>,
    /// What UPLOAD reads after EXCHANGE_ID.
    is_identifying: Option<usize>,
    lists: Lists,
    status: u8,
}

impl CcpServer {
    /// With this station address, and a name.
    pub fn new(station: u16, identification: &str) -> Self {
        Self {
            station,
            identification: identification.as_bytes().to_vec(),
            is_connected: false,
            mta: None,
            is_identifying: None,
            lists: Lists::default(),
            status: 0,
        }
    }

    /// Takes what a master sends; returns the answer.
    pub fn hear(&mut self, data: &[u8], memory: &mut dyn Memory) -> Option<Vec<u8>> {
        let data: [u8; 8] = data.try_into().ok()?;
        let station = u16::from_le_bytes([data[2], data[3]]);
        match data[0] {
            command::CONNECT if station != self.station => {
                // Another station is meant.
                self.is_connected = false;
                return None;
            }
            command::CONNECT => self.is_connected = true,
            _ if !self.is_connected => return None,
            _ => {}
        }
        let (code, result) = match self.answer(data, memory) {
            Ok(result) => (0, result),
            Err(code) => (code, Vec::new()),
        };
        let mut answer = [&[COMMAND_RETURN, code, data[1]][..], &result].concat();
        answer.resize(8, 0);
        Some(answer)
    }

    fn answer(&mut self, data: [u8; 8], memory: &mut dyn Memory) -> Result<Vec<u8>, u8> {
        let address = |at: usize| (data[at], ORDER.number(&data[at + 1..at + 5]) as u32);
        let daq = u16::from(data[2]);
        let next = |mta: (u8, u32)| [&[mta.0][..], &ORDER.bytes(mta.1.into(), 4)].concat();
        match data[0] {
            command::CONNECT => Ok(Vec::new()),
            command::DISCONNECT => {
                self.is_connected = false;
                if data[2] == 1 {
                    self.lists.clear();
                }
                Ok(Vec::new())
            }
            command::GET_CCP_VERSION => Ok(vec![2, 1]),
            command::EXCHANGE_ID => {
                self.is_identifying = Some(0);
                Ok(vec![self.identification.len() as u8, 1, 0x03, 0x00])
            }
            command::SET_S_STATUS => {
                self.status = data[2];
                Ok(Vec::new())
            }
            command::GET_S_STATUS => Ok(vec![self.status, 0]),
            command::SET_MTA => {
                self.is_identifying = None;
                if data[2] == 0 {
                    self.mta = Some(address(3));
                }
                Ok(Vec::new())
            }
            command::UPLOAD => {
                let count = usize::from(data[2]);
                if !(1..=5).contains(&count) {
                    return Err(OUT_OF_RANGE);
                }
                if let Some(from) = self.is_identifying {
                    self.is_identifying = Some(from + count);
                    let bytes = self.identification.get(from..from + count);
                    return bytes.map(<[u8]>::to_vec).ok_or(OUT_OF_RANGE);
                }
                let (extension, address) = self.mta.ok_or(DENIED)?;
                self.mta = Some((extension, address.wrapping_add(count as u32)));
                memory.read(extension, address, count).ok_or(DENIED)
            }
            command::SHORT_UP => {
                let count = usize::from(data[2]);
                let (extension, address) = address(3);
                if !(1..=5).contains(&count) {
                    return Err(OUT_OF_RANGE);
                }
                memory.read(extension, address, count).ok_or(DENIED)
            }
            command::DNLOAD | command::DNLOAD_6 => {
                let bytes = if data[0] == command::DNLOAD_6 {
                    &data[2..]
                } else {
                    data.get(3..3 + usize::from(data[2]))
                        .filter(|bytes| !bytes.is_empty())
                        .ok_or(OUT_OF_RANGE)?
                };
                let (extension, address) = self.mta.ok_or(DENIED)?;
                if !memory.write(extension, address, bytes) {
                    return Err(DENIED);
                }
                let mta = (extension, address.wrapping_add(bytes.len() as u32));
                self.mta = Some(mta);
                Ok(next(mta))
            }
            command::GET_DAQ_SIZE => {
                if daq >= LISTS {
                    return Ok(vec![0, 0]);
                }
                self.lists.allocate_packets(daq, PACKETS);
                for odt in 0..PACKETS {
                    self.lists.allocate_entries(daq, odt, ENTRIES);
                }
                let first_pid = daq as u8 * PACKETS;
                let list = self.lists.list(daq).ok_or(OUT_OF_RANGE)?;
                (list.first_pid, list.is_running) = (Some(first_pid), false);
                Ok(vec![PACKETS, first_pid])
            }
            command::SET_DAQ_PTR => {
                if self.lists.get(daq).is_none() || data[3] >= PACKETS || data[4] >= ENTRIES {
                    return Err(OUT_OF_RANGE);
                }
                self.lists.point_to(daq, data[3], data[4]);
                Ok(Vec::new())
            }
            command::WRITE_DAQ => {
                let (extension, address) = address(3);
                let size = usize::from(data[2]);
                if !matches!(size, 1 | 2 | 4) || memory.read(extension, address, size).is_none() {
                    return Err(OUT_OF_RANGE);
                }
                self.lists.write(ListEntry { extension, address, size, bit: None });
                Ok(Vec::new())
            }
            command::START_STOP => {
                let list = self.lists.list(u16::from(data[3])).ok_or(OUT_OF_RANGE)?;
                list.event = Some(data[5].into());
                match data[2] {
                    0 => list.is_running = false,
                    1 => list.is_running = true,
                    2 => list.is_selected = true,
                    _ => return Err(OUT_OF_RANGE),
                }
                Ok(Vec::new())
            }
            command::START_STOP_ALL => {
                for (_, list) in self.lists.all() {
                    list.is_running = data[2] == 1 && (list.is_selected || list.is_running);
                    list.is_selected = false;
                }
                Ok(Vec::new())
            }
            _ => Err(UNKNOWN),
        }
    }

    /// Whether a list waits for this event.
    pub fn waits_for(&mut self, event: u16) -> bool {
        self.lists.all().any(|(_, list)| list.is_running && list.event == Some(event))
    }

    /// An event has happened: the data packets of all lists that wait for it.
    pub fn sample(&mut self, event: u16, memory: &dyn Memory) -> Vec<Vec<u8>> {
        let mut frames = Vec::new();
        for (_, list) in self.lists.all().filter(|(_, list)| list.is_running && list.event == Some(event)) {
            for odt in 0..list.packets() as u8 {
                let Some(entries) = list.packet(odt) else { continue };
                let mut data = vec![list.first_pid.unwrap_or_default() + odt];
                for entry in entries.iter().flatten() {
                    let bytes = memory.read(entry.extension, entry.address, entry.size);
                    data.extend(bytes.unwrap_or_else(|| vec![0; entry.size]));
                }
                data.resize(8, 0);
                frames.push(data);
            }
        }
        frames
    }
}
