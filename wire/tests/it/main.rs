//! Every integration test of this crate, in one program: each program is linked on its own.

mod budget;
mod damage;
mod pinned;
mod reports;
mod samples;
mod session_end;
mod vectors;
mod worked_example;
