//! How a channel is opened.

use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use cantap::Channel;
use cantap::autobaud::{Limits, Outcome};
use cantap::device::channel_number;
use cantap::hw_filter::{self, Compiled};
use cantap::recovery::Recovery;
use cantap::wire::BitTiming;
use cantap::wire::message::{ChannelConfig, Defaults, Mode, capability};
use cantap_address::OpenDevice;
use cantap_trace::filter::Filter;

use crate::bit_rate_search::{self, Search};
use crate::bus_off::BusOffRecovery;
use crate::interrupt;
use crate::report::Reporter;
use crate::requested_rate::RequestedRate;
use crate::timing_options::TimingOptions;

/// How to open a channel, as far as it is given.
#[derive(Clone, Debug, Default)]
pub struct ChannelOptions {
    /// Its bit timing; without one, the one saved on the device.
    pub timing: TimingOptions,
    /// How to take part in the bus.
    pub mode: Option<Mode>,
    /// Send each frame once: no retransmission after an error or lost arbitration.
    pub one_shot: bool,
    /// How to leave bus-off.
    pub recovery: Option<RecoveryOption>,
    /// Leave data bytes out of the stream.
    pub no_data: bool,
    /// Leave time stamps out of the stream.
    pub no_stamps: bool,
    /// Keep the device's own intervals between times, instead of following UTC.
    pub device_intervals: bool,
    /// Which of several boards this is for, from 0: messages name its channels' numbers.
    pub board: usize,
}

/// How to leave bus-off.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RecoveryOption {
    /// After 128 times 11 recessive bits, by the controller itself.
    Auto,
    /// Never.
    Manual,
    /// This long after it went bus-off, by this program.
    After(Duration),
}

/// How long to wait for traffic on one of several channels whose bit rates are to be found: often only one of them is
/// connected.
const PATIENCE_OF_SEVERAL: Duration = Duration::from_secs(3);

/// The settings for opening a channel.
struct Plan {
    channel: Channel,
    config: ChannelConfig,
    /// What is saved on the device, if that is used.
    saved: Option<Defaults>,
}

impl ChannelOptions {
    /// Only listening, at these bit rates; without any, with what is saved on the device.
    pub fn listening(bitrates: impl IntoIterator<Item = impl Into<RequestedRate>>) -> Self {
        let mut options = Self::default();
        options.timing.set_bit_rates(bitrates);
        options
    }

    /// The part for one of several boards, counted from 0, whose channels have their own numbers there.
    #[must_use]
    pub fn on_board(&self, board: usize) -> Self {
        Self { timing: self.timing.on_board(board), board, ..self.clone() }
    }

    /// The channel's number for users.
    const fn number(&self, channel: Channel) -> u8 {
        channel_number(self.board, channel)
    }

    /// Whether any option is given.
    pub fn is_given(&self) -> bool {
        let Self { timing, mode, one_shot, recovery, no_data, no_stamps, device_intervals: _, board: _ } =
            self;
        timing.is_given_in_part()
            || mode.is_some()
            || recovery.is_some()
            || [one_shot, no_data, no_stamps].into_iter().any(|flag| *flag)
    }

    /// Brings channels back from bus-off, if the user requested that, and reports it.
    pub fn bus_off_recovery(&self, reporter: &Reporter) -> BusOffRecovery {
        BusOffRecovery::new(self.recovery(), reporter.clone())
    }

    /// Brings channels back from bus-off if the user requested that; for callers that report it in their own
    /// way.
    pub fn recovery(&self) -> Option<Recovery> {
        match self.recovery {
            Some(RecoveryOption::After(time)) => Some(Recovery::new(time)),
            _ => None,
        }
    }

