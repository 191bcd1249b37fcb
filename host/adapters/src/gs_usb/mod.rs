//! gs_usb adapters without a kernel driver, on every system: candleLight, CANable with its firmware, CANnectivity and others.
//!
//! CAN FD is switched on where the address gives a data bit rate, which would otherwise have to be guessed: without it, each CAN FD frame on the
//! bus is an error.

mod pipes;
mod usb;
mod wire;

use std::time::{Duration, Instant};

use cantap_wire::record::LossStage;
use cantap_wire::{CHANNELS, Channel, FdFrame, Frame, Refusal};

use self::pipes::Usb;
use self::usb::UsbAdapter;
use self::wire::{Constants, Content, HOST_FORMAT, RECEIVED, Transfer, feature, request, words};
use crate::adapter_clock::AdapterClock;
use crate::driver::{At, Driver, Incoming, Oddities, OpenError, Opening};
use crate::error_frames::ErrorFrames;
use crate::rows::{Row, row};

/// How often the state is asked for, where it can be.
const ASK_EVERY: Duration = Duration::from_secs(1);
/// Time limit for an answer before a channel is open, and afterwards, when frames wait for it.
const GREETED_WITHIN: Duration = Duration::from_secs(1);
const ANSWER_WITHIN: Duration = Duration::from_millis(100);
/// Transfers that one call of [`Driver::poll`] takes.
const TRANSFERS: usize = 256;
/// As often at the end.
const CALLS_AT_THE_END: usize = 4;
/// After a channel was switched off, what was received before comes within this time.
const QUIET: Duration = Duration::from_millis(20);
/// Frames of a channel under way: the firmware here has three mailboxes.
const MAILBOXES: usize = 3;

/// One channel.
struct Can {
    constants: Constants,
    is_open: bool,
    in_flight: [bool; MAILBOXES],
    errors: ErrorFrames,
    /// It answers when asked for its state.
    tells_state: bool,
}

/// What an address asks for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Options {
    /// Whether to switch the resistor on or off; as it is if nothing is said.
    pub termination: Option<bool>,
    /// The bit rate of CAN FD's data phases, in bit/s; without it CAN FD stays off.
    pub data_bitrate_bps: Option<u32>,
}

/// The driver.
pub(crate) struct GsUsb {
    usb: Box<dyn Usb>,
    row: &'static Row,
    serial: String,
    version: u32,
    channels: Vec<Can>,
    options: Options,
    clock: AdapterClock,
    asked: Instant,
    /// Until when it shows which one it is.
    identifies_until: Option<Instant>,
    backlog: Vec<Incoming>,
    oddities: Oddities,
    ended: Option<String>,
}

impl GsUsb {
    /// The adapter with a serial number, or the only one.
    pub fn connect(serial: &str, options: Options, address: &str) -> Result<Self, OpenError> {
        let (usb, serial) = UsbAdapter::open(serial, address)?;
        Self::over(Box::new(usb), serial, options, address)
    }

    fn over(
        mut usb: Box<dyn Usb>,
        serial: String,
        options: Options,
        address: &str,
    ) -> Result<Self, OpenError> {
        let foreign = || OpenError::Foreign { address: address.to_owned(), expected: "a gs_usb adapter" };
        usb.control_out(request::HOST_FORMAT, 1, &HOST_FORMAT).map_err(|_| foreign())?;
        let device = usb.control_in(request::DEVICE_CONFIG, 1, 12, GREETED_WITHIN).map_err(|_| foreign())?;
        let (count, version) = wire::device(&device).ok_or_else(foreign)?;
        let mut oddities = Oddities::default();
        if usize::from(count) > CHANNELS {
            oddities.count("channels after the second, which are not used");
        }
        let mut channels = Vec::new();
        for number in 0..count.min(CHANNELS as u16) {
            let constants =
                usb.control_in(request::CONSTANTS, number, 40, GREETED_WITHIN).map_err(|_| foreign())?;
            let mut constants = Constants::parse(&constants).ok_or_else(foreign)?;
            if let Some(data_bitrate_bps) = options.data_bitrate_bps {
                if constants.has(feature::FD) && constants.has(feature::EXTENDED_CONSTANTS) {
                    let extended = usb.control_in(request::EXTENDED_CONSTANTS, number, 72, GREETED_WITHIN);
                    constants =
                        extended.ok().and_then(|bytes| Constants::parse(&bytes)).ok_or_else(foreign)?;
                }
                if constants.data_timing(data_bitrate_bps).is_none() {
                    let address = address.to_owned();
                    return Err(OpenError::NoDataBitRate { address, data_bitrate_bps });
                }
            }
            if options.termination.is_some() && !constants.has(feature::TERMINATION) {
                return Err(OpenError::NoTermination { address: address.to_owned() });
            }
            channels.push(Can {
                tells_state: constants.has(feature::STATE),
                constants,
                is_open: false,
                in_flight: [false; MAILBOXES],
                errors: ErrorFrames::default(),
            });
        }
        let mut adapter = Self {
            row: row_of(&channels, usb.confirms()),
            usb,
            serial,
            version,
            channels,
            options,
            clock: AdapterClock::new(1_000, 1 << 32),
            asked: Instant::now(),
            identifies_until: None,
            backlog: Vec::new(),
            oddities,
            ended: None,
        };
        // Another program may have left them on.
        for number in 0..adapter.channels.len() {
            adapter.switch_off(number).map_err(|_| foreign())?;
        }
        Ok(adapter)
    }

