//! The records of devices, each listened to whenever it is there.

use std::fmt::Write;
use std::time::{Duration, Instant};

use anyhow::{anyhow, bail};
use cantap::device::{Happening, Reconnecting, Return, Several, channel_number};
use cantap::wire::message::{ChannelConfig, Mode};
use cantap::{Channel, TraceRecord};
use cantap_address::{Address, OpenDevice};
use cantap_formats::ChannelInfo;

use crate::boards::{Boards, filters_on};
use crate::bus_hints::{BusHint, HintPlace};
use crate::channel_options::{self, ChannelOptions};
use crate::channels::place_of;
use crate::reception::Reception;
use crate::report::Reporter;
use crate::{advice, interrupt};

/// How often to check whether to continue while nothing arrives.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// A device with which the program continues when it is back; errors are shown to the user.
pub type Line = Reconnecting<OpenDevice, anyhow::Error>;
/// Several of them.
pub type Lines = Several<OpenDevice, anyhow::Error>;

/// Opens the devices, each as soon as it is there; `setup` opens the channels of the one with that index,
/// from 0.
pub fn lines<S>(addresses: &[Address], setup: S) -> Lines
where
    S: FnMut(usize, &OpenDevice) -> anyhow::Result<()> + Clone + Send + 'static,
{
    let line = |(board, address): (usize, &Address)| {
        let (at, mut setup) = (address.clone(), setup.clone());
        let connect = move |serial: Option<&str>| Ok(at.open_again(serial)?);
        Line::new(&address.to_string(), connect, move |device| setup(board, device))
    };
    Several::new(addresses.iter().enumerate().map(line).collect())
}

/// The records received by devices.
pub struct LiveRecords {
    lines: Lines,
    addresses: Vec<Address>,
    ends: Option<Instant>,
    /// Devices that have been away for this long are given up.
    give_up_after: Option<Duration>,
    /// The result of stopping.
    stopped: Option<anyhow::Result<()>>,
    reception: Reception,
    /// There may be frames although none is received, so silence means nothing.
    is_filtered: bool,
    reporter: Reporter,
}

impl LiveRecords {
    /// Opens the boards' channels, which only listen unless `open` does otherwise, until Ctrl-C or the end of the time.
    pub fn open(
        boards: &Boards,
        open: &ChannelOptions,
        filters: &[cantap_trace::filter::Filter],
        time: Option<Duration>,
        reporter: &Reporter,
    ) -> anyhow::Result<Self> {
        open.timing.check_channels(boards.addresses().len())?;
        let (setup_boards, open, setup_filters) = (boards.clone(), open.clone(), filters.to_vec());
        let setup_reporter = reporter.clone();
        let mut lines = lines(boards.addresses(), move |board, device| {
            let (open, filters) = (open.on_board(board), filters_on(board, &setup_filters));
            let channels = setup_boards.channels_of(board);
            open.open(device, channels, Mode::ListenOnly, Some(&filters), &setup_reporter).map(|_| ())
        });
        // Up to here, Ctrl-C ends the program: nothing has been captured.
        lines.connect()?;
        interrupt::watch()?;
        let mut live = Self {
            lines,
            addresses: boards.addresses().to_vec(),
            ends: time.map(|time| Instant::now() + time),
            give_up_after: None,
            stopped: None,
            reception: Reception::default(),
            is_filtered: !filters.is_empty(),
            reporter: reporter.clone(),
        };
        live.is_filtered |= !live.filtered().is_empty();
        Ok(live)
    }

    /// From now on, reports there.
    pub fn report_to(&mut self, reporter: Reporter) {
        self.reporter = reporter;
    }

    /// Ends with an error when every device has been away for this long.
    pub fn give_up_after(&mut self, time: Option<Duration>) {
        self.give_up_after = time;
    }

    /// The devices, whether connected or not.
    pub const fn lines(&self) -> &Lines {
        &self.lines
    }