    /// Opens channels, with `mode` unless the user requested another, and returns how they were opened. Anything
    /// impossible is detected before the first one is opened. Commands that receive pass their filters; with none, those
    /// saved on the device apply. Reports which filters the hardware could not take, that saved ones apply, and which bit
    /// rates were found by listening. Of several channels of a command that receives, those on which none is found are left out, unless
    /// their bit rate was requested to be found by channel.
    pub fn open(
        &self,
        device: &OpenDevice,
        channels: impl Iterator<Item = Channel>,
        mode: Mode,
        filters: Option<&[Filter]>,
        reporter: &Reporter,
    ) -> anyhow::Result<Vec<(Channel, ChannelConfig)>> {
        let leaves_out = filters.is_some() && !self.mode.unwrap_or(mode).transmits();
        let plans = self.plan(device, channels, Some(mode), leaves_out, reporter)?;
        if self.device_intervals {
            device.keep_intervals();
        }
        // A channel's filters can be changed only while both channels are closed.
        for Plan { channel, saved, .. } in &plans {
            match (filters, saved) {
                (Some(filters), _) if !filters.is_empty() => {
                    if let Some(remainder) = hw_filter::apply(device, *channel, filters)?.remainder {
                        reporter.note(format!("channel {}: {remainder}", self.number(*channel)));
                    }
                }
                (Some(_), Some(saved)) if !saved.filters.is_empty() => {
                    device.set_filters(*channel, &saved.filters)?;
                    let (number, count) = (self.number(*channel), saved.filters.len());
                    reporter.note(format!("channel {number}: only what its {count} saved filters accept"));
                }
                _ => {}
            }
        }
        for Plan { channel, config, .. } in &plans {
            device
                .open_channel(*channel, Some(*config))
                .with_context(|| format!("channel {}", self.number(*channel)))?;
        }
        Ok(plans.into_iter().map(|plan| (plan.channel, plan.config)).collect())
    }

    /// How channels would be opened, with `mode` unless the user requested another. Nothing stays open; bit rates are found by
    /// listening, which is reported.
    pub fn configs(
        &self,
        device: &OpenDevice,
        channels: impl IntoIterator<Item = Channel>,
        mode: Mode,
        reporter: &Reporter,
    ) -> anyhow::Result<Vec<(Channel, ChannelConfig)>> {
        let plans = self.plan(device, channels.into_iter(), Some(mode), false, reporter)?;
        Ok(plans.into_iter().map(|plan| (plan.channel, plan.config)).collect())
    }

    /// Gives closed channels the requested configuration and filters, without opening them: what
    /// [`cantap::Device::save_defaults`] stores. Anything not requested stays as it was saved before.
    pub fn configure(
        &self,
        device: &OpenDevice,
        channels: impl Iterator<Item = Channel>,
        filters: &[Filter],
        reporter: &Reporter,
    ) -> anyhow::Result<()> {
        for Plan { channel, config, saved } in self.plan(device, channels, None, false, reporter)? {
            let number = self.number(channel);
            let kept = saved.filter(|_| filters.is_empty()).map(|saved| saved.filters).unwrap_or_default();
            let filters = match hw_filter::compile(filters, channel) {
                Compiled { remainder: Some(remainder), .. } => bail!(
                    "channel {number}: {remainder}, which cannot be saved; give filters that the hardware knows"
                ),
                Compiled { hardware, .. } if !hardware.is_empty() => hardware,
                Compiled { .. } => kept.to_vec(),
            };
            device.set_filters(channel, &filters).with_context(|| format!("channel {number}"))?;
            device.configure(channel, config).with_context(|| format!("channel {number}"))?;
        }
        Ok(())
    }

    fn plan(
        &self,
        device: &OpenDevice,
        channels: impl Iterator<Item = Channel>,
        mode: Option<Mode>,
        leaves_out: bool,
        reporter: &Reporter,
    ) -> anyhow::Result<Vec<Plan>> {
        // Other makers' adapters often have a single channel; who asks for that alone learns so when it is opened.
        let is_there = |channel: &Channel| channel.number() <= device.hello().channels;
        let (there, missing): (Vec<_>, Vec<_>) = channels.partition(is_there);
        let used = if there.is_empty() { &missing } else { &there };
        let leaves_out = leaves_out && used.len() > 1;
        let mut plans = Vec::new();
        let mut reasons = Vec::new();
        for &channel in used {
            let found_bps = if self.timing.is_auto(channel.number()) {
                match self.find_bit_rate(device, channel, used.len() > 1, reporter)? {
                    Ok(bitrate_bps) => Some(bitrate_bps),
                    Err(reason) if leaves_out && !self.is_auto_by_name(channel) => {
                        reasons.push(reason);
                        continue;
                    }
                    Err(reason) => bail!(reason),
                }
            } else {
                None
            };
            plans.push(self.plan_one(device, channel, mode, found_bps)?);
        }
        if plans.is_empty() && !reasons.is_empty() {
            bail!(reasons.join("; "));
        }
        for reason in reasons {
            reporter.warn(format!("{reason}; the channel is left out"));
        }
        Ok(plans)
    }

    /// Whether a channel's bit rate is to be found because the user named this channel.
    fn is_auto_by_name(&self, channel: Channel) -> bool {
        let of_channel = RequestedRate::of(&self.timing.bitrates, channel.number());
        of_channel.is_some_and(|rate| rate.is_auto() && rate.channel.is_some())
    }

