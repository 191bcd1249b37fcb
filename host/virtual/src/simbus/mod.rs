//! A simulated CAN bus with exact bit lengths, in its own time.
//!
//! It models arbitration, acknowledgement, retransmission and bit rates with the resolution of whole frames, not single bits, so no two nodes ever
//! disturb each other in mid-frame. Its edges are derived from the frames, for watching a pin. A seed makes everything deterministic.

mod bus;
mod confinement;
mod frames;
mod traffic;
mod waveform;

#[cfg(feature = "nodes")]
pub(crate) use bus::arbitration_field;
pub use bus::{Node, SimBus};
pub use confinement::ErrorCounters;
pub use frames::{FrameSource, Frames, UnknownFrames};
pub use traffic::{Schedule, Senders, Traffic};
pub use waveform::Edge;
