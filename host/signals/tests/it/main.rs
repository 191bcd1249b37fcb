//! Every integration test of this crate, in one program: each program is linked on its own.

mod container_pdus;
mod databases_in_other_formats;
mod databases_of_other_programs;
mod dbf;
mod signal_databases;
mod signal_parsers_take_anything;
mod signals_agree_with_cantools;
mod signals_round_trip;
