//! The device as a gateway between its two buses.

use std::path::Path;

use cantap::device::Device;
use cantap_work::gateway::{Counts, Named, Rules};
use serde_json::Value;

use crate::error::Error;

/// A gateway that this program has started.
pub struct Gateway {
    named: Named,
    /// What the controllers had lost before.
    began_with: [u64; 2],
}

impl Gateway {
    /// Gives the device a file's rules, and starts it.
    pub fn start(device: &Device, path: &Path) -> Result<Self, Error> {
        let rules = Rules::read(path).map_err(|error| Error::Argument(error.to_string()))?;
        rules.set(device)?;
        device.start_gateway()?;
        Ok(Self { named: Named::of_file(&rules), began_with: lost(device) })
    }

    /// What the device's gateway has done, whoever has started it.
    pub fn counts(of: Option<&Self>, device: &Device) -> Result<Value, Error> {
        let found;
        let (named, began_with) = if let Some(own) = of {
            (&own.named, own.began_with)
        } else {
            found = Named::of_device(device)?;
            (&found, [0; 2])
        };
        let now = lost(device);
        let missed = [0, 1].map(|at| now[at].saturating_sub(began_with[at]));
        Ok(Counts::of(device, named)?.object(named, missed))
    }
}

fn lost(device: &Device) -> [u64; 2] {
    device.counters().channels.map(|channel| channel.lost_controller)
}
