#![doc = include_str!("../README.md")]
//!
//! An [`Assembler`] takes records and returns [`Event`]s. [`Conversations`] runs the assemblers of several protocols; a [`Survey`]
//! finds out which of them are used on a bus, and a [`Watch`] which begin later.

#![forbid(unsafe_code)]

pub mod active;
mod assembler;
pub mod canopen;
mod condition;
mod conversations;
pub mod devicenet;
pub mod diagnostics;
mod event;
pub mod iso_tp;
pub mod j1939;
pub mod naming;
pub mod nmea2000;
mod overview;
mod protocol;
mod relatives;
mod signs;
mod survey;
#[cfg(test)]
mod testing;
mod text;
mod watch;

pub use assembler::{Assembler, UnderWay, is_gap};
pub use condition::condition;
pub use conversations::{Conversations, Options};
pub use event::{Bytes, Event, Field, Party, Trouble, Value};
pub use overview::{Histogram, KnownNode, KnownObject, Overview, ServiceFigures};
pub use protocol::{Protocol, UnknownProtocol};
pub use relatives::Relative;
pub use survey::{Evidence, Survey};
pub use watch::{Begun, Watch};
