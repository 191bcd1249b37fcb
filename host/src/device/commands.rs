//! The requests to a device, one method each.

use cantap_wire::message::{
    ChannelConfig, DISTURBANCE_WORD, Defaults, Edges, Failures, Filter, GatewayRule, GatewayStatus, Periodic,
    Registers, Status, Trigger, TxFdFrame, TxFrame,
};
use cantap_wire::{Channel, Command, Refusal, Reply};

use super::{Device, DeviceError};
use crate::session::printable;

impl Device {
    /// The state of the device.
    pub fn status(&self) -> Result<Status, DeviceError> {
        match self.request(Command::Status)? {
            Reply::Status(status) => Ok(status),
            _ => Err(DeviceError::WrongReply),
        }
    }

    /// How often the firmware has failed since the device was powered, and the reason for the last failure.
    pub fn failures(&self) -> Result<Failures, DeviceError> {
        match self.request(Command::Failures)? {
            Reply::Failures(mut failures) => {
                printable(&mut failures.last);
                Ok(failures)
            }
            _ => Err(DeviceError::WrongReply),
        }
    }

    /// Watches a closed channel's receive pin from now on, whatever the bit rate; `None` ends it. Nothing is driven.
    pub fn measure_edges(&self, channel: Option<Channel>) -> Result<(), DeviceError> {
        self.done(Command::MeasureEdges { channel })
    }

    /// Returns what was measured since the last call. If it is [`MAX_EDGES`](cantap_wire::message::MAX_EDGES) edges, there
    /// are more.
    pub fn edges(&self) -> Result<Edges, DeviceError> {
        match self.request(Command::Edges)? {
            Reply::Edges(edges) => Ok(edges),
            _ => Err(DeviceError::WrongReply),
        }
    }

    /// The device's time, in ticks since it started.
    pub fn time(&self) -> Result<u64, DeviceError> {
        match self.request(Command::Time)? {
            Reply::Time(ticks) => Ok(ticks),
            _ => Err(DeviceError::WrongReply),
        }
    }

    /// Replaces all filters of a closed channel. Returns how many hardware banks they use and how many there
    /// are.
    pub fn set_filters(&self, channel: Channel, filters: &[Filter]) -> Result<(u8, u8), DeviceError> {
        let list = heapless::Vec::from_slice(filters).map_err(|_| DeviceError::RequestTooLong)?;
        match self.request(Command::SetFilters { channel, filters: list })? {
            Reply::Filters { banks_used, banks_total } => {
                self.settings().filters[channel.index()] = Some(filters.to_vec());
                Ok((banks_used, banks_total))
            }
            _ => Err(DeviceError::WrongReply),
        }
    }

    /// Queues frames for transmission, all or none. Returns how many places are free afterwards.
    pub fn send(&self, channel: Channel, frames: &[TxFrame]) -> Result<u16, DeviceError> {
        let frames = heapless::Vec::from_slice(frames).map_err(|_| DeviceError::RequestTooLong)?;
        match self.request(Command::Send { channel, frames })? {
            Reply::Queued { free } => Ok(free),
            _ => Err(DeviceError::WrongReply),
        }
    }

    /// Queues CAN FD frames for transmission, [`MAX_SEND_FD`](cantap_wire::message::MAX_SEND_FD) at most, all or none. Returns how many
    /// places are free afterwards. Refused ([`DeviceError::NoFd`]) by a device that sends none: see
    /// [`Hello::sends_fd`](cantap_wire::Hello::sends_fd).
    pub fn send_fd(&self, channel: Channel, frames: &[TxFdFrame]) -> Result<u16, DeviceError> {
        if !self.hello().sends_fd() {
            return Err(DeviceError::NoFd);
        }
        let frames = heapless::Vec::from_slice(frames).map_err(|_| DeviceError::RequestTooLong)?;
        match self.request(Command::SendFd { channel, frames })? {
            Reply::Queued { free } => Ok(free),
            _ => Err(DeviceError::WrongReply),
        }
    }

    /// Drops everything that is queued for transmission.
    pub fn abort(&self, channel: Channel) -> Result<(), DeviceError> {
        self.done(Command::Abort { channel })
    }

    /// Sets or clears a periodic transmission.
    pub fn set_periodic(
        &self,
        channel: Channel,
        slot: u8,
        entry: Option<Periodic>,
    ) -> Result<(), DeviceError> {
        self.done(Command::SetPeriodic { channel, slot, entry })
    }

    /// Sets or clears a reply that is sent when a matching frame is received.
    pub fn set_trigger(&self, channel: Channel, slot: u8, entry: Option<Trigger>) -> Result<(), DeviceError> {
        self.done(Command::SetTrigger { channel, slot, entry })
    }

    /// Replaces the gateway's rules for what a channel receives, [`MAX_GATEWAY_RULES`](cantap_wire::message::MAX_GATEWAY_RULES) at
    /// most. The first that matches a frame decides; one that none matches is not passed on. The gateway must not be running.
    pub fn set_gateway_rules(&self, from: Channel, rules: &[GatewayRule]) -> Result<(), DeviceError> {
        self.done(Command::SetGatewayRule { from, slot: 0, rule: None })?;
        for (slot, rule) in rules.iter().enumerate() {
            let slot = u8::try_from(slot).map_err(|_| DeviceError::RequestTooLong)?;
            self.done(Command::SetGatewayRule { from, slot, rule: Some(rule.clone()) })?;
        }
        Ok(())
    }

