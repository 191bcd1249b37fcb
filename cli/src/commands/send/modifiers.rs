//! What changes in a periodic frame each time: counters, random bytes, checksums.

use cantap::wire::message::{MAX_MODIFIERS, Modifier};
use cantap_work::gateway::{checksum, counter};

use crate::usage_error::usage;

/// The modifiers; applied in this order, so that a checksum covers the others.
#[derive(clap::Args)]
pub struct ModifierArgs {
    /// Count up in a byte of the data (from 0), or in some of its bits: BYTE or BYTE.LOWBIT:BITS, such as 7.0:4.
    #[arg(long, value_name = "BYTE[.BIT:BITS]", value_parser = counter, requires = "period", conflicts_with_all = ["on_rx", "reply"])]
    counter: Vec<Modifier>,
    /// Put a new random value into a byte.
    #[arg(long, value_name = "BYTE", requires = "period", conflicts_with_all = ["on_rx", "reply"])]
    random: Vec<u8>,
    /// Put a checksum over the other bytes into a byte: xor, sum, or crc8 (SAE-J1850).
    #[arg(long, value_name = "BYTE:KIND", value_parser = checksum, requires = "period", conflicts_with_all = ["on_rx", "reply"])]
    checksum: Vec<Modifier>,
}

/// What changes in a frame.
pub type Modifiers = heapless::Vec<Modifier, MAX_MODIFIERS>;

impl ModifierArgs {
    /// All of them.
    pub fn list(&self) -> anyhow::Result<Modifiers> {
        let random = self.random.iter().map(|byte| Modifier::Random { byte: *byte });
        let mut list = Modifiers::new();
        for modifier in self.counter.iter().copied().chain(random).chain(self.checksum.iter().copied()) {
            if list.push(modifier).is_err() {
                return Err(usage(format!(
                    "a frame takes {MAX_MODIFIERS} modifiers; give fewer of --counter, --random, --checksum"
                )));
            }
        }
        Ok(list)
    }
}
