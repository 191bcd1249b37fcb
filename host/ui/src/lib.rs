#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]

mod access;
mod backlog;
mod bus;
mod connections;
mod device;
mod entrance;
mod head;
mod orders;
mod people;
mod recorder;
mod request;
mod sender;
mod server;
mod session;
mod shared;
mod site;
mod state;
mod stream;
mod vehicle;
mod visits;

pub use device::{Device, Hosted};
pub use people::{People, Person};
pub use server::{Server, Source, Stopper};
pub use site::{Site, SiteError};
pub use stream::Stream;
pub use visits::{Visit, Visits};
