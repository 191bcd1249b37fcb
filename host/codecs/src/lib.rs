#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]

pub mod cannelloni;
pub mod gvret;