    fn switch_off(&mut self, number: usize) -> Result<(), String> {
        self.usb.control_out(request::MODE, number as u16, &words(&[0, 0]))
    }

    fn start(&mut self, number: usize, opening: Opening) -> Result<(), Refusal> {
        let constants = self.channels[number].constants.clone();
        if opening.listen_only && !constants.has(feature::LISTEN_ONLY) {
            return Err(Refusal::Unsupported);
        }
        let timing =
            constants.timing(opening.bitrate_bps, opening.sample_point_permille).ok_or(Refusal::BadTiming)?;
        let mut flags = constants.features & (feature::STAMPS | feature::BUS_ERRORS);
        if opening.listen_only {
            flags |= feature::LISTEN_ONLY;
        }
        let data_timing = match self.options.data_bitrate_bps {
            Some(data_bitrate_bps) => {
                flags |= feature::FD;
                Some(constants.data_timing(data_bitrate_bps).ok_or(Refusal::BadTiming)?)
            }
            None => None,
        };
        let mut set = |request, data: &[u8]| {
            self.usb.control_out(request, number as u16, data).map_err(|_| Refusal::Hardware)
        };
        if let Some(is_on) = self.options.termination {
            set(request::SET_TERMINATION, &words(&[u32::from(is_on)]))?;
        }
        set(request::BIT_TIMING, &timing)?;
        if let Some(data_timing) = data_timing {
            set(request::DATA_BIT_TIMING, &data_timing)?;
        }
        set(request::MODE, &words(&[1, flags]))
    }

    fn take(&mut self, bytes: &[u8], arrival: Instant) {
        // Each channel has stamps or has not; those of one adapter are alike.
        let stamps = self.channels.iter().any(|can| can.constants.has(feature::STAMPS));
        let first = self.channels.iter().position(|can| can.is_open).unwrap_or(0);
        let read = wire::transfer(bytes, stamps);
        let Some(transfer) = read.filter(|transfer| usize::from(transfer.channel) < self.channels.len())
        else {
            return self.damaged(first, At::arrival(arrival));
        };
        let number = usize::from(transfer.channel);
        let Some(channel) = Channel::from_number(transfer.channel + 1) else { return };
        let at = match transfer.stamp_us {
            Some(stamp_us) => self.clock.place(stamp_us.into(), arrival, &mut self.oddities),
            None => At::arrival(arrival),
        };
        if transfer.overflow {
            let stage = LossStage::Controller;
            self.backlog.push(Incoming::Lost { channel, stage, count: 1, at_least: true, at });
        }
        if transfer.echo != RECEIVED {
            return self.confirm(number, channel, &transfer, at);
        }
        match transfer.content {
            Content::Frame(frame) => self.backlog.push(Incoming::Received { channel, frame, at }),
            Content::Error(error) => {
                let errors = &mut self.channels[number].errors;
                errors.take(error, channel, at, &mut self.backlog, &mut self.oddities);
            }
            Content::Impossible => self.damaged(number, at),
        }
    }

    fn confirm(&mut self, number: usize, channel: Channel, transfer: &Transfer, at: At) {
        let slot = self.channels[number].in_flight.get_mut(transfer.echo as usize);
        match slot.filter(|is_in_flight| **is_in_flight) {
            Some(is_in_flight) => {
                *is_in_flight = false;
                self.backlog.push(Incoming::Sent { channel, mailbox: transfer.echo as u8, at });
            }
            None => self.oddities.count("confirmations of frames that were not under way"),
        }
    }

    /// Something came that cannot be read: at least one frame may be missing.
    fn damaged(&mut self, number: usize, at: At) {
        self.oddities.count("transfers that cannot be read");
        if let Some(channel) = Channel::from_number(number as u8 + 1) {
            let stage = LossStage::Link;
            self.backlog.push(Incoming::Lost { channel, stage, count: 1, at_least: true, at });
        }
    }

    /// Takes what comes within `wait`, and what has come with it.
    fn receive(&mut self, wait: Duration) -> bool {
        let mut wait = wait;
        for taken in 0..TRANSFERS {
            match self.usb.next(wait) {
                Ok(Some(piece)) => self.take(&piece.content, piece.at),
                Ok(None) => return taken > 0,
                Err(reason) => {
                    self.ended.get_or_insert(reason);
                    return taken > 0;
                }
            }
            wait = Duration::ZERO;
        }
        true
    }

