//! `cantap bridge`: a device's channels as CAN interfaces of Linux, for every program that uses SocketCAN.

mod interface;
mod lane;
mod raw;
mod sender;
#[cfg(test)]
mod tests;

use std::borrow::Borrow;
use std::process::ExitCode;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow};
use cantap::Device;
use cantap::device::{Happening, Reconnecting};
use cantap::wire::Channel;
use cantap::wire::message::Mode;
use cantap_address::OpenDevice;

use self::interface::CanPort;
use self::lane::Lane;
use self::sender::Sender;
use crate::channel_args::ChannelArgs;
use crate::one_board::OneBoard;
use crate::usage_error::usage;
use crate::{args, stderr};
use cantap_work::advice;
use cantap_work::bus_hints::{BusHint, HintPlace};
use cantap_work::interrupt;
use cantap_work::live;
use cantap_work::reception::Reception;

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "The interfaces are virtual ones, which root makes once:\n  \
                ip link add can0 type vcan && ip link set can0 up\n\n\
                Channels only listen, unless --mode says otherwise: what programs write is refused then, with an error \
                frame for each. What the buses refuse, errors, states and losses are error frames (candump -e shows \
                them). A frame's time is that of its arrival at the interface.\n\n\
                CAN FD frames cross between an adapter that has them and an interface with an mtu of 72:\n  \
                ip link set can0 mtu 72 && ip link set can0 up\n\n\
                Examples:\n  \
                cantap bridge -d /dev/ttyACM0 -b 500k can0 can1\n  \
                cantap bridge -d /dev/ttyACM0 -b 500k --mode normal can0\n  \
                cantap bridge -d unix: 2:can1")]
pub struct Args {
    #[command(flatten)]
    board: OneBoard,
    /// Interfaces: the first is for channel 1, the second for channel 2, unless a channel comes before it
    /// (2:can1).
    #[arg(required = true, num_args = 1..=2, value_name = "[CHANNEL:]INTERFACE")]
    interfaces: Vec<String>,
    #[command(flatten)]
    open: ChannelArgs,
}

/// How often to check whether to continue while nothing arrives.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// A device used by both directions.
struct Handle(Arc<OpenDevice>);

impl Borrow<Device> for Handle {
    fn borrow(&self) -> &Device {
        &self.0
    }
}

