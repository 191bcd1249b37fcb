#![doc = include_str!("../README.md")]
//!
//! The functions of each library are behind a type that owns it. Every call checks what comes back before anybody relies on it: texts may lack
//! their end, lengths may be too large.

pub mod canlib;
mod library;
pub mod pcan_basic;

pub use library::LoadError;
