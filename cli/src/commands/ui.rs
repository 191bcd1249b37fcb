//! `cantap ui`: the page in a browser on this machine, live from a device, or with a trace.

mod browser;

use std::io::Write;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use cantap::wire::message::Role;
use cantap_address::Address;
use cantap_signals::named::NamedFilter;
use cantap_ui::{Device, Server, Site, Source};
use cantap_work::boards::Boards;
use cantap_work::channels::Channels;
use cantap_work::interrupt;
use cantap_work::requested_rate::RequestedRate;
use serde_json::{Value, json};

use crate::args;
use crate::channel_args::ChannelArgs;
use crate::completion;
use crate::database_args::{DatabaseArgs, load};
use crate::input::resolved;
use crate::live_args::for_listening;
use crate::page::{self, Carried};
use crate::protocols::ProtocolArgs;
use crate::stderr;
use crate::usage_error::usage;

/// Periodic frames stop when no page has been there for this long, as after a browser that was closed; a page that is loaded anew is back sooner.
pub const DEAD_MAN: Duration = Duration::from_secs(10);

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "The page shows what arrives in all its views. It is served on this machine alone, at an address with a secret token \
                in it: whoever has the address sees the bus. Ctrl-C ends it.\n\n\
                Channels only listen. With --allow send, the page can have them take part, after asking, and send.\n\n\
                Examples:\n  \
                cantap ui -d /dev/ttyACM0 -b 500k --db car.dbc\n  \
                cantap ui -d virtual:car --allow send\n  \
                cantap ui -d unix: --no-open\n  \
                cantap ui drive.blf --db car.dbc"
)]
pub struct Args {
    /// A trace to show, or a device's address.
    #[arg(value_name = "FILE|DEVICE", conflicts_with = "devices")]
    file: Option<PathBuf>,
    /// The device. Repeat for several, with channels numbered consecutively: the second one's are 3 and 4. Without it and without
    /// a file, the board that is connected.
    #[arg(short, long = "device", value_name = "DEVICE", add = completion::devices())]
    devices: Vec<Address>,
    /// Which channels: 1, 2, several as 1,3, or both, which means all.
    #[arg(short, long, default_value = "both", value_parser = args::channels, add = completion::channels())]
    channel: Channels,
    #[command(flatten)]
    open: ChannelArgs,
    #[command(flatten)]
    databases: DatabaseArgs,
    #[command(flatten)]
    protocol: ProtocolArgs,
    /// Receive only these frames, in candump's syntax; with a database also EngineData. Repeat for any of several. The page can change it.
    #[arg(short, long, value_name = "FILTER")]
    filter: Vec<NamedFilter>,
    /// Record to this file from the start, in the format of its suffix; 'FILE if CONDITION' keeps 2 s before and 5 s after each event.
    /// Recordings that the page begins are in the working folder.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// What the page may do besides looking, choosing bit rates and recording: send, which includes taking part in the bus.
    #[arg(long, value_name = "ROLE", value_parser = ["send"])]
    allow: Option<String>,
    /// The port; without it, any that is free.
    #[arg(long, value_name = "PORT", default_value_t = 0)]
    port: u16,
    /// Do not open a browser, only print the address.
    #[arg(long)]
    no_open: bool,
    /// Do not report what is wrong with usable databases.
    #[arg(short, long)]
    quiet: bool,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let page = page::find()?;
    let (source, about) = args.source()?;
    let page = page::with(&page, page::LIVE, &about)?;
    // A recording is finished when Ctrl-C ends it.
    interrupt::watch()?;
    let address = SocketAddr::from((Ipv4Addr::LOCALHOST, args.port));
    // Its user sits in front of the page.
    let server = Server::open(Site::new(&page)?, source, address, stderr::reporter(), Arc::new(|_, _| ()))
        .context("give another port with --port")?;
    let url = server.url();
    writeln!(std::io::stdout(), "{url}")?;
    if args.no_open {
        eprintln!("cantap: open this address in a browser on this machine; Ctrl-C ends it");
        server.run()?;
    } else {
        // It is removed at the end, when the browser has long read it.
        let opened = browser::open(&url);
        match &opened {
            Ok(_) => eprintln!("cantap: a browser opens; Ctrl-C ends it"),
            Err(error) => {
                eprintln!("cantap: no browser opens ({error}): open this address in one on this machine");
            }
        }
        server.run()?;
    }
    Ok(ExitCode::SUCCESS)
}