    /// Gives a frame to the adapter. Returns false if it cannot take it now.
    fn write(&mut self, channel: Channel, mailbox: u8, mut bytes: Vec<u8>) -> bool {
        let can = &mut self.channels[channel.index()];
        let Some(slot @ false) = can.in_flight.get_mut(usize::from(mailbox)) else { return false };
        if can.constants.has(feature::LPC546XX) {
            bytes.push(0);
        }
        match self.usb.write(bytes) {
            Ok(is_taken) => {
                *slot = is_taken;
                is_taken
            }
            Err(reason) => {
                self.ended.get_or_insert(reason);
                self.backlog.push(Incoming::NotSent { channel, mailbox, at: At::arrival(Instant::now()) });
                true
            }
        }
    }

    /// Asks for the states, and ends what was to last for a time.
    fn look_after_time(&mut self) {
        let now = Instant::now();
        if self.identifies_until.is_some_and(|until| until <= now) {
            self.identifies_until = None;
            // If it goes on, it does no harm.
            let _ = self.usb.control_out(request::IDENTIFY, 0, &words(&[0]));
        }
        if now.duration_since(self.asked) < ASK_EVERY {
            return;
        }
        self.asked = now;
        for (number, channel) in Channel::ALL.into_iter().enumerate().take(self.channels.len()) {
            let can = &mut self.channels[number];
            if !can.is_open || !can.tells_state {
                continue;
            }
            let answer = self.usb.control_in(request::STATE, number as u16, 12, ANSWER_WITHIN);
            match answer.map(|bytes| wire::state(&bytes)) {
                Ok(Some((Some(state), counters))) => {
                    can.errors.set(state, Some(counters), channel, At::arrival(now), &mut self.backlog);
                }
                Ok(Some((None, _))) => {}
                _ => {
                    // Its error frames tell the state, too, and frames need not wait for this again.
                    can.tells_state = false;
                    self.oddities.count("questions for the state that were not answered");
                }
            }
        }
    }
}

/// What such an adapter can tell.
fn row_of(channels: &[Can], confirms: bool) -> &'static Row {
    let has = |feature| channels.iter().all(|can| can.constants.has(feature));
    let board = match (has(feature::LISTEN_ONLY), has(feature::STAMPS)) {
        (true, true) if confirms => "gs_usb-confirmed",
        (true, false) if confirms => "gs_usb-arrival-confirmed",
        (true, true) => "gs_usb",
        (true, false) => "gs_usb-arrival",
        (false, true) => "gs_usb-normal",
        (false, false) => "gs_usb-arrival-normal",
    };
    row(board).unwrap_or(&crate::ROWS[0])
}

impl Driver for GsUsb {
    fn row(&self) -> &'static Row {
        self.row
    }

    fn channels(&self) -> u8 {
        self.channels.len() as u8
    }

    fn serial(&self) -> String {
        self.serial.clone()
    }

    fn version(&self) -> [u16; 3] {
        [self.version as u16, 0, 0]
    }

    fn open(&mut self, channel: Channel, opening: Opening) -> Result<(), Refusal> {
        let number = channel.index();
        let started = self.start(number, opening);
        if started == Err(Refusal::Hardware) {
            // Half set, it might acknowledge frames, or destroy them.
            let _ = self.switch_off(number);
        }
        self.channels[number].is_open = started.is_ok();
        started
    }

    fn close(&mut self, channel: Channel) {
        let number = channel.index();
        // If that fails, so will the next read, which has the reason.
        let _ = self.switch_off(number);
        // As much as can wait, here and in the adapter; what comes after that is of the other channel.
        for _ in 0..CALLS_AT_THE_END {
            if self.ended.is_some() || !self.receive(QUIET) {
                break;
            }
        }
        let can = &mut self.channels[number];
        (can.is_open, can.in_flight, can.errors) = (false, [false; MAILBOXES], ErrorFrames::default());
    }

    fn send(&mut self, channel: Channel, mailbox: u8, frame: &Frame) -> bool {
        let bytes = wire::frame(frame, channel.index() as u8, mailbox.into());
        self.write(channel, mailbox, bytes)
    }

    fn sends_fd(&self) -> bool {
        self.options.data_bitrate_bps.is_some()
    }

    fn send_fd(&mut self, channel: Channel, mailbox: u8, frame: &FdFrame) -> bool {
        let bytes = wire::fd_frame(frame, channel.index() as u8, mailbox.into());
        self.write(channel, mailbox, bytes)
    }

    fn identify(&mut self, seconds: u8) -> Result<(), Refusal> {
        if !self.channels.first().is_some_and(|can| can.constants.has(feature::IDENTIFY)) {
            return Err(Refusal::Unsupported);
        }
        self.usb.control_out(request::IDENTIFY, 0, &words(&[1])).map_err(|_| Refusal::Hardware)?;
        self.identifies_until = Some(Instant::now() + Duration::from_secs(seconds.into()));
        Ok(())
    }

    fn poll(&mut self, wait: Duration, reports: &mut Vec<Incoming>) -> Result<(), String> {
        if self.ended.is_none() {
            self.look_after_time();
            let wait = if self.backlog.is_empty() { wait } else { Duration::ZERO };
            self.receive(wait);
        }
        reports.append(&mut self.backlog);
        self.ended.clone().map_or(Ok(()), Err)
    }

    fn oddities(&self) -> (u32, String) {
        self.oddities.summary()
    }
}

#[cfg(test)]
mod tests;
