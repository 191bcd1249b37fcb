//! The records of a device, for commands that read a trace or listen to a bus.

use std::fmt::Write;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use cantap::TraceRecord;
use cantap::device::{Happening, Reconnecting, Return};

use crate::address::{Address, OpenDevice};
use crate::{advice, args, interrupt};

/// Which device, and how; for commands to flatten into theirs, beside an input file that is
/// `required_unless_present = "device"`.
#[derive(clap::Args)]
pub struct LiveArgs {
    /// Listen to a device instead of reading a file, until Ctrl-C.
    #[arg(short, long, conflicts_with = "input", requires = "bitrate")]
    device: Option<Address>,
    /// The device's channel to listen to: 1, 2 or both.
    #[arg(short, long, default_value = "both", requires = "device", value_parser = args::channels)]
    channel: args::Channels,
    /// Bit rate of the bus in bit/s: 500000, 500k, 1M.
    #[arg(short, long, requires = "device", value_parser = args::bitrate)]
    bitrate: Option<u32>,
    /// Stop listening after this time, as 10, 500ms or 2m.
    #[arg(short, long, requires = "device", value_parser = args::positive_duration)]
    time: Option<Duration>,
}

/// How often to check whether to go on while nothing arrives.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// A device that the command goes on with when it is back; errors are told to the user.
pub type Line = Reconnecting<'static, OpenDevice, anyhow::Error>;

/// The device at an address, as soon as it is there; `setup` opens its channels.
pub fn line(
    address: &Address,
    setup: impl FnMut(&OpenDevice) -> anyhow::Result<()> + Send + 'static,
) -> Line {
    let at = address.clone();
    Line::new(&address.to_string(), move |serial| at.open_again(serial), setup)
}

/// What a device hears.
pub struct LiveRecords {
    line: Line,
    may_come_back: bool,
    ends: Option<Instant>,
    /// How [`Line::stop`] went.
    stopped: Option<anyhow::Result<()>>,
}

impl LiveArgs {
    /// The devices that were given.
    pub fn devices(&self) -> impl Iterator<Item = &Address> {
        self.device.iter()
    }

    /// Opens the device and its channels, if one was given.
    pub fn open(&self) -> anyhow::Result<Option<LiveRecords>> {
        let Some(address) = &self.device else { return Ok(None) };
        let Some(bitrate) = self.bitrate else { bail!("give the bus's bit rate with -b, such as -b 500k") };
        let channels = self.channel;
        let live = LiveRecords::open(address, self.time, move |device| {
            for channel in channels.iter() {
                device.listen(channel, bitrate).with_context(|| format!("channel {}", channel.number()))?;
            }
            Ok(())
        })?;
        Ok(Some(live))
    }
}

impl LiveRecords {
    /// Opens a device, and its channels by `setup`, until Ctrl-C or the end of the time.
    pub fn open(
        address: &Address,
        time: Option<Duration>,
        setup: impl FnMut(&OpenDevice) -> anyhow::Result<()> + Send + 'static,
    ) -> anyhow::Result<Self> {
        interrupt::watch()?;
        let mut line = line(address, setup);
        line.connect()?;
        let ends = time.map(|time| Instant::now() + time);
        Ok(Self { line, may_come_back: address.may_come_back(), ends, stopped: None })
    }

    /// The device, wherever it is.
    pub const fn line(&self) -> &Line {
        &self.line
    }

    /// Ends the capture: what is left comes from [`Self::next_batch`], and an error at its end if the device did not have its
    /// last word.
    pub fn stop(&mut self) {
        if self.stopped.is_none() {
            self.stopped = Some(self.line.stop());
        }
    }

    /// Ends the capture, and what is left is not wanted.
    pub fn end(&mut self) -> anyhow::Result<()> {
        self.stop();
        self.stopped.take().unwrap_or(Ok(()))
    }

    /// Whether Ctrl-C or the end of the time has come.
    fn is_over(&self) -> bool {
        interrupt::requested() || self.ends.is_some_and(|ends| Instant::now() >= ends)
    }

    /// Puts the next records, or none after a while without any, in the place of what is in `records`; false after Ctrl-C
    /// or the end of the time, when everything that was captured has been handed out. Says on standard error when the device
    /// goes and when it is back.
    pub fn next_batch(&mut self, records: &mut Vec<TraceRecord>) -> anyhow::Result<bool> {
        if self.is_over() {
            self.stop();
        }
        match self.line.next(LOOK_EVERY) {
            Happening::Records(batch) => {
                self.line.recycle(std::mem::replace(records, batch));
                return Ok(true);
            }
            Happening::Gone(error) if self.may_come_back => {
                let reason = advice::sentence(&error);
                eprintln!("cantap: {reason}; it goes on when the device is back, and Ctrl-C ends it");
            }
            Happening::Gone(error) => return Err(error),
            Happening::Back(back) => eprintln!("cantap: {}", welcome(&back)),
            Happening::Ended => {
                records.clear();
                return self.stopped.take().unwrap_or(Ok(())).map(|()| false);
            }
        }
        records.clear();
        Ok(true)
    }
}

/// What there is to say of a device that is there again.
fn welcome(back: &Return) -> String {
    let after = back.after.unwrap_or_default().as_secs_f64();
    let mut said = match &back.other_board {
        Some(name) => format!("another board is there now, {name}, after {after:.1} s"),
        None => format!("the device is back after {after:.1} s"),
    };
    for channel in &back.only_listening {
        let _ = write!(said, "; channel {} only listens on it", channel.number());
    }
    said
}
