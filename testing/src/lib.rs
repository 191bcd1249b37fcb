//! What the tests of several crates share. It belongs to no release.

#![forbid(unsafe_code)]

pub mod peers;
pub mod process;
pub mod usbip;
