#![doc = include_str!("../README.md")]
//!
//! [`Frame`] and [`Id`] are what crosses a bus, [`BitTiming`] how fast, [`FrameBits`] how long it takes, [`BusErrorKind`] and
//! [`ErrorState`] what goes wrong there.

#![forbid(unsafe_code)]
#![cfg_attr(not(test), no_std)]

pub mod bits;
#[cfg(feature = "embedded-can")]
mod embedded;
mod error;
pub mod frame;
pub mod timing;

pub use bits::{FrameBits, bits_on_bus};
pub use error::{BusErrorKind, ErrorState};
pub use frame::{Frame, Id, ParseFrameError};
pub use timing::{BitTiming, NoTiming};
