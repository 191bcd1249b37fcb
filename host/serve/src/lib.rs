#![doc = include_str!("../README.md")]
//!
//! [`Board`] holds the board and admits clients. Each has its own queue: a slow client loses frames, which are counted at the stage `host`
//! in its own stream, and delays neither the board nor anybody else. What each may do is its [`Role`]; nothing is sent or acknowledged
//! unless a client that may send has a channel open for it.

#![forbid(unsafe_code)]

pub mod audit;
pub mod beacon;
mod board;
mod board_figures;
pub mod cannelloni;
pub mod cannelloni_tcp;
mod client;
pub mod connect;
#[cfg(feature = "dns-sd")]
pub mod dns_sd;
mod door;
mod feed;
mod flow;
mod foreign;
pub mod gvret;
#[cfg(unix)]
mod inherited;
mod left_out;
pub mod lines;
pub mod listen;
mod lock;
mod log_limit;
pub mod metrics;
mod modes;
mod news;
mod open_bus;
mod outbox;
mod own_frames;
mod pace;
#[cfg(unix)]
mod peer;
pub mod permissions;
mod places;
mod shared;
mod small_file;
#[cfg(unix)]
pub mod socket_file;
pub mod socketcand;
mod state;
mod stream;
mod text;
#[cfg(feature = "tls")]
pub mod tls;
mod to_send;
mod totals;
mod tunnel_bus;
mod upstream;
mod writer;

pub use board::{Board, BoardError, Connect, ConnectError};
pub use cantap_wire::message::Role;
pub use news::News;
pub use shared::{Refused, Settings};
