//! The gateway of a device: run from here, watched, stored and erased.

use std::io::Write;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use cantap::device::Records;
use cantap::wire::message::{ChannelConfig, GatewayEnd, GatewayState, Mode, capability};
use cantap::wire::record::TransmitFailure;
use cantap::wire::{CHANNELS, Channel};
use cantap::{Device, TraceEvent};
use cantap_address::OpenDevice;
use cantap_trace::counted;
use cantap_work::channel_options::{ChannelOptions, description};
use cantap_work::gateway::{Counts, Named, Rules};
use cantap_work::interrupt;

use super::arguments::Args;
use crate::exit;
use crate::stderr;

/// How often counts are shown.
const SHOW_EVERY: Duration = Duration::from_secs(1);
/// How often to check whether to go on.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// Why a gateway ends on its own, and what to do.
const ONE_BUS: &str =
    "both channels are on one bus: each frame that one sent, the other received; connect them to two buses";

/// Begins a session with a device that can be a gateway.
fn open(args: &Args) -> anyhow::Result<OpenDevice> {
    let device = args.device.open()?;
    if device.hello().capabilities & capability::GATEWAY == 0 {
        bail!(
            "{} cannot be a gateway: that needs a board of one's own with the current firmware (cantap update), not a \
             server's or an adapter",
            device.name()
        );
    }
    Ok(device)
}

/// The same, if it does not run a gateway already.
fn open_idle(args: &Args) -> anyhow::Result<OpenDevice> {
    let device = open(args)?;
    if device.gateway_status(Channel::Can1, 0)?.state == GatewayState::Running {
        bail!(
            "the device runs the gateway that is stored on it; `cantap gateway --show` shows it, --stop ends it, --forget erases it"
        );
    }
    Ok(device)
}

/// Both channels' configurations.
fn configs(args: &Args, device: &OpenDevice) -> anyhow::Result<Vec<(Channel, ChannelConfig)>> {
    let options = ChannelOptions { timing: args.timing.options(), ..ChannelOptions::default() };
    options.configs(device, Channel::ALL, Mode::Normal, &stderr::reporter())
}

/// Runs a file's rules until it is to end.
pub(super) fn run(args: &Args, rules: &Rules) -> anyhow::Result<ExitCode> {
    interrupt::watch()?;
    let device = open_idle(args)?;
    let configs = configs(args, &device)?;
    rules.set(&device).context("the rules")?;
    let clock_hz = device.hello().can_clock_hz;
    let both: Vec<_> = configs
        .iter()
        .map(|(channel, config)| format!("channel {} ({})", channel.number(), description(config, clock_hz)))
        .collect();
    stderr::tell(&format!(
        "cantap: acknowledges and sends on {}: {} rules; Ctrl-C ends it\n",
        both.join(" and "),
        rules.rules.len()
    ));
    let records = device.records();
    for (channel, config) in configs {
        device
            .open_channel(channel, Some(config))
            .with_context(|| format!("channel {}", channel.number()))?;
    }
    device.start_gateway().context("the gateway cannot start")?;
    Watch::new(args, &device, Named::of_file(rules), records)?.run(true)
}

/// Watches the gateway that the device runs on its own.
pub(super) fn show(args: &Args) -> anyhow::Result<ExitCode> {
    interrupt::watch()?;
    let device = open(args)?;
    let status = device.gateway_status(Channel::Can1, 0)?;
    if status.state == GatewayState::Ended(GatewayEnd::Loop) {
        bail!(
            "the gateway that is stored on the device has ended: {ONE_BUS}; `cantap reset` then starts it again, --forget erases it"
        );
    }
    if !status.standalone {
        bail!(
            "the device runs no gateway on its own; `cantap gateway RULES` starts one, with --save for each start of the device"
        );
    }
    let records = device.records();
    Watch::new(args, &device, Named::of_device(&device)?, records)?.run(false)
}

/// Stores a file's rules on the device.
pub(super) fn save(args: &Args, rules: &Rules) -> anyhow::Result<ExitCode> {
    let device = open_idle(args)?;
    for (channel, config) in configs(args, &device)? {
        device.set_filters(channel, &[])?;
        device.configure(channel, config)?;
    }
    rules.set(&device).context("the rules")?;
    device.save_gateway()?;
    writeln!(
        std::io::stdout(),
        "saved: from its next start on, the device acknowledges and sends on both buses on its own.\n\
         `cantap reset` starts it now, `cantap gateway --forget` undoes it"
    )?;
    Ok(ExitCode::SUCCESS)
}

/// Ends the gateway that the device runs on its own, and erases it if requested.
pub(super) fn stop(args: &Args) -> anyhow::Result<ExitCode> {
    let device = open(args)?;
    let runs = device.gateway_status(Channel::Can1, 0)?.standalone;
    if !runs && args.stop {
        bail!("the device runs no gateway on its own; --forget erases one that is stored but does not run");
    }
    device.stop_gateway()?;
    // Both channels leave their buses; nothing can be erased before.
    for channel in Channel::ALL {
        device.close_channel(channel)?;
    }
    let mut out = std::io::stdout().lock();
    if args.forget {
        device.clear_defaults()?;
        writeln!(out, "erased from the device, with the bit rates and filters that were stored")?;
    } else {
        writeln!(out, "stopped; it is still stored, and starts again with the device: --forget erases it")?;
    }
    Ok(ExitCode::SUCCESS)
}

