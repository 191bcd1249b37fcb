//! Where to talk to nodes: the options of commands that do.

use std::io::Write as _;

use cantap::Channel;
use cantap::wire::message::Mode;
use cantap_address::{Address, OpenDevice};
use cantap_protocols::{Assembler, Event};
use cantap_work::boards::the_one_connected;
use cantap_work::channel_options::ChannelOptions;
use cantap_work::interrupt;
use cantap_work::requested_rate::RequestedRate;
use cantap_work::speaking::Speaking;

use crate::commands::conversations;
use crate::{args, completion, stderr};

/// Where to talk; commands flatten this into their arguments.
#[derive(clap::Args)]
pub struct SpeakArgs {
    /// Where the device is: a serial port, or virtual. Without it, the board that is connected, if there is one.
    #[arg(short, long, global = true, add = completion::devices())]
    device: Option<Address>,
    /// The channel to talk on: 1 or 2.
    #[arg(short, long, global = true, default_value = "1", value_parser = args::channel, add = completion::channels())]
    channel: Channel,
    /// Bit rate of the bus in bit/s: 500000, 500k, 1M; or auto, to find it by listening before anything is sent. Without it, the one saved on
    /// the device.
    #[arg(short, long = "bitrate", value_name = "[CHANNEL:]RATE", global = true, add = completion::bit_rates())]
    bitrates: Vec<RequestedRate>,
    /// Print one JSON object per line.
    #[arg(long, global = true)]
    pub json: bool,
}

impl SpeakArgs {
    /// Begins a session with the device, and opens the channel: from now on it acknowledges, and sends what it is asked
    /// to.
    pub fn open(&self) -> anyhow::Result<OpenDevice> {
        self.open_in(Mode::Normal)
    }

    /// The channel.
    pub const fn channel(&self) -> Channel {
        self.channel
    }

    /// As [`Self::open`], but the channel only listens.
    pub fn listen(&self) -> anyhow::Result<OpenDevice> {
        self.open_in(Mode::ListenOnly)
    }

    fn open_in(&self, mode: Mode) -> anyhow::Result<OpenDevice> {
        interrupt::watch()?;
        let device = self.device.clone().map_or_else(the_one_connected, Ok)?.open()?;
        let reporter = stderr::reporter();
        self.channel_options().open(&device, [self.channel].into_iter(), mode, None, &reporter)?;
        Ok(device)
    }

    fn channel_options(&self) -> ChannelOptions {
        ChannelOptions::listening(self.bitrates.clone())
    }

    /// Starts talking over the device; what is said is printed as `conversations` does.
    pub fn speak<'d>(&self, device: &'d OpenDevice, witness: Box<dyn Assembler>) -> Speaking<'d> {
        let json = self.json;
        let print = move |event: &Event| {
            let mut out = std::io::stdout().lock();
            conversations::write(&mut out, event, json)?;
            out.flush()
        };
        let recovery = self.channel_options().bus_off_recovery(&stderr::reporter());
        Speaking::new(device, self.channel, recovery, witness, Box::new(print), stderr::reporter())
    }
}