    /// The gateway's rules for what a channel receives.
    pub fn gateway_rules(&self, from: Channel) -> Result<Vec<GatewayRule>, DeviceError> {
        let rules = self.gateway_status(from, 0)?.rules;
        (0..rules)
            .map(|slot| match self.request(Command::GatewayRule { from, slot })? {
                Reply::GatewayRule(rule) => Ok(rule),
                _ => Err(DeviceError::WrongReply),
            })
            .collect()
    }

    /// Passes frames on between the channels, which must both be open in normal mode. Counts begin at zero.
    pub fn start_gateway(&self) -> Result<(), DeviceError> {
        self.done(Command::StartGateway)
    }

    /// Ends that. Frames that still wait are dropped, and counted as lost.
    pub fn stop_gateway(&self) -> Result<(), DeviceError> {
        self.done(Command::StopGateway)
    }

    /// What the gateway does with what a channel receives, with the counts of the rules from `first` on,
    /// [`MAX_RULE_COUNTS`](cantap_wire::message::MAX_RULE_COUNTS) at most.
    pub fn gateway_status(&self, from: Channel, first: u8) -> Result<GatewayStatus, DeviceError> {
        match self.request(Command::GatewayStatus { from, first })? {
            Reply::Gateway(status) => Ok(status),
            _ => Err(DeviceError::WrongReply),
        }
    }

    /// Stores what [`Self::save_defaults`] does, and the gateway's rules: from its next start on, the device opens both channels and
    /// runs the gateway on its own. Both channels must be closed, and configured for normal mode.
    pub fn save_gateway(&self) -> Result<(), DeviceError> {
        self.done(Command::SaveGateway)
    }

    /// Permits [`Self::disturb`] until the session ends. Only a board built for it does ([`Hello::disturbs`](cantap_wire::Hello::disturbs)).
    pub fn unlock_disturbances(&self) -> Result<(), DeviceError> {
        self.done(Command::UnlockDisturbance { word: DISTURBANCE_WORD })
    }

    /// Drives a bus dominant for this many bits (1 to 12) from the device time `at_ticks` on, so that an error frame arises. The channel must
    /// be open in normal mode. Recorded as [`TraceEvent::Disturbed`](crate::TraceEvent::Disturbed); at most one in 10 ms.
    pub fn disturb(&self, channel: Channel, at_ticks: u64, bits: u8) -> Result<(), DeviceError> {
        self.done(Command::Disturb { channel, at_ticks, bits })
    }

    /// The controller's registers.
    pub fn registers(&self, channel: Channel) -> Result<Registers, DeviceError> {
        match self.request(Command::Registers { channel })? {
            Reply::Registers(registers) => Ok(registers),
            _ => Err(DeviceError::WrongReply),
        }
    }

    /// Leaves bus-off when recovery is manual.
    pub fn recover(&self, channel: Channel) -> Result<(), DeviceError> {
        self.done(Command::Recover { channel })
    }

    /// Shows an LED pattern, to find the device among others.
    pub fn identify(&self, seconds: u8) -> Result<(), DeviceError> {
        self.done(Command::Identify { seconds })
    }

    /// Restarts the firmware. The port vanishes.
    pub fn reset(&self) -> Result<(), DeviceError> {
        self.done(Command::Reset)
    }

    /// Enters the chip's USB bootloader. The port vanishes.
    pub fn bootloader(&self) -> Result<(), DeviceError> {
        self.done(Command::Bootloader)
    }

    /// Gives a closed channel the configuration that [`Self::save_defaults`] stores, without opening it.
    pub fn configure(&self, channel: Channel, config: ChannelConfig) -> Result<(), DeviceError> {
        self.done(Command::Configure { channel, config })
    }

    /// What the device has stored for a channel, if anything. Nothing is opened.
    pub fn defaults(&self, channel: Channel) -> Result<Option<Defaults>, DeviceError> {
        match self.request(Command::Defaults { channel }) {
            Ok(Reply::Defaults(defaults)) => Ok(Some(defaults)),
            Err(DeviceError::Refused { refusal: Refusal::NothingSaved }) => Ok(None),
            Ok(_) => Err(DeviceError::WrongReply),
            Err(error) => Err(error),
        }
    }

    /// Stores each channel's filters and configuration of this session on the device; a channel that has none keeps what
    /// is stored.
    pub fn save_defaults(&self) -> Result<(), DeviceError> {
        self.done(Command::SaveDefaults)
    }

    /// Erases what [`Self::save_defaults`] stored.
    pub fn clear_defaults(&self) -> Result<(), DeviceError> {
        self.done(Command::ClearDefaults)
    }

    pub(super) fn done(&self, command: Command) -> Result<(), DeviceError> {
        match self.request(command)? {
            Reply::Done => Ok(()),
            _ => Err(DeviceError::WrongReply),
        }
    }
}
