//! Every integration test of this crate, in one program: each program is linked on its own.

mod any_commands;
mod arbitrary;
mod capture;
mod edges;
mod errors;
mod fakes;
mod filters;
mod gateway;
mod gateway_safety;
mod leaving;
mod long_pauses;
mod periodic;
mod queue;
mod refusals;
mod session;
mod slcan;
mod sof;
mod stubborn;
mod transmit;
