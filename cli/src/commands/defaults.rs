//! `cantap defaults`: what a device keeps across a power cycle. Nothing here opens a channel.

use std::io::Write;
use std::process::ExitCode;

use cantap::Channel;
use cantap::wire::message::{Defaults, FrameKind};
use cantap_trace::filter::Filter;
use serde_json::{Value, json};

use cantap_work::channels::Channels;

use crate::args;
use crate::channel_args::ChannelArgs;
use crate::completion;
use crate::one_board::OneBoard;
use crate::stderr;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Commands without -b use what is saved: the bit timing always, the filters where they receive and no others are \
                  given. The mode is theirs: a capture only listens, whatever mode is saved.\n\nExamples:\n  \
                  cantap defaults save -d /dev/ttyACM0 -b 500k\n  \
                  cantap defaults save -d /dev/ttyACM0 -c 2 -b 125k -f 100:700\n  cantap defaults show -d /dev/ttyACM0"
)]
pub struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(clap::Subcommand)]
enum Action {
    /// Store how channels are opened, so that this survives a power cycle; commands without -b use it.
    Save(Save),
    /// Print what is stored.
    Show(Show),
    /// Erase what is stored.
    Clear(Clear),
}

#[derive(clap::Args)]
struct Save {
    #[command(flatten)]
    device: OneBoard,
    /// Which channels: 1, 2 or both. The other one keeps what is stored for it.
    #[arg(short, long, default_value = "both", value_parser = args::channels_of_one, add = completion::channels())]
    channel: Channels,
    #[command(flatten)]
    open: ChannelArgs,
    /// Hardware filters, in candump's syntax.
    #[arg(short, long, value_name = "FILTER")]
    filter: Vec<Filter>,
}

#[derive(clap::Args)]
struct Show {
    #[command(flatten)]
    device: OneBoard,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

#[derive(clap::Args)]
struct Clear {
    #[command(flatten)]
    device: OneBoard,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let mut out = std::io::stdout().lock();
    match &args.action {
        Action::Save(save) => {
            let device = save.device.open()?;
            save.open.options().configure(&device, save.channel.iter(), &save.filter, &stderr::reporter())?;
            device.save_defaults()?;
            writeln!(out, "saved on the device")?;
        }
        Action::Show(show) => {
            let device = show.device.open()?;
            let clock_hz = device.hello().can_clock_hz;
            let mut objects = Vec::new();
            for channel in Channel::ALL {
                let defaults = device.defaults(channel)?;
                if show.json {
                    objects.push(object(channel, defaults.as_ref(), clock_hz));
                } else {
                    writeln!(out, "{}", line(channel, defaults.as_ref(), clock_hz))?;
                }
            }
            if show.json {
                writeln!(out, "{}", json!({ "channels": objects }))?;
            }
        }
        Action::Clear(clear) => {
            clear.device.open()?.clear_defaults()?;
            writeln!(out, "erased from the device")?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// The options that are set, by their names on the command line.
fn flags(defaults: &Defaults) -> Vec<&'static str> {
    let config = &defaults.config;
    [
        (config.one_shot, "one-shot"),
        (config.manual_recovery, "recovery manual"),
        (config.omit_data, "no-data"),
        (config.omit_stamps, "no-stamps"),
    ]
    .into_iter()
    .filter_map(|(set, name)| set.then_some(name))
    .collect()
}

/// The hardware's filters, as text: identifier, mask and kind.
fn filters(defaults: &Defaults) -> Vec<String> {
    let text = |filter: &cantap::wire::message::Filter| {
        let width = if filter.extended { 8 } else { 3 };
        let kind = match filter.kind {
            FrameKind::Data => " data",
            FrameKind::Remote => " remote",
            FrameKind::Any => "",
        };
        format!("{:0width$X}:{:0width$X}{kind}", filter.id, filter.mask)
    };
    defaults.filters.iter().map(text).collect()
}

fn line(channel: Channel, defaults: Option<&Defaults>, clock_hz: u32) -> String {
    let number = channel.number();
    let Some(defaults) = defaults else { return format!("channel {number}  nothing saved") };
    let timing = &defaults.config.timing;
    let mut parts = vec![
        format!("{} bit/s", timing.bitrate_bps(clock_hz)),
        format!("sample point {:.1} %", f64::from(timing.sample_point_permille()) / 10.0),
        defaults.config.mode.name().to_owned(),
    ];
    parts.extend(flags(defaults).into_iter().map(str::to_owned));
    match filters(defaults) {
        filters if filters.is_empty() => parts.push("receives everything".to_owned()),
        filters => parts.push(format!("receives {}", filters.join(", "))),
    }
    format!("channel {number}  {}", parts.join(", "))
}

fn object(channel: Channel, defaults: Option<&Defaults>, clock_hz: u32) -> Value {
    let saved = defaults.map(|defaults| {
        let timing = &defaults.config.timing;
        json!({
            "bitrate_bps": timing.bitrate_bps(clock_hz),
            "sample_point_pct": f64::from(timing.sample_point_permille()) / 10.0,
            "segments": [u16::from(timing.segment1), u16::from(timing.segment2)],
            "prescaler": timing.prescaler,
            "sjw": timing.jump_width,
            "mode": defaults.config.mode.name(),
            "one_shot": defaults.config.one_shot,
            "manual_recovery": defaults.config.manual_recovery,
            "no_data": defaults.config.omit_data,
            "no_stamps": defaults.config.omit_stamps,
            "filters": filters(defaults),
        })
    });
    json!({ "channel": channel.number(), "saved": saved })
}
