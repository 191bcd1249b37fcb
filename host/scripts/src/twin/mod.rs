//! Learns a bus from a trace, and writes scripts that play it.
//!
//! [`Learner`] collects the frames of a trace as [`Observed`]. [`Model::learn`] finds periods, counters, checksums, and who answers whom;
//! [`Model::twin`] and [`Model::tester`] are the scripts. [`compare`] says how far a run of them is from the trace.

mod checksums;
mod clock;
mod content;
mod counters;
mod distance;
mod exchanges;
mod learner;
mod model;
mod role;
mod source;
mod timing;

pub use distance::{Distance, StreamDistance, compare};
pub use learner::{Key, Learner, Observed, Seen};
pub use model::{Model, Stream, Timing};
pub use role::Role;
pub use source::Names;
