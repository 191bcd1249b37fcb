//! Measuring and calibrating: XCP and its predecessor CCP, as far as they are alike.

pub(crate) mod connection;
mod connections;
pub(crate) mod finding;
pub(crate) mod known;
pub(crate) mod lists;
pub mod parts;

pub use connection::{BadMasterSlave, MasterSlave};
pub(crate) use connections::Connection;
pub use connections::Connections;
pub use known::Known;
pub use parts::ByteOrder;
