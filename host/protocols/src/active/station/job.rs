//! What a station is to do, and how long that may take.

use super::parts::MS;

/// How long a station may take.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StationTiming {
    /// How long to wait for the beginning of an answer to a request.
    pub answer_ns: u64,
    /// For everything after the address was claimed, however often the other side asks to wait (T4) or for frames again.
    pub patience_ns: u64,
}

impl Default for StationTiming {
    /// 1250 ms, which is T3 of J1939-21 (Tr is 200 ms); one minute.
    fn default() -> Self {
        Self { answer_ns: 1250 * MS, patience_ns: 60_000 * MS }
    }
}

/// What a station should do with its address.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StationJob {
    /// Only claim it.
    Claim,
    /// Request a parameter group.
    Request {
        /// The group, 18 bits.
        pgn: u32,
        /// Who is asked; 255 for all.
        to: u8,
    },
    /// Send a message of up to 1785 bytes.
    Send {
        /// The group, 18 bits.
        pgn: u32,
        /// The receiver; 255 for all.
        to: u8,
        /// 0, the highest, to 7.
        priority: u8,
        /// Its bytes.
        data: Vec<u8>,
    },
    /// Send a message of up to 223 bytes by NMEA 2000's fast packet.
    SendFast {
        /// The group, 18 bits.
        pgn: u32,
        /// The receiver; 255 for all.
        to: u8,
        /// 0, the highest, to 7.
        priority: u8,
        /// Its bytes.
        data: Vec<u8>,
    },
}

/// A message to this station, or to all, that answers its request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GroupAnswer {
    /// The sender's address.
    pub from: u8,
    /// Its bytes.
    pub data: Vec<u8>,
}
