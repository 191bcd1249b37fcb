//! What a station and its long messages have in common.

use cantap_can::Frame;

use crate::j1939::Header;

pub(crate) const MS: u64 = 1_000_000;
pub(crate) const GLOBAL: u8 = 255;
pub(crate) const CONTROL: u32 = 0xEC00;
pub(crate) const DATA: u32 = 0xEB00;
/// The longest message (J1939-21).
pub(crate) const MOST_BYTES: usize = 1785;

/// Why a station failed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum StationError {
    /// Another node has the address, with a NAME of higher priority.
    #[error(
        "the address {address} is taken by the node with the NAME {name:016X}, and there is none left to take"
    )]
    AddressTaken {
        /// The address that was tried last.
        address: u8,
        /// The NAME of the node that has it.
        name: u64,
    },
    /// Nobody answered the request.
    #[error("no answer within {after_ms} ms")]
    NoAnswer {
        /// How long we waited.
        after_ms: u64,
    },
    /// The request was answered with a refusal.
    #[error("node {from} answers: {}", acknowledgement(*control))]
    NotAcknowledged {
        /// The node.
        from: u8,
        /// The reason, from 1.
        control: u8,
    },
    /// The other side aborted a message of many frames.
    #[error("node {from} aborted the message: {}", abort_reason(*reason))]
    Aborted {
        /// The node.
        from: u8,
        /// The reason.
        reason: u8,
    },
    /// The other side of a message of many frames fell silent.
    #[error("nothing came from node {from} for {after_ms} ms, after {done} of {total} frames of the message")]
    Silent {
        /// The node.
        from: u8,
        /// How long we waited.
        after_ms: u64,
        /// Frames so far.
        done: u8,
        /// Frames of the message.
        total: u8,
    },
    /// The other side of a message of many frames requests frames that do not exist, or the same ones
    /// repeatedly, or keeps asking to wait.
    #[error(
        "node {from} does not get on with the message: it has asked to wait, or for frames again, {times} times"
    )]
    Endless {
        /// The node.
        from: u8,
        /// How often.
        times: u32,
    },
    /// It took too long altogether.
    #[error("it was not complete within {after_ms} ms")]
    TooSlow {
        /// How long we tried.
        after_ms: u64,
    },
    /// It was ended from outside; the other side of a message of many frames was told.
    #[error("ended before it was complete")]
    Cancelled,
}

const fn acknowledgement(control: u8) -> &'static str {
    match control {
        1 => "negative: it does not have the group",
        2 => "access denied",
        3 => "busy: it cannot answer now",
        _ => "a reserved reason",
    }
}

const fn abort_reason(reason: u8) -> &'static str {
    match reason {
        1 => "it has another connection already",
        2 => "it lacks the resources",
        3 => "it has timed out",
        4 => "clear to send came while data was sent",
        5 => "too many frames were asked for again",
        6 => "an unexpected frame",
        7 => "a frame with a wrong number",
        8 => "a frame came twice",
        9 => "the message is too long for it",
        _ => "a reserved reason",
    }
}

/// A message's frame.
pub(crate) fn frame(priority: u8, pgn: u32, source: u8, destination: u8, data: &[u8]) -> Frame {
    let mut bytes = [0xFF; 8];
    let length = data.len().min(8);
    bytes[..length].copy_from_slice(&data[..length]);
    Frame::from_bus(Header { priority, pgn, source, destination }.id(), false, length as u8, bytes)
}

/// A group's number as in requests.
pub(crate) fn three(pgn: u32) -> [u8; 3] {
    let [low, middle, high, _] = pgn.to_le_bytes();
    [low, middle, high]
}
