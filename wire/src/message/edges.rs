//! The edges of a channel's receive pin, measured while its controller is off the bus.

use heapless::Vec;
use serde::{Deserialize, Serialize};

/// Most edges in one [`Edges`].
pub const MAX_EDGES: usize = 64;

/// What was measured on a receive pin since the last answer. If there are [`MAX_EDGES`], ask again: there may be more.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Edges {
    /// Device time, in ticks, up to which all edges have been reported, if there are fewer than [`MAX_EDGES`] here.
    pub ticks: u64,
    /// Whether the pin's level is now dominant (or else recessive).
    pub dominant: bool,
    /// In order.
    pub edges: Vec<Edge, MAX_EDGES>,
}

/// One change of a receive pin's level.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Edge {
    /// Ticks since the previous edge; for the first edge, since the measurement began. `u32::MAX` stands for that or more.
    pub ticks: u32,
    /// Whether the level after it is dominant (or else recessive).
    pub dominant: bool,
    /// The device was blind for a moment just before: edges may be missing there, and this one may have been earlier.
    pub unsure: bool,
}
