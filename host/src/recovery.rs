//! Brings channels back on the bus some time after they went bus-off, if their configuration leaves that to the host.
//!
//! It corresponds to SocketCAN's `restart-ms`: it takes longer than the controller's own recovery (128 times 11 recessive
//! bits), so that a broken node does not come back every few milliseconds.

use std::time::{Duration, Instant};

use cantap_wire::record::ErrorState;
use cantap_wire::{CHANNELS, Channel, Refusal};

use crate::{Device, DeviceError};

/// How often to ask the device.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// A channel that was asked to come back does so after 128 times 11 recessive bits, 0.3 s at 5 kbit/s on a quiet bus. If it is
/// still bus-off after this long, or again, it is asked once more.
const COMES_WITHIN: Duration = Duration::from_secs(1);

/// A channel that is bus-off.
#[derive(Clone, Copy, Debug)]
enum Off {
    /// Left alone since this moment.
    Since(Instant),
    /// Asked to come back at this moment.
    Told(Instant),
}

/// Looks after open channels with manual recovery.
#[derive(Clone, Debug)]
pub struct Recovery {
    after: Duration,
    off: [Option<Off>; CHANNELS],
    look_at: Instant,
}

impl Recovery {
    /// Channels come back this long after they went bus-off.
    pub fn new(after: Duration) -> Self {
        Self { after, off: [None; CHANNELS], look_at: Instant::now() }
    }

    /// Asks the device on the next call, however soon that is: something suggests that a channel went
    /// bus-off.
    pub fn hurry(&mut self) {
        self.look_at = Instant::now();
    }

    /// Whether a channel is bus-off and will be brought back; frames sent on it in the meantime fail.
    pub fn is_waiting(&self) -> bool {
        self.off.iter().any(Option::is_some)
    }

    /// Call this repeatedly: it asks the device now and then, and recovers channels that have been off for long
    /// enough. Returns the channels that are back.
    pub fn look(&mut self, device: &Device) -> Result<Vec<Channel>, DeviceError> {
        let now = Instant::now();
        let mut recovered = Vec::new();
        if now < self.look_at {
            return Ok(recovered);
        }
        self.look_at = now + LOOK_EVERY;
        let status = device.status()?;
        for channel in Channel::ALL {
            let state = &status.channels[channel.index()];
            let off = &mut self.off[channel.index()];
            let is_off =
                state.state == ErrorState::BusOff && state.open.is_some_and(|config| config.manual_recovery);
            if !is_off {
                if let Some(Off::Told(_)) = off.take() {
                    recovered.push(channel);
                }
                continue;
            }
            let is_time = match *off.get_or_insert(Off::Since(now)) {
                Off::Since(since) => now.duration_since(since) >= self.after,
                Off::Told(told) => now.duration_since(told) >= self.after.max(COMES_WITHIN),
            };
            if is_time {
                *off = Some(Off::Told(now));
                match device.recover(channel) {
                    Ok(())
                    | Err(DeviceError::Refused { refusal: Refusal::NotBusOff | Refusal::ChannelClosed }) => {}
                    Err(error) => return Err(error),
                }
            }
        }
        Ok(recovered)
    }
}
