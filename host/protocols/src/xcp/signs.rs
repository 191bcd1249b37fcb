//! How a connection of XCP shows: CONNECT, and the response that only XCP has.

use std::collections::VecDeque;

use cantap_trace::{Id, TraceFrame, TraceRecord};

use super::codec::{RES, command};
use crate::calibration::connection::MasterSlave;
use crate::calibration::finding::{ConnectionFinder, Sign};

/// How long the response may take, in nanoseconds.
const RESPONSE_NS: i64 = 1_000_000_000;
/// How many requests to connect on different identifiers may wait for their response.
const MOST_WAITING: usize = 16;

/// Finds out who is a master and who its slave.
#[derive(Clone, Debug, Default)]
pub struct ConnectFinder {
    waiting: VecDeque<TraceRecord>,
}

impl ConnectionFinder for ConnectFinder {
    fn look(&mut self, record: &TraceRecord, id: Id, data: &[u8]) -> Sign {
        // CONNECT and its response begin alike.
        if data.first() != Some(&RES) {
            return Sign::None;
        }
        let oldest_ns = record.time_ns.saturating_sub(RESPONSE_NS);
        self.waiting.retain(|asked| asked.time_ns >= oldest_ns);
        let id_of = |asked: &TraceRecord| asked.frame().map(TraceFrame::id);
        if is_connect(data) {
            self.waiting.retain(|asked| asked.channel != record.channel || id_of(asked) != Some(id));
            if self.waiting.len() == MOST_WAITING {
                self.waiting.pop_front();
            }
            self.waiting.push_back(*record);
            return Sign::Plausible;
        }
        if !is_connected(data) {
            return Sign::None;
        }
        let place = self
            .waiting
            .iter()
            .rposition(|asked| asked.channel == record.channel && id_of(asked) != Some(id));
        match place.and_then(|place| self.waiting.remove(place)) {
            Some(asked) => {
                let master = id_of(&asked).unwrap_or(id);
                Sign::Certain(MasterSlave { master, slave: id }, vec![asked])
            }
            None => Sign::None,
        }
    }
}

/// CONNECT, in two bytes or in a frame that is filled up.
fn is_connect(data: &[u8]) -> bool {
    match data {
        [command::CONNECT, 0 | 1] => true,
        [command::CONNECT, 0 | 1, rest @ ..] if data.len() >= 8 => {
            rest.iter().all(|byte| *byte == rest[0]) && rest.len() >= 6
        }
        _ => false,
    }
}

/// The response to it: resources and modes without reserved bits, packets of at least eight bytes, version 1.
fn is_connected(data: &[u8]) -> bool {
    match *data {
        [RES, resources, mode, max_cto, first, second, 1, 1, ref fill @ ..] => {
            let max_dto = if mode & 1 == 0 {
                u16::from_le_bytes([first, second])
            } else {
                u16::from_be_bytes([first, second])
            };
            resources & !0x3D == 0
                && resources != 0
                && mode & 0x38 == 0
                && mode & 0x06 != 0x06
                && (8..=64).contains(&max_cto)
                && (8..=64).contains(&max_dto)
                && fill.iter().all(|byte| *byte == fill[0])
        }
        _ => false,
    }
}
