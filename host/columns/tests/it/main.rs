//! Every integration test of this crate, in one program: each program is linked on its own.

mod columns;
mod parquet_files;
