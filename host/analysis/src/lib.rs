#![doc = include_str!("../README.md")]
//!
//! [`stats`] measures, [`delay`] measures gateways, [`align`] puts several recorders on one clock, `plot` draws.

#![forbid(unsafe_code)]

pub mod align;
mod cadence;
pub mod delay;
#[cfg(feature = "plot")]
pub mod plot;
pub mod stats;

pub use cadence::Cadence;
