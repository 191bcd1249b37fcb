//! `virtual:ecu`: an ECU on the first bus that is measured and calibrated by XCP (7F0:7F1) and by CCP (700:701, station 39).
//!
//! Its engine idles and revs up in turn, every four seconds, at the bit rate with which the channel is opened. What is at which address
//! says its description, [`DESCRIPTION`]. Parameters are kept until the device is closed.

#[cfg(test)]
mod tests;

use std::collections::VecDeque;

use cantap_protocols::serving::ccp::CcpServer;
use cantap_protocols::serving::xcp::{Memory, ServedEvent, XcpServer};
use cantap_wire::{Frame, Id};

use crate::simbus::{Senders, arbitration_field};

/// The ECU's description, an A2L file.
pub const DESCRIPTION: &str = include_str!("ecu.a2l");

const XCP: [u32; 2] = [0x7F0, 0x7F1];
const CCP: [u32; 2] = [0x700, 0x701];
const STATION: u16 = 0x39;
const MS_NS: u64 = 1_000_000;
/// How long the ECU takes to answer.
const THINKS_NS: u64 = 300_000;
/// The periods of its events, in milliseconds.
const PERIODS_MS: [u8; 2] = [10, 100];
/// How many frames may wait to be sent; beyond that, none are made, like a node on a bus without room.
const MOST_WAITING: usize = 256;
/// The engine idles for this time, and revs up for the same.
const HALF_PERIOD_MS: u64 = 2000;
const MEASURED_AT: u32 = 0x2000_0000;
const PARAMETERS_AT: u32 = 0x3000_0000;
/// The program's name among the parameters, which is not written.
const PROGRAM: std::ops::Range<usize> = 8..16;
/// A map behind it: its axes have 3 of 4 and 2 of 3 points; engine speeds, pedal in per cent, torques row by row.
const MAP: [u8; 2] = [3, 2];
const MAP_SPEEDS: [u16; 3] = [4000, 12_000, 24_000];
const MAP_PEDAL: [u8; 2] = [0, 100];
const MAP_TORQUES: [u16; 6] = [0, 50, 100, 120, 180, 160];
/// Two cylinders: an offset and two limits of each.
const CYLINDERS: [u8; 8] = [0xFE, 0xFF, 10, 20, 3, 0, 30, 40];

/// What the ECU measures, and its parameters.
#[derive(Debug)]
struct Ecu {
    measured: [u8; 14],
    parameters: [u8; 48],
}

impl Ecu {
    fn new() -> Self {
        let mut parameters = [0; 48];
        parameters[..2].copy_from_slice(&3200_u16.to_le_bytes());
        parameters[2] = 130;
        parameters[4..8].copy_from_slice(&1_f32.to_le_bytes());
        parameters[PROGRAM].copy_from_slice(b"CANTAP01");
        let words = |words: &[u16]| words.iter().flat_map(|word| word.to_le_bytes()).collect::<Vec<_>>();
        let map = [&MAP[..], &words(&MAP_SPEEDS), &MAP_PEDAL, &words(&MAP_TORQUES)].concat();
        parameters[16..16 + map.len()].copy_from_slice(&map);
        parameters[40..].copy_from_slice(&CYLINDERS);
        Self { measured: [0; 14], parameters }
    }

    /// Measures, at this time.
    fn measure(&mut self, now_ns: u64) {
        let now_ms = now_ns / MS_NS;
        let phase = (now_ms % (2 * HALF_PERIOD_MS)) as f64 / HALF_PERIOD_MS as f64;
        // Level in the first half, a hill in the second.
        let gas = if phase < 1.0 { 0.0 } else { 1.0 - (2.0 * phase - 3.0).abs() };
        let [low, high, threshold, ..] = self.parameters;
        let idle = f64::from(u16::from_le_bytes([low, high]));
        let factor = f32::from_le_bytes([4, 5, 6, 7].map(|at| self.parameters[at]));
        let speed = (idle + gas * 12_000.0).min(65_535.0) as u16;
        let temperature = 120 + (gas * 20.0) as u8;
        self.measured[..2].copy_from_slice(&speed.to_le_bytes());
        self.measured[2] = temperature;
        self.measured[3] = (gas * 3.9) as u8;
        self.measured[4..8].copy_from_slice(&((gas * 180.0) as f32 * factor).to_le_bytes());
        self.measured[8..12].copy_from_slice(&(now_ms as u32).to_le_bytes());
        self.measured[12] = u8::from(temperature >= threshold) | if gas > 0.9 { 2 } else { 0 };
        self.measured[13] = (gas * 255.0) as u8;
    }
}

/// Where these bytes are in a part of the memory.
fn place(at: u32, part: usize, address: u32, length: usize) -> Option<std::ops::Range<usize>> {
    let from = address.checked_sub(at)? as usize;
    let to = from.checked_add(length)?;
    (to <= part).then_some(from..to)
}

