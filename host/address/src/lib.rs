#![doc = include_str!("../README.md")]
//!
//! `cantap` takes a `Link` without knowing who makes it; this crate knows all of them. Its errors are written for people
//! and say what to do next.

#![forbid(unsafe_code)]

mod address;
pub mod server;

pub use address::{Address, AddressError, LinkError, OpenDevice, OpenError, open};