    /// The bit rates of the open channels that are known, by number, in bit/s.
    pub fn bit_rates(&self) -> Vec<(u8, u32)> {
        let known = |(number, config, clock_hz): (u8, ChannelConfig, u32)| {
            Some((number, config.timing.known_bitrate_bps(clock_hz)?))
        };
        self.opened().filter_map(known).collect()
    }

    /// The bit rates of their data phases that are known, by number, in bit/s.
    pub fn data_bit_rates(&self) -> Vec<(u8, u32)> {
        let known = |(board, device): (usize, &cantap::Device)| {
            let open = device.open_channels().into_iter();
            let of = |(channel, _)| Some((channel_number(board, channel), device.data_bitrate(channel)?));
            open.filter_map(of).collect::<Vec<_>>()
        };
        self.lines.devices().flat_map(known).collect()
    }

    /// The open channels, by number, each with its configuration and its controller's clock in Hz.
    pub fn opened(&self) -> impl Iterator<Item = (u8, ChannelConfig, u32)> {
        self.lines.devices().flat_map(|(board, device)| {
            let clock_hz = device.hello().can_clock_hz;
            let opened = device.open_channels().into_iter();
            opened.map(move |(channel, config)| (channel_number(board, channel), config, clock_hz))
        })
    }

    /// The open channels, by number, of which the device's filters keep frames back, whether given now or saved.
    pub fn filtered(&self) -> Vec<u8> {
        let filtered = |(board, device): (usize, &cantap::Device)| {
            let of_device = Channel::ALL.into_iter().filter(|channel| device.is_filtered(*channel));
            of_device.map(|channel| channel_number(board, channel)).collect::<Vec<_>>()
        };
        self.lines.devices().flat_map(filtered).collect()
    }

    /// The open channels, described for files.
    pub fn channels(&self) -> Vec<ChannelInfo> {
        let info = |(number, config, clock_hz): (u8, ChannelConfig, u32)| {
            let (board, channel) = place_of(number);
            let address = self.addresses.get(board).map(ToString::to_string).unwrap_or_default();
            let how = channel_options::description(&config, clock_hz);
            ChannelInfo {
                channel: number,
                bitrate_bps: config.timing.known_bitrate_bps(clock_hz),
                description: format!("channel {} of {address}, {how}", channel.number()),
            }
        };
        self.opened().map(info).collect()
    }

    /// Their addresses.
    pub fn addresses(&self) -> &[Address] {
        &self.addresses
    }

    /// At the end: says what it means that channels received errors but no frame, unless that was already reported; an error if
    /// nothing else was received at all, since that must not look like success. With a filter in the device, there may still be
    /// frames.
    pub fn judge(&self) -> anyhow::Result<()> {
        if self.is_filtered {
            return Ok(());
        }
        let mut deaf = self.reception.deaf();
        if !self.reception.has_frames()
            && let Some(first) = deaf.next()
        {
            bail!(self.errors_only(first));
        }
        for number in deaf.filter(|number| !self.reception.is_reported(*number)) {
            self.reporter.warn(self.errors_only(number));
        }
        Ok(())
    }

    /// What it means that a channel receives only errors, and what to do.
    fn errors_only(&self, number: u8) -> String {
        self.sentence(number, self.reception.hint(number, false).unwrap_or(BusHint::WrongBitRate))
    }

    /// What is the matter with a channel's bus, as far as its errors and its silence show it. A channel is silent only if all are:
    /// often not every channel is connected.
    pub fn hint(&self, number: u8) -> Option<BusHint> {
        let hint = self.reception.hint(number, self.is_filtered)?;
        (hint != BusHint::Silent || !self.reception.has_frames()).then_some(hint)
    }

    /// A hint about a channel as a sentence, with what to do next; `None` if [`Self::judge`] or the stream has its own for it.
    pub fn hint_sentence(&self, number: u8) -> Option<String> {
        let hint = self.hint(number)?;
        let is_deaf = !self.is_filtered && self.reception.deaf().any(|deaf| deaf == number);
        (!is_deaf).then(|| self.sentence(number, hint))
    }

