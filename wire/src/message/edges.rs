//! The edges of a channel's receive pin, as they are measured while its controller is off the bus.

use heapless::Vec;
use serde::{Deserialize, Serialize};

/// Most edges in one [`Edges`].
pub const MAX_EDGES: usize = 64;

/// What was measured on a receive pin since the last answer. Where there are [`MAX_EDGES`], there are more to be asked for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Edges {
    /// Device time, in ticks, up to which all edges have been reported, if there are fewer than [`MAX_EDGES`] here.
    pub ticks: u64,
    /// The pin's level now: dominant, or recessive.
    pub dominant: bool,
    /// In order.
    pub edges: Vec<Edge, MAX_EDGES>,
}

/// One change of a receive pin's level.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Edge {
    /// Ticks since the edge before; for the first one since the measurement began. `u32::MAX` for that and more.
    pub ticks: u32,
    /// The level behind it: dominant, or recessive.
    pub dominant: bool,
    /// The device was blind for a moment just before: edges may be missing there, and this one may have been earlier.
    pub unsure: bool,
}
