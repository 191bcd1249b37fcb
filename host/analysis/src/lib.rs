#![doc = include_str!("../README.md")]
//!
//! [`stats`] measures, `plot` draws.

#![forbid(unsafe_code)]

mod cadence;
#[cfg(feature = "plot")]
pub mod plot;
pub mod stats;

pub use cadence::Cadence;
