#![doc = include_str!("../README.md")]
//!
//! [`Board`] holds the board and lets clients in. Each has a queue of its own: one that is slow loses frames, which are counted at the stage
//! `host` in its own stream, and holds up neither the board nor anybody else. What each may do is a [`Role`]; nothing is sent and
//! nothing acknowledged while no client that may send has a channel open for it.

#![forbid(unsafe_code)]

mod board;
mod client;
pub mod connect;
mod flow;
mod inbox;
pub mod lines;
pub mod listen;
mod news;
mod outbox;
mod shared;
pub mod socketcand;
mod state;
mod stream;
mod text;
#[cfg(feature = "tls")]
pub mod tls;
mod writer;

pub use board::{Board, BoardError, Connect, ConnectError};
pub use cantap_wire::message::Role;
pub use news::News;
pub use shared::{Refused, Settings};
