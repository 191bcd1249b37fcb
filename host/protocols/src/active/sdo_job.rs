//! What to do with an object of a CANopen node, with which identifiers, and why it fails.

use cantap_trace::Id;

use crate::canopen::abort_text;

/// The identifiers of a node's SDO channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SdoIds {
    /// Identifier of the requests.
    pub request: Id,
    /// Identifier of the answers.
    pub response: Id,
}

impl SdoIds {
    /// Those of the default SDO of a node, 1 to 127.
    pub const fn of(node: u8) -> Self {
        let node = (node & 0x7F) as u32;
        Self { request: Id::standard_truncated(0x600 + node), response: Id::standard_truncated(0x580 + node) }
    }
}

/// What to do with an object.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SdoJob {
    /// Read it.
    Read,
    /// Write these bytes.
    Write(Vec<u8>),
}

/// Why a transfer failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SdoError {
    /// The node stopped answering, or never did.
    #[error("no answer within {after_ms} ms, after {done} bytes")]
    NoAnswer {
        /// How long we waited.
        after_ms: u64,
        /// Bytes transferred so far.
        done: usize,
    },
    /// The node aborted it.
    #[error("the node aborted it: {} ({code:08X})", abort_text(*code))]
    Aborted {
        /// Its reason (CiA 301, table 22).
        code: u32,
    },
    /// The node's answer violates the standard; the transfer was aborted.
    #[error("the node's answer is wrong, after {done} bytes: {} ({code:08X})", abort_text(*code))]
    Wrong {
        /// The abort code sent to it.
        code: u32,
        /// Bytes transferred so far.
        done: usize,
    },
    /// The node keeps sending, but nothing that continues the object; the transfer was aborted.
    #[error(
        "the node has sent nothing that continues the object for {after_ms} ms, after {done} bytes; the transfer was aborted"
    )]
    Stalled {
        /// For how long.
        after_ms: u64,
        /// Bytes transferred so far.
        done: usize,
    },
    /// It took too long altogether; the transfer was aborted.
    #[error("it was not complete within {after_s} s, after {done} bytes; the transfer was aborted")]
    TooSlow {
        /// How long we tried.
        after_s: u64,
        /// Bytes transferred so far.
        done: usize,
    },
    /// Another client uses the same channel, so the node's answers may be to its requests. Nothing more was sent: an abort would
    /// end its transfer.
    #[error(
        "another client uses this SDO channel at the same time, after {done} bytes; the answers may be to its requests"
    )]
    OtherClient {
        /// Bytes transferred so far.
        done: usize,
    },
    /// It was ended from outside; the node was told.
    #[error("ended before it was complete, after {done} bytes")]
    Cancelled {
        /// Bytes transferred so far.
        done: usize,
    },
    /// Frames from the bus were lost on the way to this computer.
    #[error(
        "frames were lost on the way to this computer, so the object may not be whole; the transfer was aborted"
    )]
    FramesLost,
}
