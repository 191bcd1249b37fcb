//! What an address of an adapter with its maker's library asks for.

use std::path::PathBuf;

/// What stands behind the channel.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct MakerOptions {
    /// The bit rate of CAN FD's data phases, in bit/s; without it CAN FD stays off.
    pub data_bitrate_bps: Option<u32>,
    /// The library, if not the system's.
    pub library: Option<PathBuf>,
}
