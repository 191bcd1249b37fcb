//! Which devices to listen to: the options of commands that read a trace or listen to buses.

use std::path::PathBuf;
use std::time::Duration;

use cantap_address::Address;
use cantap_work::boards::Boards;
use cantap_work::channel_options::ChannelOptions;
use cantap_work::channels::Channels;
use cantap_work::live::LiveRecords;
use cantap_work::requested_rate::RequestedRate;

use crate::{args, completion, stderr};

/// Which devices, and how; commands flatten this into their arguments, in addition to an input file.
#[derive(clap::Args)]
pub struct LiveArgs {
    /// Listen to a device instead of reading a file, until Ctrl-C. Repeat for several, with channels numbered
    /// consecutively.
    #[arg(short, long, conflicts_with = "input", add = completion::devices())]
    device: Vec<Address>,
    /// The channels, of the device or in the file: 1, 2, several as 1,3, or both, which means all.
    #[arg(short, long, default_value = "both", value_parser = args::channels, add = completion::channels())]
    channel: Channels,
    /// Bit rate of the bus in bit/s: 500000, 500k, 1M; or auto, to find it by listening; with a channel before it (2:250k), only
    /// for that channel. Can be repeated. Without it, the one saved on the device.
    #[arg(short, long = "bitrate", value_name = "[CHANNEL:]RATE", conflicts_with_all = ["input", "follow"], add = completion::bit_rates())]
    bitrates: Vec<RequestedRate>,
    /// How long to listen to the device, as 10, 500ms or 2m.
    #[arg(short, long, conflicts_with = "input", value_parser = args::positive_duration)]
    time: Option<Duration>,
    /// Keep intervals as the device's crystal measures them, instead of following UTC.
    #[arg(long, conflicts_with = "input")]
    device_intervals: bool,
}

impl LiveArgs {
    /// The given devices.
    pub fn devices(&self) -> impl Iterator<Item = &Address> {
        self.device.iter()
    }

    /// The channels, of the devices or in the trace.
    pub const fn channels(&self) -> &Channels {
        &self.channel
    }

    /// Opens the devices and their channels: the given ones or, without a file, the one that is connected.
    pub fn open(&self, input: Option<&PathBuf>) -> anyhow::Result<Option<LiveRecords>> {
        if input.is_some() {
            return Ok(None);
        }
        let boards = Boards::new(&self.device, &self.channel)
            .map_err(|error| for_listening(error.into(), &self.device, "without a trace to read"))?;
        listen(&boards, &self.bitrates, self.time, self.device_intervals).map(Some)
    }
}

/// Only listens, at these bit rates or otherwise the saved ones, until Ctrl-C or the end of the time.
pub fn listen(
    boards: &Boards,
    bitrates: &[RequestedRate],
    time: Option<Duration>,
    device_intervals: bool,
) -> anyhow::Result<LiveRecords> {
    let open = ChannelOptions { device_intervals, ..ChannelOptions::listening(bitrates.to_vec()) };
    LiveRecords::open(boards, &open, &[], time, &stderr::reporter())
}

/// The answer to `-b auto` for a trace.
pub const AUTO_NEEDS_A_DEVICE: &str = "-b auto listens to a device, and a trace cannot be listened to; give the bus's bit rate, such as -b 500k";

/// An error about a device that nobody named: it says why one is needed.
pub fn for_listening(error: anyhow::Error, given: &[Address], without: &str) -> anyhow::Error {
    if !given.is_empty() {
        return error;
    }
    let pipe = if is_piped() { " (what comes through a pipe is read with - for its name)" } else { "" };
    error.context(format!("{without}{pipe}, a device is listened to"))
}

/// Whether standard input is another program's output.
fn is_piped() -> bool {
    #[cfg(unix)]
    {
        use std::os::unix::fs::FileTypeExt;
        std::fs::metadata("/dev/stdin").is_ok_and(|input| input.file_type().is_fifo())
    }
    #[cfg(not(unix))]
    false
}
