//! The device that an example talks to.

use cantap::{Device, DeviceError};

/// The one at the port that the command line names; without one a virtual device with these options.
pub fn chosen(options: &str) -> Result<Device, DeviceError> {
    match std::env::args().nth(1) {
        Some(port) => Device::open(&port),
        None => cantap_virtual::open(options.parse().expect("the example's own options")),
    }
}