impl Memory for Ecu {
    fn read(&self, extension: u8, address: u32, length: usize) -> Option<Vec<u8>> {
        let measured = place(MEASURED_AT, self.measured.len(), address, length);
        let parameters = place(PARAMETERS_AT, self.parameters.len(), address, length);
        match (extension, measured, parameters) {
            (0, Some(range), _) => Some(self.measured[range].to_vec()),
            (0, None, Some(range)) => Some(self.parameters[range].to_vec()),
            _ => None,
        }
    }

    fn write(&mut self, extension: u8, address: u32, bytes: &[u8]) -> bool {
        let range = place(PARAMETERS_AT, self.parameters.len(), address, bytes.len());
        let is_writable = |range: &std::ops::Range<usize>| {
            extension == 0 && (range.end <= PROGRAM.start || range.start >= PROGRAM.end)
        };
        let Some(range) = range.filter(is_writable) else { return false };
        self.parameters[range].copy_from_slice(bytes);
        true
    }
}

/// The bus with the ECU.
#[derive(Debug)]
pub struct EcuBus {
    ecu: Ecu,
    xcp: XcpServer,
    ccp: CcpServer,
    /// When each event happens next.
    events_ns: [u64; 2],
    waiting: VecDeque<(u64, Frame)>,
}

fn frame(id: u32, bytes: &[u8]) -> Frame {
    let mut data = [0; 8];
    let length = bytes.len().min(8);
    data[..length].copy_from_slice(&bytes[..length]);
    Frame::from_bus(Id::standard_truncated(id), false, length as u8, data)
}

impl EcuBus {
    /// The ECU, with nobody connected to it.
    pub fn in_use() -> Self {
        let events = PERIODS_MS.map(|period_ms| ServedEvent { name: format!("{period_ms} ms"), period_ms });
        Self {
            ecu: Ecu::new(),
            xcp: XcpServer::new("cantap_virtual_ecu", events.to_vec(), 0),
            ccp: CcpServer::new(STATION, "cantap_virtual_ecu"),
            events_ns: [0; 2],
            waiting: VecDeque::new(),
        }
    }

    fn send(&mut self, at_ns: u64, id: u32, bytes: &[u8]) {
        if self.waiting.len() < MOST_WAITING {
            let after = self.waiting.back().map_or(0, |(due_ns, _)| *due_ns);
            self.waiting.push_back((at_ns.max(after), frame(id, bytes)));
        }
    }

    /// Whether any list runs that waits for this event.
    fn is_sampled(&mut self, event: u16) -> bool {
        self.xcp.sampled().contains(&event) || self.ccp.waits_for(event)
    }

    fn advance(&mut self, now_ns: u64) {
        for event in 0..2_u16 {
            let place = usize::from(event);
            if self.events_ns[place] > now_ns {
                continue;
            }
            let period_ns = u64::from(PERIODS_MS[place]) * MS_NS;
            let at_ns = now_ns - (now_ns - self.events_ns[place]) % period_ns;
            // Those while the bus was busy, or nobody listened, are left out.
            self.events_ns[place] = at_ns + period_ns;
            if !self.is_sampled(event) {
                continue;
            }
            self.ecu.measure(at_ns);
            for packet in self.xcp.sample(event, &self.ecu, (at_ns / 1000) as u32) {
                self.send(at_ns, XCP[1], &packet);
            }
            for packet in self.ccp.sample(event, &self.ecu) {
                self.send(at_ns, CCP[1], &packet);
            }
        }
    }
}

impl Senders for EcuBus {
    fn due(&mut self, now_ns: u64) -> Option<u64> {
        self.advance(now_ns);
        let first = self.waiting.front().map(|(due_ns, _)| *due_ns);
        let sampled = (0..2_u16).filter(|event| self.is_sampled(*event)).collect::<Vec<_>>();
        let next = sampled.into_iter().map(|event| self.events_ns[usize::from(event)]).min();
        first.into_iter().chain(next).min()
    }

    fn bid(&mut self, now_ns: u64) -> Option<Frame> {
        self.advance(now_ns);
        let due = self.waiting.iter().filter(|(due_ns, _)| *due_ns <= now_ns);
        due.map(|(_, frame)| *frame).min_by_key(|frame| arbitration_field(frame.id(), frame.is_remote()))
    }

    fn take(&mut self, now_ns: u64) {
        let Some(frame) = self.bid(now_ns) else { return };
        if let Some(place) = self.waiting.iter().position(|(_, waiting)| *waiting == frame) {
            self.waiting.remove(place);
        }
    }

    fn delivered(&mut self) {}

    fn destroyed(&mut self, frame: &Frame, _now_ns: u64) {
        self.waiting.push_front((0, *frame));
    }

    fn hear(&mut self, frame: &Frame, now_ns: u64) {
        if frame.is_remote() || frame.id().is_extended() {
            return;
        }
        let (id, data) = (frame.id().raw(), frame.data());
        self.ecu.measure(now_ns);
        if id == XCP[0] {
            for answer in self.xcp.hear(data, &mut self.ecu, (now_ns / 1000) as u32) {
                self.send(now_ns + THINKS_NS, XCP[1], &answer);
            }
        } else if id == CCP[0]
            && let Some(answer) = self.ccp.hear(data, &mut self.ecu)
        {
            self.send(now_ns + THINKS_NS, CCP[1], &answer);
        }
    }
}