/// Which interface belongs to which channel.
fn places(interfaces: &[String]) -> anyhow::Result<Vec<(Channel, &str)>> {
    let mut places: Vec<(Channel, &str)> = Vec::new();
    for (text, usual) in interfaces.iter().zip(Channel::ALL) {
        let (channel, name) = match text.split_once(':') {
            Some((channel, name)) => (args::channel(channel).map_err(usage)?, name),
            None => (usual, text.as_str()),
        };
        if places.iter().any(|(taken, other)| *taken == channel || *other == name) {
            return Err(usage(format!("'{text}' is given twice: one interface for each channel")));
        }
        places.push((channel, name));
    }
    Ok(places)
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let places = places(&args.interfaces)?;
    args.open.options().timing.check_channels(1)?;
    let address = args.board.address()?;
    let lanes = places.iter().map(|(channel, name)| {
        let (port, known) = CanPort::open(name)?;
        Ok(Lane::new(*channel, name, Box::new(port), known))
    });
    let lanes: Arc<[Lane]> = lanes.collect::<anyhow::Result<_>>()?;
    let channels: Vec<Channel> = places.iter().map(|(channel, _)| *channel).collect();
    let latest = Arc::new(Mutex::new(Weak::new()));
    let (at, connected) = (address.clone(), Arc::clone(&latest));
    let connect = move |serial: Option<&str>| {
        let device = Arc::new(at.open_again(serial)?);
        *connected.lock().unwrap_or_else(PoisonError::into_inner) = Arc::downgrade(&device);
        Ok(Handle(device))
    };
    let (open, reporter) = (args.open.options(), stderr::reporter());
    let setup = move |handle: &Handle| {
        open.open(&handle.0, channels.iter().copied(), Mode::ListenOnly, Some(&[]), &reporter).map(|_| ())
    };
    let mut line: Reconnecting<Handle, anyhow::Error> =
        Reconnecting::new(&address.to_string(), connect, setup);
    line.connect()?;
    interrupt::watch()?;
    let sender = Sender::start(Arc::clone(&lanes)).context("the system refused a thread")?;
    let device = || latest.lock().unwrap_or_else(PoisonError::into_inner).upgrade();
    sender.use_device(device());
    for lane in lanes.iter() {
        eprintln!("cantap: {}", begun(lane, device().as_deref()));
    }
    let mut bridge = Bridge { lanes: &lanes, reception: Reception::default(), address: address.to_string() };
    let mut recovery = args.open.bus_off_recovery();
    loop {
        if interrupt::requested() {
            sender.use_device(None);
            break;
        }
        if let Some(reason) = sender.failed() {
            return Err(anyhow!("an interface is gone: {reason}"));
        }
        match line.next(LOOK_EVERY) {
            Happening::Records(records) => {
                bridge.hear(&records)?;
                line.recycle(records);
            }
            Happening::Gone(error) => {
                sender.use_device(None);
                let reason = advice::sentence(&error);
                if !address.may_come_back() {
                    return Err(error);
                }
                eprintln!("cantap: {reason}; it continues when the device is back; Ctrl-C ends it");
            }
            Happening::Back(back) => {
                sender.use_device(device());
                eprintln!("cantap: {}", live::return_text(0, None, &back));
            }
            Happening::Ended => break,
        }
        match line.device().map(|device| recovery.look(device)) {
            // The stream reports it.
            Some(Err(error)) if !error.is_of_the_connection() => return Err(error.into()),
            _ => {}
        }
    }
    drop(sender);
    let stopped = line.stop();
    while let Happening::Records(records) = line.next(LOOK_EVERY) {
        bridge.hear(&records)?;
    }
    for lane in lanes.iter() {
        eprintln!("cantap: {}", ended(lane));
    }
    stopped.map(|()| ExitCode::SUCCESS)
}

/// The direction from the buses to programs.
struct Bridge<'l> {
    lanes: &'l [Lane],
    reception: Reception,
    address: String,
}

impl Bridge<'_> {
    fn hear(&mut self, records: &[cantap::TraceRecord]) -> anyhow::Result<()> {
        for lane in self.lanes {
            lane.hear(records).with_context(|| format!("the interface '{}' is gone", lane.name))?;
        }
        let now = Instant::now();
        self.reception.take(records, now);
        for number in self.reception.news(now) {
            let hint = self.reception.hint(number, false).unwrap_or(BusHint::WrongBitRate);
            let place = HintPlace { number, device: &self.address, channel_there: number };
            stderr::warn(&hint.sentence(&place));
        }
        Ok(())
    }
}

/// What to tell the user about a channel at its beginning.
fn begun(lane: &Lane, device: Option<&OpenDevice>) -> String {
    let opened = device.map(|device| device.open_channels()).unwrap_or_default();
    let config = opened.iter().find(|(channel, _)| *channel == lane.channel).map(|(_, config)| config);
    let listens = config.is_none_or(|config| config.mode == Mode::ListenOnly);
    let may = if listens { "programs may listen" } else { "programs may listen and send" };
    format!("channel {} is at {}; {may}; Ctrl-C ends it", lane.channel.number(), lane.name)
}

/// The same at its end.
fn ended(lane: &Lane) -> String {
    let counts = &lane.counts;
    let [heard, lost, undelivered, sent, not_sent] =
        [&counts.heard, &counts.lost, &counts.undelivered, &counts.sent, &counts.not_sent]
            .map(|count| count.load(Ordering::Relaxed));
    let at_least = if counts.lost_more.load(Ordering::Relaxed) { "at least " } else { "" };
    format!(
        "{}: {heard} frames heard, {at_least}{lost} lost before that, {undelivered} not taken by the interface; {sent} sent, \
         {not_sent} not sent",
        lane.name
    )
}
