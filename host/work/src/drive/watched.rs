//! A client that runs while a drive watches our heartbeat.

use cantap_protocols::active::Machine;
use cantap_protocols::active::heartbeat::{HeartbeatProducer, WithHeartbeat};

use crate::speaking::Speaking;

/// An entry of the drive's, and what it was before.
#[derive(Clone, Copy, Debug)]
pub struct Guarded {
    /// Its sub-index in object 1016.
    pub sub: u8,
    /// Its value.
    pub before: u32,
}

/// Runs a client, with our heartbeat beside it if it is watched.
pub fn run(
    speaking: &mut Speaking<'_>,
    heartbeat: Option<&mut HeartbeatProducer>,
    client: &mut dyn Machine,
    is_last: bool,
) -> anyhow::Result<()> {
    let mut both;
    let machine: &mut dyn Machine = match heartbeat {
        Some(heartbeat) => {
            both = WithHeartbeat::new(client, heartbeat);
            &mut both
        }
        None => client,
    };
    if is_last { speaking.run_last(machine) } else { speaking.run(machine) }
}
