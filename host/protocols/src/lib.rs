#![doc = include_str!("../README.md")]
//!
//! A [`Reader`] takes records and returns [`Event`]s. It runs an [`Assembler`] for each protocol: those that were asked for, or those
//! that a bus uses, by its first records and for as long as more come, which it announces.

#![forbid(unsafe_code)]

pub mod a2l;
pub mod active;
mod assembler;
pub mod calibration;
pub mod canopen;
pub mod ccp;
mod condition;
mod conversations;
mod crc;
pub mod devicenet;
pub mod diagnostics;
pub mod dsdl;
mod event;
mod event_kind;
mod field_selection;
pub mod iso_tp;
pub mod j1939;
mod json;
pub mod naming;
pub mod nmea2000;
pub mod odx;
mod overview;
mod protocol;
mod reader;
mod relatives;
pub mod serving;
mod signs;
mod survey;
mod table;
#[cfg(test)]
mod testing;
mod text;
mod uavcan;
mod watch;
pub mod xcp;

pub use assembler::{Assembler, UnderWay, is_gap};
pub use condition::condition;
pub use conversations::Options;
pub use event::{Bytes, Event, Field, Party, Trouble, Value};
pub use event_kind::{EventKind, UnknownEventKind};
pub use field_selection::{FieldSelection, FieldValue};
pub use overview::{Histogram, KnownNode, KnownObject, Overview, ServiceFigures};
pub use protocol::{Protocol, UnknownProtocol};
pub use reader::{Announcement, ReadItem, Reader};
pub use relatives::Relative;
pub use survey::Evidence;