impl Args {
    /// What is served, and what the page is told about it.
    fn source(&self) -> anyhow::Result<(Source, Value)> {
        match &self.file {
            Some(path) if !Address::is_meant_by(path) => self.trace(path),
            Some(path) => {
                let address = path.to_str().unwrap_or_default().parse::<Address>();
                self.device(&[address.map_err(|error| usage(error.to_string()))?])
            }
            None => self.device(&self.devices),
        }
    }

    fn trace(&self, path: &std::path::Path) -> anyhow::Result<(Source, Value)> {
        let is_of_device = self.open.options().mode.is_some()
            || self.output.is_some()
            || self.allow.is_some()
            || !self.filter.is_empty();
        if is_of_device {
            return Err(usage("a trace is only shown: --mode, -f, -o and --allow are for devices"));
        }
        let name = page::file_name(path).filter(|_| path.as_os_str() != "-");
        let name = name.context("the page shows a file; write standard input into one first")?;
        let size = path.metadata().with_context(|| format!("cannot read {}", path.display()))?.len();
        let options = self.databases.options();
        load(&options, false, self.quiet)?;
        let bitrates: Vec<_> = self.bitrates();
        let described = self.protocol.carried(self.quiet)?;
        let about = json!({
            "version": 1,
            "kind": "trace",
            "name": name,
            "size": size,
            "databases": objects(page::databases(&options.paths)?.into_iter().chain(described.files)),
            "connections": described.connections,
            "bitrates": bitrates,
        });
        Ok((Source::Trace(path.to_owned()), about))
    }

    /// Bit rates that the trace itself may lack.
    fn bitrates(&self) -> Vec<Value> {
        let of = |rate: &RequestedRate| -> Vec<Value> {
            let Some(bitrate_bps) = rate.bitrate_bps else { return Vec::new() };
            let channels = rate.channel.map_or_else(|| vec![1, 2], |channel| vec![channel]);
            let object =
                |channel: u8| json!({ "channel": channel, "bitrate": bitrate_bps, "dataBitrate": null });
            channels.into_iter().map(object).collect()
        };
        self.open.options().timing.bitrates.iter().flat_map(of).collect()
    }

    fn device(&self, given: &[Address]) -> anyhow::Result<(Source, Value)> {
        if self.output.as_ref().is_some_and(|path| path.as_os_str() == "-") {
            return Err(usage("the recording needs a file's name, such as -o drive.blf"));
        }
        let boards = Boards::new(given, &self.channel)
            .map_err(|error| for_listening(error.into(), given, "without a trace to show"))?;
        let options = self.databases.or_of(boards.addresses());
        let decoder = load(&options, false, self.quiet)?;
        let described = self.protocol.carried(self.quiet)?;
        let about = page::about_devices(boards.addresses(), &options, described, "cantap ui")?;
        let folder = std::env::current_dir().context("there is no working folder for recordings")?;
        let device = Device {
            boards,
            hosted: None,
            open: self.open.options(),
            filters: resolved(&self.filter, &decoder)?,
            role: if self.allow.is_some() { Role::Send } else { Role::Configure },
            decoder,
            folder: Some(folder),
            record: self.output.clone(),
            dead_man: DEAD_MAN,
        };
        Ok((Source::Device(Box::new(device)), about))
    }
}

fn objects(databases: impl Iterator<Item = Carried>) -> Vec<Value> {
    databases.map(Carried::into_object).collect()
}
