#![doc = include_str!("../README.md")]
//!
//! `cantap` knows a `Link`, not who makes one; this crate knows them all. Its errors are for people, with what to do next.

#![forbid(unsafe_code)]

mod address;
pub mod server;

pub use address::{Address, AddressError, LinkError, OpenDevice};
