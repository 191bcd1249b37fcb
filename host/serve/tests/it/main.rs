//! Every integration test of this crate, in one program: each program is linked on its own.

mod board;
mod browser;
mod cannelloni;
mod cannelloni_tcp;
mod doors;
mod eight_clients;
mod gvret;
mod hostile;
mod line;
mod metrics;
mod permissions;
mod reconnects;
mod sharing;
mod slow_clients;
mod slow_line;
mod socketcand;
mod strangers;
mod tls;
