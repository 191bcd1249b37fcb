#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]

mod access;
mod backlog;
mod bus;
mod connections;
mod device;
mod head;
mod orders;
mod recorder;
mod request;
mod sender;
mod server;
mod session;
mod shared;
mod site;
mod state;
mod visits;

pub use device::{Device, Hosted};
pub use server::{Server, Source, Stopper};
pub use site::{Site, SiteError};
pub use visits::{Visit, Visits};
