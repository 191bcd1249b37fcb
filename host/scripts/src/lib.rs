#![doc = include_str!("../README.md")]
//!
//! A [`Script`] is a node. [`Bench`] runs several on simulated buses, [`Live`] on a device; both return a [`Report`].
//!
//! Each script has a thread of its own, but only one runs at a time: it is given an input and the time, and hands over what it wants sent when it
//! waits for the next input. So a run depends on nothing but its scripts, its seed and its bus.
//!
//! [`twin`] learns a bus from a trace and writes the scripts that play it.

#![deny(unsafe_code)]

mod attached;
mod bench;
mod byte_functions;
mod checksum;
mod constant_replies;
mod device_replies;
mod exchange;
mod explain;
mod fault_functions;
mod faults;
mod file_functions;
mod files;
mod functions;
mod handlers;
mod intake;
pub mod library;
mod live;
#[expect(unsafe_code, reason = "an allocator is")]
mod memory;
mod names;
mod node;
mod placement;
mod report;
mod results;
mod row_test;
mod runtime;
mod sandbox;
mod script_frame;
mod script_function;
mod script_result;
mod script_times;
mod server_functions;
mod servers;
mod settings;
mod sheets;
mod simulation;
mod step_functions;
mod surroundings;
mod test_functions;
pub mod twin;

pub use bench::Bench;
pub use device_replies::DeviceReplies;
pub use explain::Explained;
pub use faults::{BenchBus, Fault, Losing, PlannedFault};
pub use live::{BrokenOff, Live, LiveError, LiveRun, ScriptCounts, ScriptEvent, ScriptThread};
pub use memory::Counting;
pub use node::{Script, ScriptError};
pub use placement::{Placement, Runner, Statement, Target, TimedBy};
pub use report::{FAILED_HERE, Message, Outcome, Report, TestResult};
pub use simulation::Simulation;
