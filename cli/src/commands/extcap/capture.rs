//! A capture for Wireshark: from the device into its pipe.

use std::io;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant, SystemTime};

use anyhow::Context;
use cantap::wire::message::{ChannelConfig, Mode};
use cantap::{Channel, Device, DeviceError, TraceRecord};
use cantap_address::Address;
use cantap_formats::{Format, TraceWriter, WriteOptions, create_stream_writer};
use cantap_trace::filter::{Filter, passes};

use super::bit_rates::{BitRate, settle};
use super::pipe::Opening;
use super::toolbar::{Change, Toolbar};
use super::traffic::Traffic;
use crate::{args, exit, stderr};
use cantap_work::Losses;
use cantap_work::advice;
use cantap_work::boards::Boards;
use cantap_work::channel_options::{self, ChannelOptions};
use cantap_work::interrupt;
use cantap_work::live::{Line, LiveRecords};
use cantap_work::report::Reporter;

/// The longest delay of captured records while there are more; on a quiet bus they are passed on immediately. Two saturated channels
/// have 208 frames in this time.
const FLUSH_EVERY: Duration = Duration::from_millis(5);
/// A reader gets no more packets than this at once, with a pause before the next ones. dumpcap queues what it reads from several interfaces,
/// and discards everything beyond 1000 packets (its option -N, which tshark and Wireshark do not pass on).
const MOST_AT_ONCE: usize = 250;
const PAUSE: Duration = Duration::from_millis(1);
/// How often Wireshark is told how many frames each channel has had and lost. A reader that is gone is noticed within that
/// time.
const STATISTICS_EVERY: Duration = Duration::from_secs(1);
/// Wireshark opens its pipe within this time, or never.
const PIPE_PATIENCE: Duration = Duration::from_secs(30);
/// After a failure, it opens it within this time.
const GRACE: Duration = Duration::from_secs(3);
/// The program ends this long after the request to end, even if nobody reads its last messages, and with it the board falls
/// silent.
const LAST_WORDS: Duration = Duration::from_secs(3);

/// The requested capture.
pub struct Wanted {
    /// An error is reported once Wireshark's pipe is open.
    pub address: anyhow::Result<Address>,
    pub bit_rates: [BitRate; 2],
    pub mode: Mode,
    pub filters: Vec<Filter>,
    pub pipe: PathBuf,
    pub toolbar: Toolbar,
}

/// Captures until Wireshark stops it, or reads no more.
pub fn run(wanted: &Wanted) -> anyhow::Result<ExitCode> {
    interrupt::watch()?;
    std::thread::Builder::new().name("cantap-extcap-end".to_owned()).spawn(end_anyway)?;
    let pipe = Opening::start(&wanted.pipe)?;
    let captured = open(wanted, &pipe);
    if captured.is_err() {
        // Without a pipe that somebody opens and closes, tshark 4.0 waits for ever and shows no error.
        let _ = pipe.wait(GRACE);
    }
    captured.map(|()| ExitCode::SUCCESS)
}

/// Wireshark has gone without closing its pipe, or no longer reads from it.
fn end_anyway() {
    while !interrupt::requested() {
        std::thread::sleep(LAST_WORDS / 10);
    }
    std::thread::sleep(LAST_WORDS);
    std::process::exit(exit::FAILURE.into());
}

fn open(wanted: &Wanted, pipe: &Opening) -> anyhow::Result<()> {
    let screen = &wanted.toolbar.screen;
    let mut report = |text: &str| screen.report(text);
    let address = wanted.address.as_ref().map_err(|error| anyhow::anyhow!("{error}"))?;
    let (channels, rates) = settle(wanted.bit_rates, address, &mut report)?;
    let numbers: Vec<String> = channels.iter().map(u8::to_string).collect();
    let channels = args::channels(&numbers.join(",")).map_err(anyhow::Error::msg)?;
    let boards = Boards::new(std::slice::from_ref(address), &channels)?;
    let mut how = ChannelOptions::listening(rates);
    how.mode = Some(wanted.mode);
    let mut live = LiveRecords::open(&boards, &how, &[], None, &stderr::reporter())?;
    let opened = pipe.wait(PIPE_PATIENCE).with_context(|| {
        format!(
            "cannot write to '{}'; Wireshark makes this pipe and names it with --fifo",
            wanted.pipe.display()
        )
    })?;
    let Some(opened) = opened else {
        live.end()?;
        anyhow::ensure!(interrupt::requested(), "nobody reads '{}'", wanted.pipe.display());
        return Ok(());
    };
    if screen.is_there() {
        let screen = screen.clone();
        live.report_to(Reporter::new(move |_, text| screen.report(text)));
    }
    let options = WriteOptions {
        format: Some(Format::Pcapng),
        channels: live.channels(),
        statistics_every: Some(STATISTICS_EVERY),
        ..WriteOptions::default()
    };
    let writer = create_stream_writer(Box::new(opened), &options)?;
    Capture { wanted, live, writer, traffic: Traffic::default(), remarks: Vec::new() }.run()
}

/// A running capture.
struct Capture<'w> {
    wanted: &'w Wanted,
    live: LiveRecords,
    writer: Box<dyn TraceWriter>,
    traffic: Traffic,
    /// Remarks for the next packet of a channel, from this time on.
    remarks: Vec<(u8, i64, String)>,
}

