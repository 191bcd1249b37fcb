//! What a run sends through: a device that is its own, or the one who has it.

use std::time::{Duration, Instant};

use cantap::Device;
use cantap::device::Transmission;
use cantap::transmit::Stream;
use cantap::wire::message::{Periodic, Trigger};
use cantap_can::{Channel, Frame};

use super::settings::LiveError;

/// The longest wait for room in the device's queue.
const PATIENCE: Duration = Duration::from_secs(1);

/// The way to a device. `of` is the place of the script on whose behalf it is.
pub(super) trait Port {
    /// A frame to be sent once. Returns its tag, or none if there is no room.
    fn push(&mut self, of: usize, channel: Channel, frame: Frame) -> Result<Option<u32>, LiveError>;

    /// Hands over what was pushed.
    fn flush(&mut self) -> Result<(), LiveError>;

    /// How transmissions have ended since the last call, in the device's order.
    fn take_ended(&mut self) -> Result<Vec<Transmission>, LiveError>;

    /// Takes a periodic entry for the scripts, unless somebody else has it.
    fn claim(&self, channel: Channel, slot: u8) -> bool;

    /// Whether the entry of this tag is that of whoever has the device.
    fn is_of_owner(&self, channel: Channel, tag: u32) -> bool;

    /// Sets or clears a periodic entry.
    fn set_periodic(
        &mut self,
        of: usize,
        channel: Channel,
        slot: u8,
        entry: Option<Periodic>,
    ) -> Result<(), LiveError>;

    /// Sets or clears a reply.
    fn set_reply(&mut self, channel: Channel, slot: u8, entry: Option<Trigger>) -> Result<(), LiveError>;

    /// Waits for what is under way, at most this long.
    fn finish(&mut self, at_most: Duration) -> Result<(), LiveError>;

    /// Takes back what is not on the bus yet.
    fn abort(&mut self, channel: Channel) -> Result<(), LiveError>;
}

/// A device on which the scripts are alone.
pub(super) struct Direct<'d> {
    device: &'d Device,
    stream: Stream<'d>,
}

impl<'d> Direct<'d> {
    pub(super) fn new(device: &'d Device) -> Self {
        Self { device, stream: Stream::new(device) }
    }
}

impl Port for Direct<'_> {
    fn push(&mut self, _: usize, channel: Channel, frame: Frame) -> Result<Option<u32>, LiveError> {
        let began = Instant::now();
        Ok(self.stream.push(channel, frame, None, |_| began.elapsed() < PATIENCE)?)
    }

    fn flush(&mut self) -> Result<(), LiveError> {
        Ok(self.stream.flush()?)
    }

    fn take_ended(&mut self) -> Result<Vec<Transmission>, LiveError> {
        self.stream.wait(Duration::ZERO)?;
        Ok(self.stream.take_ended())
    }

    fn claim(&self, _: Channel, _: u8) -> bool {
        true
    }

    fn is_of_owner(&self, _: Channel, _: u32) -> bool {
        false
    }

    fn set_periodic(
        &mut self,
        _: usize,
        channel: Channel,
        slot: u8,
        entry: Option<Periodic>,
    ) -> Result<(), LiveError> {
        Ok(self.device.set_periodic(channel, slot, entry)?)
    }

    fn set_reply(&mut self, channel: Channel, slot: u8, entry: Option<Trigger>) -> Result<(), LiveError> {
        Ok(self.device.set_trigger(channel, slot, entry)?)
    }

    fn finish(&mut self, at_most: Duration) -> Result<(), LiveError> {
        let began = Instant::now();
        self.stream.finish(|_| began.elapsed() < at_most)?;
        Ok(())
    }

    fn abort(&mut self, channel: Channel) -> Result<(), LiveError> {
        Ok(self.device.abort(channel)?)
    }
}
