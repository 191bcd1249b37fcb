//! The device of a command that uses a single one.

use cantap_address::{Address, OpenDevice};
use cantap_work::boards::the_one_connected;

use crate::completion;

/// The device of a command that uses a single one; commands flatten this into their arguments.
#[derive(clap::Args, Clone, Debug)]
pub struct OneBoard {
    /// Where the device is: a serial port, or virtual. Without it, the board that is connected, if there is one.
    #[arg(short, long, add = completion::devices())]
    device: Option<Address>,
}

impl OneBoard {
    /// Its address.
    pub fn address(&self) -> anyhow::Result<Address> {
        Ok(self.device.clone().map_or_else(the_one_connected, Ok)?)
    }

    /// Its address, if given.
    pub const fn given(&self) -> Option<&Address> {
        self.device.as_ref()
    }

    /// Begins a session with it.
    pub fn open(&self) -> anyhow::Result<OpenDevice> {
        Ok(self.address()?.open()?)
    }
}
