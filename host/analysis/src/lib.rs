#![doc = include_str!("../README.md")]
//!
//! [`stats`] measures, `plot` draws.

#![forbid(unsafe_code)]

#[cfg(feature = "plot")]
pub mod plot;
pub mod stats;
