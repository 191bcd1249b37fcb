//! Every integration test of this crate, in one program: each program is linked on its own.

mod any_program;
#[path = "../../emu/tests/it/assembly/mod.rs"]
mod assembly;
mod bus_commands;
mod chip;
mod command;
mod common;
mod controller_reset;
mod conversation;
mod disruption;
mod disturb;
mod full_load;
mod gateway;
mod hostile;
mod live_bus;
mod sending_spares_capture;
mod slcan;
mod sof;
mod start;
mod stops;
mod transmission;
mod truth;
mod usb;
mod usb_flow;
mod usb_requests;
mod usbip;
