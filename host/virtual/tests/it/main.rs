//! Every integration test of this crate, in one program: each program is linked on its own.

mod reference_clients;
mod virtual_device;
mod virtual_terminal;
