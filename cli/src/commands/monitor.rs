//! `cantap monitor`: the live view of a device or a file.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use cantap::wire::message::Mode;
use cantap_address::{Address, AddressError};
use cantap_formats::WriteOptions;
use cantap_signals::Decoder;
use cantap_signals::named::NamedFilter;
use cantap_trace::filter::Filter;

use cantap_tui::{
    App, Model, Once, Order, Origin, Plan, Profile, SendEntry, Theme, View, once, orders, parse_entry,
    run as show, svg, text,
};
use cantap_work::atomic_file;
use cantap_work::boards::Boards;
use cantap_work::channel_bitrate::ChannelBitrate;
use cantap_work::channel_options::ChannelOptions;
use cantap_work::channels::Channels;
use cantap_work::databases::{Databases, LoadReport};
use cantap_work::recording::parts;

use crate::args;
use crate::channel_args::ChannelArgs;
use crate::completion;
use crate::database_args::DatabaseArgs;
use crate::input::resolved;
use crate::live_args::AUTO_NEEDS_A_DEVICE;
use crate::protocols::ProtocolArgs;
use crate::trace_output::{named, refuse_older, refuse_unwritten};
use crate::usage_error::usage;

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
                cantap monitor virtual:car\n  \
                cantap monitor -d /dev/ttyACM0 -b 500k -b 2:250k --db car.dbc\n  \
                cantap monitor trace.blf -b 500k --db car.dbc\n  \
                candump can0 | cantap monitor - -b 500k\n  \
                cantap monitor -p car.toml\n\n\
                h shows the keys. Without a device and a file, the board that is connected is listened to. Without a \
                bit rate, given or saved on the device, it is found by listening.")]
pub struct Args {
    /// A trace to play back, or a device's address.
    #[arg(value_name = "FILE|DEVICE", conflicts_with = "devices")]
    file: Option<PathBuf>,
    /// The device. Repeat for several, with channels numbered consecutively: the second one's are 3 and 4.
    #[arg(short, long = "device", value_name = "DEVICE", add = completion::devices())]
    devices: Vec<Address>,
    /// Which channels: 1, 2, several as 1,3, or both, which means all. Default: those whose bit rate is given; all if none is.
    #[arg(short, long, value_parser = args::channels, add = completion::channels())]
    channel: Option<Channels>,
    #[command(flatten)]
    open: ChannelArgs,
    /// Take part in the bus: acknowledge, and send on request. Otherwise listen only. The same as --mode normal.
    #[arg(long, conflicts_with = "mode")]
    normal: bool,
    #[command(flatten)]
    databases: DatabaseArgs,
    #[command(flatten)]
    protocol: ProtocolArgs,
    /// Show only these frames, in candump's syntax; with a database also EngineData. Can be repeated. Recordings contain all frames.
    #[arg(short, long, value_name = "FILTER")]
    filter: Vec<NamedFilter>,
    /// A profile: device, bit rates, databases, filters, view, send list.
    #[arg(short, long, value_name = "FILE")]
    profile: Option<PathBuf>,
    /// The page to begin with: trace, fixed, signals, graph, statistics, send, record, nodes, scripts or obd.
    #[arg(long, value_name = "PAGE", value_parser = view)]
    view: Option<View>,
    /// Record to this file from the start.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Overwrite an existing recording.
    #[arg(long, requires = "output")]
    force: bool,
    /// Memory for scrolling back, in MB.
    #[arg(long, value_name = "MB", default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=4096))]
    history: u32,
    /// Colours for a light background.
    #[arg(long)]
    light: bool,
    /// Print one screen as text and exit.
    #[arg(long)]
    once: bool,
    /// With --once: write the screen to this file as an SVG picture instead, with its colours.
    #[arg(long, value_name = "FILE", requires = "once")]
    svg: Option<PathBuf>,
    /// With --once: how long to watch a device, otherwise 1s.
    #[arg(short = 't', long, value_name = "TIME", requires = "once", value_parser = args::positive_duration)]
    time: Option<Duration>,
    /// With --once: the screen's size.
    #[arg(long, value_name = "COLUMNSxROWS", default_value = "80x24", requires = "once", value_parser = size)]
    size: (u16, u16),
}

/// How long --once watches a device.
const WATCHED: Duration = Duration::from_secs(1);

fn view(text: &str) -> Result<View, String> {
    let found = View::ALL.into_iter().find(|view| view.title().eq_ignore_ascii_case(text));
    found.ok_or_else(|| {
        "a page is trace, fixed, signals, graph, statistics, send, record, nodes, scripts or obd".to_owned()
    })
}

