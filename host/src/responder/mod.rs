//! The device's side of a session, for whatever answers a host in place of a board: the server of a shared board, or an adapter that speaks
//! another protocol.
//!
//! [`Inbox`] finds a host's requests in a byte stream, [`encode_response`] encodes their answers, and [`StreamEncoder`] packs records into
//! batches. None of them does I/O. What answers is at the other end of a [`Link`](crate::device::Link).

mod inbox;
mod stream;

pub use inbox::{Inbox, Incoming};
pub use stream::{StreamEncoder, encode_response};
