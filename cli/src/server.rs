//! Where a server is that shares a board: `cantap-address` knows.

pub use cantap_address::server::{PORT, role};
