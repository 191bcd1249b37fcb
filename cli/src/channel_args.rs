//! How a channel is opened: the options of every command that opens one.

use cantap::Channel;
use cantap::wire::message::{ChannelConfig, Mode};
use cantap_address::OpenDevice;
use cantap_trace::filter::Filter;
use cantap_work::bus_off::BusOffRecovery;
use cantap_work::channel_options::{ChannelOptions, RecoveryOption};

use crate::args;
use crate::stderr;
use crate::timing_args::TimingArgs;

/// How to open a channel; commands flatten this into their arguments.
#[derive(clap::Args, Clone, Debug, Default)]
pub struct ChannelArgs {
    #[command(flatten)]
    timing: TimingArgs,
    /// How to take part in the bus.
    #[arg(long, value_enum)]
    mode: Option<ModeArg>,
    /// Send each frame once: no retransmission after an error or lost arbitration.
    #[arg(long)]
    one_shot: bool,
    /// How to leave bus-off: auto, by the controller itself (the default); manual, not at all while the command runs; or
    /// after a time, such as 100ms.
    #[arg(long, value_name = "auto|manual|TIME", value_parser = recovery)]
    recovery: Option<RecoveryOption>,
    /// Leave data bytes out of the stream, to save bandwidth: files contain zeros instead.
    #[arg(long)]
    no_data: bool,
    /// Leave time stamps out of the stream, to save bandwidth: times are only upper bounds.
    #[arg(long)]
    no_stamps: bool,
}

/// How to take part in a bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum ModeArg {
    /// Send nothing, acknowledge nothing.
    #[value(name = "listen-only", alias = "listen")]
    ListenOnly,
    /// Acknowledge and send.
    Normal,
    /// Receive only what is sent from here; the bus sees it too.
    Loopback,
    /// Receive only what is sent from here; the bus sees nothing.
    SilentLoopback,
}

/// How to leave bus-off.
pub fn recovery(text: &str) -> Result<RecoveryOption, String> {
    match text {
        "auto" => Ok(RecoveryOption::Auto),
        "manual" => Ok(RecoveryOption::Manual),
        _ => args::duration(text)
            .map(RecoveryOption::After)
            .map_err(|_| "write auto, manual, or a time, such as 100ms".to_owned()),
    }
}

impl From<ModeArg> for Mode {
    fn from(mode: ModeArg) -> Self {
        match mode {
            ModeArg::ListenOnly => Self::ListenOnly,
            ModeArg::Normal => Self::Normal,
            ModeArg::Loopback => Self::Loopback,
            ModeArg::SilentLoopback => Self::SilentLoopback,
        }
    }
}

impl ChannelArgs {
    /// The same without clap.
    pub fn options(&self) -> ChannelOptions {
        let Self { timing, mode, one_shot, recovery, no_data, no_stamps } = self;
        ChannelOptions {
            timing: timing.options(),
            mode: mode.map(Mode::from),
            one_shot: *one_shot,
            recovery: *recovery,
            no_data: *no_data,
            no_stamps: *no_stamps,
            device_intervals: false,
            board: 0,
        }
    }

    /// The first option that was given and is about a device; a bit rate may be a trace's, too.
    pub fn given(&self) -> Option<&'static str> {
        let given = [
            (self.mode.is_some(), "--mode"),
            (self.one_shot, "--one-shot"),
            (self.recovery.is_some(), "--recovery"),
            (self.no_data, "--no-data"),
            (self.no_stamps, "--no-stamps"),
        ];
        given.into_iter().find_map(|(given, option)| given.then_some(option)).or(self.timing.given())
    }

    /// See [`ChannelOptions::bus_off_recovery`]; it reports on standard error.
    pub fn bus_off_recovery(&self) -> BusOffRecovery {
        self.options().bus_off_recovery(&stderr::reporter())
    }

    /// See [`ChannelOptions::open`]; it reports on standard error.
    pub fn open(
        &self,
        device: &OpenDevice,
        channels: impl Iterator<Item = Channel>,
        mode: Mode,
        filters: Option<&[Filter]>,
    ) -> anyhow::Result<Vec<(Channel, ChannelConfig)>> {
        self.options().open(device, channels, mode, filters, &stderr::reporter())
    }
}
