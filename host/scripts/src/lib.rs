#![doc = include_str!("../README.md")]
//!
//! A [`Script`] is a node. [`Bench`] runs several on simulated buses, [`Live`] on a device; both return a [`Report`].
//!
//! Each script has a thread of its own, but only one runs at a time: it is given an input and the time, and hands over what it wants sent when it
//! waits for the next input. So a run depends on nothing but its scripts, its seed and its bus.
//!
//! [`twin`] learns a bus from a trace and writes the scripts that play it.

#![deny(unsafe_code)]

mod bench;
mod byte_functions;
mod checksum;
mod exchange;
mod explain;
mod functions;
mod handlers;
pub mod library;
mod live;
#[expect(unsafe_code, reason = "an allocator is")]
mod memory;
mod node;
mod placement;
mod report;
mod results;
mod runtime;
mod sandbox;
mod script_frame;
mod script_result;
mod server_functions;
mod servers;
mod settings;
mod sheets;
pub mod twin;

pub use bench::{Bench, Simulation};
pub use explain::Explained;
pub use live::{BrokenOff, Live, LiveError, LiveRun, ScriptCounts, ScriptEvent, ScriptThread};
pub use memory::Counting;
pub use node::{Script, ScriptError};
pub use placement::{Placement, Runner, Statement, Target, TimedBy};
pub use report::{Message, Outcome, Report, TestResult};