    /// The bit rate of a channel's bus, in bit/s, found by listening; otherwise the reason why there is none. Reports what is going on.
    fn find_bit_rate(
        &self,
        device: &OpenDevice,
        channel: Channel,
        is_one_of_several: bool,
        reporter: &Reporter,
    ) -> anyhow::Result<Result<u32, String>> {
        let number = self.number(channel);
        if !bit_rate_search::is_possible(device) {
            bail!(
                "channel {number}: this device cannot find a bit rate by listening; give it with -b RATE, such as -b 500k{}",
                if device.hello().capabilities & capability::NO_BIT_RATE == 0 {
                    ""
                } else {
                    ", or leave out -b"
                }
            );
        }
        reporter.note(format!("channel {number}: listening for its bit rate"));
        let mut limits = Limits::default();
        if is_one_of_several {
            limits.silence = PATIENCE_OF_SEVERAL;
        }
        let started = Instant::now();
        let found = bit_rate_search::search(device, channel, &limits, &mut |_| !interrupt::requested())
            .with_context(|| format!("channel {number}"))?;
        Ok(match found {
            Search::Confirmed { bitrate_bps } => {
                reporter.note(format!("channel {number}: {bitrate_bps} bit/s, as the last time"));
                Ok(bitrate_bps)
            }
            Search::Measured(Outcome::Found { bitrate_bps, .. }) => {
                reporter.note(format!("channel {number}: {bitrate_bps} bit/s, found by listening"));
                Ok(bitrate_bps)
            }
            Search::Measured(Outcome::Stopped) => bail!("stopped before a bit rate was found"),
            Search::Measured(outcome) => {
                Err(bit_rate_search::failure(outcome, number, started.elapsed().as_secs_f64()))
            }
        })
    }

    /// The requested configuration, with the bit rate that was found, in bit/s, if it was to be found; without bit timing, the one saved on the device. The mode is the user's, otherwise `mode`,
    /// otherwise the saved one.
    fn plan_one(
        &self,
        device: &OpenDevice,
        channel: Channel,
        mode: Option<Mode>,
        found_bps: Option<u32>,
    ) -> anyhow::Result<Plan> {
        let (base, saved) = match self.timing.request_with(channel, found_bps)? {
            Some(request) => {
                (ChannelConfig::listen_only(request.resolve(device.hello().can_clock_hz)?), None)
            }
            None => match (device.defaults(channel)?, device.bitrate_of_bus(channel)) {
                (Some(saved), _) => (saved.config, Some(saved)),
                (None, Some(bitrate_bps)) => (ChannelConfig::listen_only(device.timing(bitrate_bps)?), None),
                // Nothing but figures needs it.
                (None, None) if device.hello().capabilities & capability::NO_BIT_RATE != 0 => {
                    (ChannelConfig::listen_only(BitTiming::UNKNOWN), None)
                }
                (None, None) => bail!(
                    "no bit rate for channel {}: give one with -b RATE, have it found with -b auto, or save one \
                     with `cantap defaults save`",
                    self.number(channel)
                ),
            },
        };
        let bitrate_bps = base.timing.known_bitrate_bps(device.hello().can_clock_hz);
        if let Some(reason) = bitrate_bps.and_then(|bitrate_bps| device.rate_conflict(bitrate_bps)) {
            bail!("{reason}");
        }
        let config = ChannelConfig {
            mode: self.mode.or(mode).unwrap_or(base.mode),
            one_shot: base.one_shot || self.one_shot,
            manual_recovery: self
                .recovery
                .map_or(base.manual_recovery, |recovery| recovery != RecoveryOption::Auto),
            omit_data: base.omit_data || self.no_data,
            omit_stamps: base.omit_stamps || self.no_stamps,
            ..base
        };
        Ok(Plan { channel, config, saved })
    }
}

/// A description of how a channel is open.
pub fn description(config: &ChannelConfig, can_clock_hz: u32) -> String {
    let mode = match config.mode {
        Mode::ListenOnly => "listening only",
        Mode::Normal => "taking part",
        Mode::Loopback => "in loopback",
        Mode::SilentLoopback => "in silent loopback",
    };
    match config.timing.known_bitrate_bps(can_clock_hz) {
        Some(bitrate_bps) => format!("{bitrate_bps} bit/s, {mode}"),
        None => format!("bit rate not known, {mode}"),
    }
}