/// A running gateway under observation.
struct Watch<'a> {
    args: &'a Args,
    device: &'a Device,
    named: Named,
    records: Records,
    counts: Counts,
    /// What the controllers had lost before.
    began_with: [u64; CHANNELS],
}

/// How watching has ended.
enum Ended {
    /// As requested.
    Asked,
    /// By itself.
    Gateway(GatewayState),
}

impl<'a> Watch<'a> {
    fn new(args: &'a Args, device: &'a Device, named: Named, records: Records) -> anyhow::Result<Self> {
        let counts = Counts::of(device, &named)?;
        let began_with = device.counters().channels.map(|channel| channel.lost_controller);
        Ok(Self { args, device, named, records, counts, began_with })
    }

    /// Shows counts until the end, ends a gateway of this session, and prints the totals.
    fn run(mut self, ours: bool) -> anyhow::Result<ExitCode> {
        let ended = match self.watch() {
            Ok(ended) => ended,
            Err(error) => {
                // What is known by now is not kept back.
                self.totals()?;
                return Err(error.context("the gateway's last counts are above"));
            }
        };
        if ours {
            self.device.stop_gateway()?;
            for channel in Channel::ALL {
                self.device.close_channel(channel)?;
            }
            self.counts = Counts::of(self.device, &self.named)?;
            self.device.stop()?;
        }
        if let Ended::Gateway(state) = ended {
            self.counts.state = state;
        }
        self.totals()?;
        let reason = match ended {
            Ended::Asked => return Ok(ExitCode::SUCCESS),
            Ended::Gateway(GatewayState::Ended(GatewayEnd::Loop)) => ONE_BUS,
            Ended::Gateway(GatewayState::Ended(GatewayEnd::ChannelClosed)) => "a channel was closed",
            Ended::Gateway(_) => "it was stopped",
        };
        stderr::warn(&format!("the gateway has ended: {reason}"));
        Ok(ExitCode::from(exit::FAILURE))
    }

    fn watch(&mut self) -> anyhow::Result<Ended> {
        let ends_at = self.args.time.map(|time| Instant::now() + time);
        let mut show_at = Instant::now() + SHOW_EVERY;
        let mut shown = None;
        while !interrupt::requested() && ends_at.is_none_or(|at| Instant::now() < at) {
            if let Some(batch) = self.records.next_batch(LOOK_EVERY)? {
                for record in &batch {
                    match &record.event {
                        TraceEvent::State { state, .. } => {
                            stderr::tell(&format!(
                                "cantap: channel {} is {}\n",
                                record.channel,
                                state.name()
                            ));
                        }
                        // It has ended: no need to wait for the next look.
                        TraceEvent::TransmitFailed { reason: TransmitFailure::Loop, .. } => {
                            show_at = Instant::now();
                        }
                        _ => {}
                    }
                }
                self.records.recycle(batch);
            }
            if Instant::now() < show_at {
                continue;
            }
            show_at += SHOW_EVERY;
            self.counts = Counts::of(self.device, &self.named)?;
            if self.counts.state != GatewayState::Running {
                return Ok(Ended::Gateway(self.counts.state));
            }
            if shown.as_ref() != Some(&self.counts) {
                self.progress()?;
                shown = Some(self.counts.clone());
            }
        }
        self.counts = Counts::of(self.device, &self.named)?;
        Ok(if self.counts.state == GatewayState::Running {
            Ended::Asked
        } else {
            Ended::Gateway(self.counts.state)
        })
    }

    /// Frames that the controllers lost before the gateway saw them.
    fn missed(&self) -> [u64; CHANNELS] {
        let now = self.device.counters().channels;
        std::array::from_fn(|at| now[at].lost_controller.saturating_sub(self.began_with[at]))
    }

    fn progress(&self) -> anyhow::Result<()> {
        let mut out = std::io::stdout().lock();
        match (self.args.json, self.args.show) {
            (true, true) => writeln!(out, "{}", self.counts.object(&self.named, self.missed()))?,
            (true, false) => {}
            (false, true) => {
                self.counts.table(&self.named).iter().try_for_each(|row| writeln!(out, "{row}"))?;
                writeln!(out)?;
            }
            (false, false) => writeln!(out, "{}", self.counts.line())?,
        }
        out.flush()?;
        Ok(())
    }

    fn totals(&self) -> anyhow::Result<()> {
        let mut out = std::io::stdout().lock();
        if self.args.json {
            writeln!(out, "{}", self.counts.object(&self.named, self.missed()))?;
        } else {
            self.counts.table(&self.named).iter().try_for_each(|row| writeln!(out, "{row}"))?;
            writeln!(out, "{}", self.counts.line())?;
            for (channel, missed) in (1..).zip(self.missed()).filter(|(_, missed)| *missed > 0) {
                writeln!(
                    out,
                    "channel {channel}: at least {missed} lost in the controller, before the gateway",
                    missed = counted(missed, "frame")
                )?;
            }
        }
        out.flush()?;
        Ok(())
    }
}