/// Whether anybody still reads.
fn is_read(written: io::Result<()>) -> anyhow::Result<bool> {
    match written {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(error).context("Wireshark's pipe takes nothing more"),
    }
}

impl Capture<'_> {
    fn run(mut self) -> anyhow::Result<()> {
        let copied = self.copy();
        let counters = self.live.lines().lines().map(Line::counters);
        let lost = counters.map(|counters| Losses::of(&counters)).fold(Losses::default(), Losses::plus);
        // Wireshark shows these messages when the capture has ended.
        if lost.total() > 0 || lost.off_bus > 0 {
            eprintln!("cantap: frames were lost, which is marked where they are missing: {}", lost.line());
        } else if !lost.is_none() {
            eprintln!("cantap: frames may be missing that nobody counted: {}", lost.line());
        }
        let finished = self.writer.finish().map(|_| ());
        copied?;
        is_read(finished).map(|_| ())
    }

    fn copy(&mut self) -> anyhow::Result<()> {
        let screen = &self.wanted.toolbar.screen;
        screen.begin();
        self.show_channels();
        // Write the header, so that Wireshark immediately shows that it is capturing.
        let mut goes_on = is_read(self.writer.flush())?;
        let mut batch = Vec::new();
        let (mut flushed, mut shown) = (Instant::now(), Instant::now());
        let mut at_once = 0;
        while goes_on && self.live.next_batch(&mut batch)? {
            for record in &batch {
                self.traffic.push(record);
                if self.wanted.accepts(record) {
                    self.remark(record);
                    goes_on = goes_on && is_read(self.writer.write(record))?;
                    at_once += 1;
                }
                if goes_on && at_once == MOST_AT_ONCE {
                    goes_on = is_read(self.writer.flush())?;
                    std::thread::sleep(PAUSE);
                    at_once = 0;
                }
            }
            if batch.is_empty() || flushed.elapsed() >= FLUSH_EVERY {
                goes_on = goes_on && is_read(self.writer.flush())?;
                flushed = Instant::now();
                at_once = 0;
            }
            if shown.elapsed() >= STATISTICS_EVERY {
                self.traffic.show(screen, shown.elapsed());
                shown = Instant::now();
            }
            for change in self.wanted.toolbar.changes() {
                self.change(change);
            }
        }
        if goes_on { Ok(()) } else { self.live.end() }
    }

    fn show_channels(&mut self) {
        for (_, device) in self.live.lines().devices() {
            let clock_hz = device.hello().can_clock_hz;
            for (channel, config) in device.open_channels() {
                let Some(bitrate_bps) = config.timing.known_bitrate_bps(clock_hz) else { continue };
                self.wanted.toolbar.screen.show_channel(channel, bitrate_bps, config.mode);
                self.traffic.set_bit_rate(channel.number(), bitrate_bps);
            }
        }
    }

    /// Passes the writer the remarks that are due with this record.
    fn remark(&mut self, record: &TraceRecord) {
        if self.remarks.is_empty() {
            return;
        }
        let is_due = |(channel, after_ns, _): &mut (u8, i64, String)| {
            *channel == record.channel && *after_ns <= record.time_ns
        };
        for (channel, _, text) in self.remarks.extract_if(.., is_due) {
            self.writer.remark(channel, &text);
        }
    }

    /// Opens channels again, as the user wants them. Failures are reported, and the capture continues as
    /// before.
    fn change(&mut self, change: Change) {
        let screen = &self.wanted.toolbar.screen;
        let Some((_, device)) = self.live.lines().devices().next() else {
            screen.report("the device is not there; nothing was changed");
            return;
        };
        let clock_hz = device.hello().can_clock_hz;
        for (channel, config) in device.open_channels() {
            let number = channel.number();
            let changed = match change {
                Change::BitRate(of, bitrate_bps) if of == channel => {
                    device.timing(bitrate_bps).map(|timing| ChannelConfig { timing, ..config })
                }
                Change::BitRate(..) => continue,
                Change::Mode(mode) => Ok(ChannelConfig { mode, ..config }),
            };
            let reopened = changed.and_then(|changed| {
                if changed != config {
                    reopen(device, channel, config, changed)?;
                }
                Ok(changed)
            });
            match reopened {
                Ok(changed) => {
                    let how = format!("from here on {}", channel_options::description(&changed, clock_hz));
                    screen.report(&format!("channel {number}: {how}"));
                    self.remarks.push((number, now_ns(), how));
                }
                Err(error) => screen.report(&format!("channel {number}: {}", advice::explained(&error))),
            }
        }
        self.show_channels();
    }
}

fn reopen(
    device: &Device,
    channel: Channel,
    before: ChannelConfig,
    changed: ChannelConfig,
) -> Result<(), DeviceError> {
    device.close_channel(channel)?;
    if let Err(error) = device.open_channel(channel, Some(changed)) {
        device.open_channel(channel, Some(before))?;
        return Err(error);
    }
    Ok(())
}

fn now_ns() -> i64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}

impl Wanted {
    fn accepts(&self, record: &TraceRecord) -> bool {
        passes(&self.filters, record)
    }
}
