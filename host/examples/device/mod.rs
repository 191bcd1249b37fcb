//! The device that the examples talk to.

use cantap::{Device, DeviceError};

/// Opens the port named on the command line; without one, a virtual device with these options.
pub fn chosen(options: &str) -> Result<Device, DeviceError> {
    match std::env::args().nth(1) {
        Some(port) => Device::open(&port),
        None => cantap_virtual::open(options.parse().expect("the example's own options")),
    }
}
