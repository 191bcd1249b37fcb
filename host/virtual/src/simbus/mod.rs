//! A simulated CAN bus with exact bit lengths, in a time of its own.
//!
//! It knows arbitration, acknowledgement, retransmission and bit rates, at the resolution of whole frames; not
//! single bits, so no two nodes ever disturb each other in mid-frame. Its edges are made from the frames, for who watches a pin. Everything is deterministic by seed.

mod bus;
mod frames;
mod traffic;
mod waveform;

pub(crate) use bus::arbitration_field;
pub use bus::{Node, SimBus};
pub use frames::{FrameSource, Frames, UnknownFrames};
pub use traffic::{Schedule, Senders, Traffic};
pub use waveform::Edge;
