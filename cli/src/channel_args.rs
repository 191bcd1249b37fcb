//! How a channel is opened; the same options in every command that opens one.

use anyhow::{Context, bail};
use cantap::bit_timing::TimingRequest;
use cantap::filter::Filter;
use cantap::wire::message::{ChannelConfig, Mode};
use cantap::wire::{Command, Refusal, Reply};
use cantap::{Address, Channel, Device, DeviceError, hw_filter};

use crate::timing_args::TimingArgs;

/// Bit rate of a virtual bus where none was given: its simulated nodes take any.
const VIRTUAL_BITRATE_BPS: u32 = 500_000;

/// How to open a channel; for commands to flatten into theirs.
#[derive(clap::Args, Clone)]
pub struct ChannelArgs {
    #[command(flatten)]
    pub timing: TimingArgs,
    /// How to take part in the bus.
    #[arg(long, value_enum)]
    mode: Option<ModeArg>,
    /// Send each frame once: no retransmission after an error or lost arbitration.
    #[arg(long)]
    one_shot: bool,
    /// How to leave bus-off: by the controller itself, or only when asked.
    #[arg(long, value_enum, default_value = "auto")]
    recovery: Recovery,
    /// Leave data bytes out of the stream, to save bandwidth.
    #[arg(long)]
    no_data: bool,
    /// Leave time stamps out of the stream, to save bandwidth.
    #[arg(long)]
    no_stamps: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum ModeArg {
    /// Send nothing, acknowledge nothing.
    Listen,
    /// Acknowledge and send.
    Normal,
    /// Hear only what is sent from here; the bus sees it too.
    Loopback,
    /// Hear only what is sent from here; the bus sees nothing.
    SilentLoopback,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Recovery {
    /// After 128 times 11 recessive bits.
    Auto,
    /// Not before the host asks for it.
    Manual,
}

impl ChannelArgs {
    /// Opens channels, with `mode` unless the user says otherwise, and returns how. Says on standard error which
    /// filters the hardware could not take. Whatever is impossible is found before the first is opened.
    pub fn open(
        &self,
        device: &Device,
        channels: impl Iterator<Item = Channel>,
        mode: Mode,
        filters: &[Filter],
    ) -> anyhow::Result<Vec<(Channel, ChannelConfig)>> {
        let mut opened = Vec::new();
        for channel in channels {
            opened.push((channel, self.config(device, channel, mode)?));
        }
        // Filters of a channel can be changed only while both are closed.
        for (channel, _) in opened.iter().filter(|_| !filters.is_empty()) {
            if let Some(remainder) = hw_filter::apply(device, *channel, filters)?.remainder {
                eprintln!("cantap: channel {}: {remainder}", channel.number());
            }
        }
        for (channel, config) in &opened {
            device
                .open_channel(*channel, Some(*config))
                .with_context(|| format!("channel {}", channel.number()))?;
        }
        Ok(opened)
    }

    /// The configuration that was asked for; where no bit timing was, the one saved on the device.
    fn config(&self, device: &Device, channel: Channel, mode: Mode) -> anyhow::Result<ChannelConfig> {
        let is_virtual = matches!(device.name().parse(), Ok(Address::Virtual(_)));
        let request = match self.timing.request(channel)? {
            None if is_virtual => Some(TimingRequest::Rate {
                bitrate_bps: VIRTUAL_BITRATE_BPS,
                sample_point_percent: None,
                sjw: None,
            }),
            request => request,
        };
        let saved = match request {
            Some(request) => ChannelConfig::listen_only(request.resolve(device.hello().can_clock_hz)?),
            None => saved_config(device, channel)?,
        };
        let mode = match self.mode {
            None => mode,
            Some(ModeArg::Listen) => Mode::ListenOnly,
            Some(ModeArg::Normal) => Mode::Normal,
            Some(ModeArg::Loopback) => Mode::Loopback,
            Some(ModeArg::SilentLoopback) => Mode::SilentLoopback,
        };
        Ok(ChannelConfig {
            mode,
            one_shot: saved.one_shot || self.one_shot,
            manual_recovery: saved.manual_recovery || self.recovery == Recovery::Manual,
            omit_data: saved.omit_data || self.no_data,
            omit_stamps: saved.omit_stamps || self.no_stamps,
            ..saved
        })
    }
}

/// What is saved on the device. The protocol tells it by opening the channel with it, which is undone at once.
fn saved_config(device: &Device, channel: Channel) -> anyhow::Result<ChannelConfig> {
    match device.request(Command::Open { channel, config: None }) {
        Ok(Reply::Opened(config)) => {
            device.close_channel(channel)?;
            Ok(config)
        }
        Err(DeviceError::Refused { refusal: Refusal::NothingSaved }) => bail!(
            "no bit rate: give one with -b RATE, find it with `cantap autobaud`, or save one with \
             `cantap defaults save`"
        ),
        Err(error) => Err(error.into()),
        Ok(_) => Err(DeviceError::WrongReply.into()),
    }
}

/// A channel as `1`, `2`, or as an interface: `can0` is channel 1, as in every trace.
pub fn channel(text: &str) -> Result<Channel, String> {
    match text {
        "1" | "can0" => Ok(Channel::Can1),
        "2" | "can1" => Ok(Channel::Can2),
        _ => Err("write can0 or 1 for channel 1, can1 or 2 for channel 2".to_owned()),
    }
}
