//! Rejects impossible statements of a device about itself. Times, loads and bit rates are computed from them, so none of
//! those could be right.

use cantap_wire::message::ChannelConfig;
use cantap_wire::{BitTiming, Hello, Reply};

use super::error::DeviceError;

/// No device has a slower clock: a tick is a microsecond at most, and so is the shortest bit.
const LEAST_CLOCK_HZ: u32 = 1_000_000;

/// Returns the answer if it is possible.
pub fn believe(reply: Reply) -> Result<Reply, DeviceError> {
    let is_wrong = |config: &ChannelConfig| !config.timing.is_valid() && config.timing != BitTiming::UNKNOWN;
    let what = match &reply {
        Reply::Hello(Hello { tick_hz: hz @ ..LEAST_CLOCK_HZ, .. }) => format!("its clock ticks at {hz} Hz"),
        Reply::Hello(Hello { can_clock_hz: hz @ ..LEAST_CLOCK_HZ, .. }) => {
            format!("its CAN controllers' clock is {hz} Hz")
        }
        Reply::Opened(config) if is_wrong(config) => NO_TIMING.to_owned(),
        Reply::Defaults(defaults) if is_wrong(&defaults.config) => NO_TIMING.to_owned(),
        Reply::Status(status)
            if status.channels.iter().filter_map(|channel| channel.open.as_ref()).any(is_wrong) =>
        {
            NO_TIMING.to_owned()
        }
        _ => return Ok(reply),
    };
    Err(DeviceError::Impossible { what })
}

const NO_TIMING: &str = "a channel has a bit timing that is out of its controller's range";
