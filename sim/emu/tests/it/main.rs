//! Every integration test of this crate, in one program: each program is linked on its own.

mod assembly;
mod can_bus;
mod it_blocks;
mod pins;
mod waits;