    fn sentence(&self, number: u8, hint: BusHint) -> String {
        let (board, channel) = place_of(number);
        let device = self.addresses.get(board).map(ToString::to_string).unwrap_or_default();
        hint.sentence(&HintPlace { number, device: &device, channel_there: channel.number() })
    }

    /// Ends the capture: the rest comes from [`Self::next_batch`], with an error at its end if a device did not end
    /// properly.
    pub fn stop(&mut self) {
        if self.stopped.is_none() {
            let mut errors = self.lines.stop().into_iter();
            let first = errors.next();
            for error in errors {
                self.reporter.note(advice::sentence(&error));
            }
            self.stopped = Some(first.map_or(Ok(()), Err));
        }
    }

    /// Ends the capture and discards the rest.
    pub fn end(&mut self) -> anyhow::Result<()> {
        self.stop();
        self.stopped.take().unwrap_or(Ok(()))
    }

    /// Whether Ctrl-C or the end of the time has come.
    fn is_over(&self) -> bool {
        interrupt::requested() || self.ends.is_some_and(|ends| Instant::now() >= ends)
    }

    /// Whether all devices have been away for so long that they are given up.
    fn has_given_up(&self) -> bool {
        self.give_up_after.is_some_and(|patience| {
            self.lines.lines().all(|line| line.away_for().is_some_and(|away| away >= patience))
        })
    }

    /// Replaces the content of `records` with the next records, or none if there were none for a while; false after Ctrl-C
    /// or the end of the time, when everything captured has been returned. Reports when a device goes,
    /// when it is back, and when a channel receives nothing but errors.
    pub fn next_batch(&mut self, records: &mut Vec<TraceRecord>) -> anyhow::Result<bool> {
        if self.is_over() {
            self.stop();
        } else if self.stopped.is_none() && self.has_given_up() {
            let seconds = self.give_up_after.unwrap_or_default().as_secs_f64();
            let _ = self.lines.stop();
            self.stopped = Some(Err(anyhow!(
                "the device has been away for {seconds} s, giving up; everything captured before that is kept"
            )));
        }
        let (board, happening) = self.lines.next(LOOK_EVERY);
        match happening {
            Happening::Records(batch) => {
                self.lines.recycle(std::mem::replace(records, batch));
                self.listen_for_errors(records);
                return Ok(true);
            }
            Happening::Gone(error) if self.addresses[board].may_come_back() => {
                let reason = advice::sentence(&error);
                let rest = match self.give_up_after {
                    Some(time) => format!(
                        "it continues when the device is back within {} s; Ctrl-C ends it",
                        time.as_secs_f64()
                    ),
                    None => "it continues when the device is back; Ctrl-C ends it".to_owned(),
                };
                self.reporter.note(format!("{reason}; {rest}"));
            }
            Happening::Gone(error) => return Err(error),
            Happening::Back(back) => {
                let name = (self.addresses.len() > 1).then(|| &self.addresses[board]);
                self.reporter.note(return_text(board, name, &back));
            }
            Happening::Ended => {
                records.clear();
                return self.stopped.take().unwrap_or(Ok(())).map(|()| false);
            }
        }
        records.clear();
        Ok(true)
    }

    fn listen_for_errors(&mut self, records: &[TraceRecord]) {
        if self.is_filtered {
            return;
        }
        let now = Instant::now();
        self.reception.take(records, now);
        for number in self.reception.news(now) {
            self.reporter.warn(self.errors_only(number));
        }
    }
}

/// The message for a device that is back, with its name if there are several.
pub fn return_text(board: usize, name: Option<&Address>, back: &Return) -> String {
    let after = back.after.unwrap_or_default().as_secs_f64();
    let at = name.map_or_else(String::new, |name| format!(" at '{name}'"));
    let mut text = match &back.other_board {
        Some(other) => format!("another board is there now{at}, {other}, after {after:.1} s"),
        None => format!("the device{at} is back after {after:.1} s"),
    };
    for channel in &back.only_listening {
        let _ = write!(text, "; channel {} only listens on it", channel_number(board, *channel));
    }
    text
}
