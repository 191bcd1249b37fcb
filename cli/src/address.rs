//! Where a device is, as users type it after `-d`: `cantap-address` knows.

pub use cantap_address::{Address, AddressError, OpenDevice};
