//! The records of a device, for commands that read a trace or listen to a bus.

use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use cantap::{Address, Device, TraceRecord};

use crate::args;
use crate::interrupt;

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
    /// Listen only for so long, as 10, 500ms or 2m.
    #[arg(short, long, requires = "device", value_parser = args::positive_duration)]
    time: Option<Duration>,
}

/// How often the end is looked for while nothing arrives.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// What a device hears.
pub struct LiveRecords {
    device: Device,
    records: cantap::device::Records,
    ends: Option<Instant>,
    stopped: bool,
}

impl LiveArgs {
    /// Opens the device and its channels, if one was given.
    pub fn open(&self) -> anyhow::Result<Option<LiveRecords>> {
        let Some(address) = &self.device else { return Ok(None) };
        let Some(bitrate) = self.bitrate else { bail!("give the bus's bit rate with -b, such as -b 500k") };
        interrupt::watch()?;
        let device = Device::open(address)?;
        let records = device.records();
        for channel in self.channel.iter() {
            device.listen(channel, bitrate).with_context(|| format!("channel {}", channel.number()))?;
        }
        let ends = self.time.map(|time| Instant::now() + time);
        Ok(Some(LiveRecords { device, records, ends, stopped: false }))
    }
}

impl LiveRecords {
    /// Puts the next records, or none after a while without any, in the place of what is in `records`; false after Ctrl-C
    /// or the end of the time, when everything that was captured has been handed out.
    pub fn next_batch(&mut self, records: &mut Vec<TraceRecord>) -> anyhow::Result<bool> {
        if !self.stopped && (interrupt::requested() || self.ends.is_some_and(|ends| Instant::now() >= ends)) {
            self.device.stop()?;
            self.stopped = true;
        }
        let Some(batch) = self.records.next_batch(LOOK_EVERY)? else {
            records.clear();
            return Ok(false);
        };
        self.records.recycle(std::mem::replace(records, batch));
        Ok(true)
    }
}