fn size(text: &str) -> Result<(u16, u16), String> {
    let parsed =
        text.split_once('x').and_then(|(columns, rows)| Some((columns.parse().ok()?, rows.parse().ok()?)));
    parsed
        .filter(|(columns, rows)| (1..=500).contains(columns) && (1..=300).contains(rows))
        .ok_or_else(|| "write the size as columns and rows, such as 80x24".to_owned())
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let (file, devices) = args.source()?;
    refuse_recording(args)?;
    // Faults in profile and databases are shown, and the view opens without them; with --once they are errors.
    let mut report = LoadReport::default();
    let profile = load_profile(args.profile.as_deref(), &mut report);
    let databases = load_databases(args, &devices, &profile, &mut report);
    let decoder = databases.decoder_reporting(&mut report);
    let open = channel_options(args, &profile, &mut report);
    if file.is_some() && open.timing.has_auto() {
        return Err(usage(AUTO_NEEDS_A_DEVICE));
    }
    let options = ChannelBitrate::options(&open.timing.known());
    let filters = filters(args, &profile, &decoder, &mut report)?;
    let model = Model::new(Arc::new(decoder), options, args.history as usize * 1_000_000)?;
    // What is wrong with a description is said before the view opens, and above all what it would not show.
    let mut model = model.with_conversations(args.protocol.options(false)?);
    model.history.set_filters(filters, None);
    for name in &profile.graph {
        if let Err(error) = model.seen.signals.choose(name) {
            report.faults.push(format!("graph: {error}"));
        }
    }
    let name = file.as_deref().and_then(Path::file_name).map(|name| name.to_string_lossy().into_owned());
    let (origin, plan) = if let Some(path) = file {
        (Origin::File(path), None)
    } else {
        let plan = plan(args, devices, &profile, open, &mut report)?;
        (Origin::Device(plan.clone()), Some(plan))
    };
    let theme = Theme::from_environment(args.light || profile.light);
    let (sender, receiver) = orders();
    let mut app = App::new(args.view.or(profile.view).unwrap_or(View::Fixed), theme, plan, sender);
    app.sort = profile.sort.unwrap_or(app.sort);
    app.send = send_list(&profile, &model, &mut report);
    app.databases = databases;
    add_scripts(&mut app, &mut model, &profile, &mut report);
    app.file = name;
    let record = profile.record.as_ref().map(|path| profile.folder.join(path));
    if let Some(path) = args.output.clone().or(record) {
        app.orders.send(Order::Record(path))?;
    }
    let LoadReport { faults, remarks } = report;
    if args.once {
        if !faults.is_empty() {
            bail!("{}", faults.join("\ncantap: "));
        }
        for remark in remarks {
            eprintln!("cantap: {remark}");
        }
        let Once { screen, nothing_read } =
            once(origin, app, model, receiver, args.size, args.time.unwrap_or(WATCHED))?;
        match &args.svg {
            None => std::io::stdout().lock().write_all(text(&screen).as_bytes())?,
            Some(path) => atomic_file::write(path, svg(&screen).as_bytes())
                .with_context(|| format!("cannot write {}", path.display()))?,
        }
        if let Some(first) = nothing_read {
            bail!("nothing of the trace could be read: {first}");
        }
    } else {
        model.notice = [faults, remarks].concat().join("; ");
        for notice in show(origin, app, model, receiver)? {
            eprintln!("cantap: {notice}");
        }
    }
    Ok(ExitCode::SUCCESS)
}

impl Args {
    /// The given trace or devices.
    fn source(&self) -> anyhow::Result<(Option<PathBuf>, Vec<Address>)> {
        let Some(path) = &self.file else {
            return Ok((None, self.devices.clone()));
        };
        // Into a live view, another program writes while it is watched: `candump can0 | cantap monitor - -b 500k`.
        let path = if path.as_os_str() == "-" && !self.once { Path::new("candump:-") } else { path };
        if Address::is_meant_by(path) {
            let address = path.to_str().unwrap_or_default().parse().map_err(address_usage)?;
            return Ok((None, vec![address]));
        }
        if self.channel.is_some() {
            return Err(usage(
                "-c chooses a device's channels; of a trace's, -f can0,0:0 shows channel 1 alone",
            ));
        }
        let of_devices =
            [(self.normal, "--normal"), (self.time.is_some(), "-t")].into_iter().find(|(given, _)| *given);
        if let Some(option) = of_devices.map(|(_, option)| option).or(self.open.given()) {
            return Err(usage(format!(
                "{option} is for a device, and {} is a trace; leave it out",
                path.display()
            )));
        }
        Ok((Some(path.to_owned()), Vec::new()))
    }
}

