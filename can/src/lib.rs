#![doc = include_str!("../README.md")]
//!
//! [`Frame`], [`FdFrame`] and [`Id`] are what crosses a bus, [`BitTiming`] how fast, [`FrameBits`] how long it takes, [`BusErrorKind`] and
//! [`ErrorState`] what goes wrong there, [`LossStage`] and [`TransmitFailure`] what goes wrong on a device, on its [`Channel`]s. Each of these
//! has one name, which texts, JSON and tables use.

#![forbid(unsafe_code)]
#![cfg_attr(not(test), no_std)]

pub mod bits;
mod channel;
#[cfg(feature = "embedded-can")]
mod embedded;
mod error;
mod failure;
pub mod fd;
pub mod frame;
pub mod timing;

pub use bits::{FrameBits, bits_on_bus};
pub use channel::{CHANNELS, Channel};
pub use error::{BusErrorKind, ErrorState};
pub use failure::{DEVICE_TAG, LossStage, TransmitFailure};
pub use fd::FdFrame;
pub use frame::{Frame, Id, ParseFrameError};
pub use timing::{BitTiming, NoTiming};
