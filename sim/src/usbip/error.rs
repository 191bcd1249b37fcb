//! What ends the server, apart from a request to quit.

use std::io;

use cantap_emu::stop::Stopped;

/// Why serving ended.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The firmware ended.
    #[error("{0}")]
    Stopped(#[from] Stopped),
    /// A socket or the folder failed.
    #[error("{0}")]
    Io(#[from] io::Error),
    /// Nothing came up on the port.
    #[error("the device does not show its descriptors")]
    NoDevice,
    /// What came up is not a device.
    #[error("descriptors of {device} and {configuration} bytes")]
    Descriptors {
        /// Bytes of the device descriptor.
        device: usize,
        /// Bytes of the configuration.
        configuration: usize,
    },
}
