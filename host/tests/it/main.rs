//! Every integration test of this crate, in one program: each program is linked on its own.

mod autobaud;
mod device;
mod examples;
mod fake_device;
mod intervals;
mod listener;
mod misbehaving_devices;
mod replay;
mod several_devices;