#[expect(clippy::needless_pass_by_value, reason = "for map_err")]
fn address_usage(error: AddressError) -> anyhow::Error {
    usage(error.to_string())
}

/// Refuses a recording that cannot be made as requested. Its name may be followed by a condition: `FILE if
/// CONDITION`.
fn refuse_recording(args: &Args) -> anyhow::Result<()> {
    let Some(text) = args.output.as_deref() else { return Ok(()) };
    let (path, _) = parts(text);
    if path.extension().is_some() {
        named(WriteOptions::default(), path)?.format.map_or(Ok(()), refuse_unwritten)?;
    }
    refuse_older(path, args.force)
}

fn load_profile(path: Option<&Path>, report: &mut LoadReport) -> Profile {
    let loaded = path.map(Profile::load).transpose();
    loaded
        .unwrap_or_else(|complaint| {
            report.faults.push(complaint);
            None
        })
        .unwrap_or_default()
}

fn load_databases(args: &Args, devices: &[Address], profile: &Profile, report: &mut LoadReport) -> Databases {
    let own = if args.databases.is_empty() { profile.databases.as_slice() } else { &[] };
    let given = if own.is_empty() { args.databases.or_of(devices) } else { args.databases.options() };
    let mut databases = given.load_available(report);
    for text in own {
        databases.add(text, &profile.folder, report);
    }
    databases
}

/// How to open channels: the profile supplies what the command line leaves open.
fn channel_options(args: &Args, profile: &Profile, report: &mut LoadReport) -> ChannelOptions {
    let mut open = args.open.options();
    if !open.timing.is_given() {
        for text in &profile.bitrates {
            match text.parse() {
                Ok(rate) => open.timing.bitrates.push(rate),
                Err(reason) => report.faults.push(format!("bit rate {text}: {reason}")),
            }
        }
    }
    if open.mode.is_none() && (args.normal || profile.normal) {
        open.mode = Some(Mode::Normal);
    }
    open
}

fn filters(
    args: &Args,
    profile: &Profile,
    decoder: &Decoder,
    report: &mut LoadReport,
) -> anyhow::Result<Vec<Filter>> {
    let mut filters = resolved(&args.filter, decoder)?;
    for text in if args.filter.is_empty() { profile.filters.as_slice() } else { &[] } {
        let filter = text.parse::<NamedFilter>().map_err(|error| error.to_string());
        match filter.and_then(|filter| filter.resolve(decoder).map_err(|error| error.to_string())) {
            Ok(filter) => filters.push(filter),
            Err(error) => report.faults.push(format!("filter {text}: {error}")),
        }
    }
    Ok(filters)
}

fn plan(
    args: &Args,
    mut addresses: Vec<Address>,
    profile: &Profile,
    open: ChannelOptions,
    report: &mut LoadReport,
) -> anyhow::Result<Plan> {
    let own = if addresses.is_empty() {
        profile.device.iter().chain(&profile.devices).cloned().collect()
    } else {
        Vec::new()
    };
    for text in own {
        match text.parse() {
            Ok(address) => addresses.push(address),
            Err(error) => report.faults.push(format!("device {text}: {error}")),
        }
    }
    if addresses.is_empty() && !report.faults.is_empty() {
        addresses.push(Address::of_virtual_device());
    }
    let all = Channels::all();
    let boards = Boards::new(&addresses, args.channel.as_ref().unwrap_or(&all))?;
    open.timing.check_channels(boards.addresses().len())?;
    let mut plan = Plan { addresses: boards.addresses().to_vec(), channels: Vec::new(), open };
    match args.channel {
        Some(_) => plan.channels = boards.channel_numbers().collect(),
        None => plan.choose_channels(),
    }
    Ok(plan)
}

fn add_scripts(app: &mut App, model: &mut Model, profile: &Profile, report: &mut LoadReport) {
    for text in &profile.scripts {
        let is_node = text.starts_with(cantap_scripts::library::PREFIX);
        let name = if is_node { text.clone() } else { profile.folder.join(text).display().to_string() };
        if let Err(reason) = app.add_script(&name, model) {
            report.faults.push(format!("script {text}: {reason}"));
        }
    }
    app.selected = 0;
}

fn send_list(profile: &Profile, model: &Model, report: &mut LoadReport) -> Vec<SendEntry> {
    let mut entries = Vec::new();
    for text in &profile.send {
        match parse_entry(text, model) {
            Ok(entry) => entries.push(entry),
            Err(reason) => report.faults.push(format!("to send, {text}: {reason}")),
        }
    }
    entries
}
