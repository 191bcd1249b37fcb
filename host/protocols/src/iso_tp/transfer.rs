//! A transfer.

use super::pairs::Endpoint;
use crate::{Bytes, Trouble};

/// A message of one or many frames, or as much of it as arrived.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Transfer {
    /// The stamp of the last frame, or when it was abandoned, in nanoseconds.
    pub time_ns: i64,
    /// The stamp of the first frame.
    pub start_ns: i64,
    /// The channel, from 1.
    pub channel: u8,
    /// The sender.
    pub from: Endpoint,
    /// The receiver, if it is known and unique.
    pub to: Option<Endpoint>,
    /// The bytes.
    pub data: Bytes,
    /// The expected number of bytes.
    pub length: u32,
    /// Number of frames, including flow control.
    pub frames: u32,
    /// From the receiver's last flow control: frames until the next one.
    pub block_size: Option<u8>,
    /// From the receiver's last flow control: microseconds between two frames.
    pub separation_us: Option<u32>,
    /// Flow control frames that asked to wait.
    pub waits: u32,
    /// Frames that came earlier than the receiver had requested.
    pub too_early: u32,
    /// What went wrong.
    pub trouble: Option<Trouble>,
    /// Frames on the channel were lost meanwhile.
    pub frames_lost: bool,
    /// Frames on the channel were lost before it, which its reader has not been told: it was read later than it was heard.
    pub after_loss: bool,
}

impl Transfer {
    /// Whether it is complete.
    pub fn is_whole(&self) -> bool {
        self.trouble.is_none()
    }

    /// Of no frames.
    pub(super) fn empty() -> Self {
        let id = cantap_trace::Id::standard_truncated(0);
        Self {
            time_ns: 0,
            start_ns: 0,
            channel: 0,
            from: Endpoint { id, address: None },
            to: None,
            data: Bytes::new(),
            length: 0,
            frames: 0,
            block_size: None,
            separation_us: None,
            waits: 0,
            too_early: 0,
            trouble: None,
            frames_lost: false,
            after_loss: false,
        }
    }
}
