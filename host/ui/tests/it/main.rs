//! The server as a browser meets it, with a virtual device behind it.

mod attack;
mod client;
mod hosted;
mod live;
mod recording;
mod sending;
mod trace_file;
