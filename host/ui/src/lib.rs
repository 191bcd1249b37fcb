#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]

mod access;
mod backlog;
mod bus;
mod connections;
mod head;
mod recorder;
mod request;
mod sender;
mod server;
mod session;
mod shared;
mod site;
mod state;

pub use bus::Device;
pub use server::{Server, Source, Stopper};
pub use site::{Site, SiteError};
