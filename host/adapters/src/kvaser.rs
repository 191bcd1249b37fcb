//! Kvaser's adapters through CANlib, one channel each.

use std::time::{Duration, Instant};

use cantap_trace::fd::FD_LENGTHS;
use cantap_trace::{TraceFrame, clean};
use cantap_vendor::canlib::{
    self, CanLib, Error, Handle, KvaserMessage, Segments, control, flag, output, status,
};
use cantap_wire::record::{BusErrorKind, ErrorState, LossStage};
use cantap_wire::{Channel, FdFrame, Frame, Id, Refusal};

use crate::adapter_clock::AdapterClock;
use crate::bit_limits::Limits;
use crate::driver::{At, Driver, Incoming, OpenError, Opening};
use crate::library_channel::{
    Asked, LibraryChannel, MESSAGES, MESSAGES_AT_THE_END, REFUSED, TOO_LONG, poll_asked,
};
use crate::maker_options::MakerOptions;
use crate::rows::{Row, row};

/// Every Kvaser adapter's clock can be divided to a quantum of these.
const CLOCK_HZ: u32 = 16_000_000;
/// The clock of CAN FD adapters.
const FD_CLOCK_HZ: u32 = 80_000_000;

/// Which channel an address names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Which {
    /// The only one that is not virtual.
    Only,
    /// By CANlib's number, from 0.
    Number(u32),
}

/// The driver.
pub(crate) struct Kvaser {
    library: CanLib,
    number: u32,
    name: String,
    options: MakerOptions,
    handle: Option<Handle>,
    channel: LibraryChannel,
    clock: AdapterClock,
}

impl Kvaser {
    /// Finds the channel.
    pub fn connect(which: Which, options: MakerOptions, address: &str) -> Result<Self, OpenError> {
        let library = CanLib::load(options.library.as_deref())
            .map_err(|error| OpenError::Library { address: address.to_owned(), source: error })?;
        // A library that counts more channels than any computer has is not believed.
        let count = library.channels().unwrap_or(0).min(256);
        let names: Vec<(u32, String)> = (0..count)
            .map(|number| (number, clean::line(&library.name(number).unwrap_or_default()).into_owned()))
            .collect();
        let is_real = |number: &u32| library.serial(*number).is_ok_and(|serial| serial != 0);
        let real: Vec<u32> = (0..count).filter(is_real).collect();
        let number = match which {
            Which::Number(number) if number < count => number,
            Which::Only if real.len() == 1 => real[0],
            _ => {
                let there = names.iter().map(|(number, name)| format!("{number} ({name})"));
                return Err(OpenError::no_channel(address, &there.collect::<Vec<_>>()));
            }
        };
        let name = names.into_iter().nth(number as usize).map(|(_, name)| name).unwrap_or_default();
        Ok(Self {
            library,
            number,
            name,
            options,
            handle: None,
            channel: LibraryChannel::new(),
            clock: AdapterClock::new(1_000, 1 << 32),
        })
    }

    fn start(&mut self, opening: Opening) -> Result<(), Refusal> {
        let mut flags = canlib::open::ACCEPT_VIRTUAL | canlib::open::REQUIRE_INIT_ACCESS;
        if self.options.data_bitrate_bps.is_some() {
            flags |= canlib::open::CAN_FD;
        }
        let handle = self.library.open(self.number, flags).map_err(refusal)?;
        // Closed with the channel, whatever fails below.
        self.handle = Some(handle);
        let library = &self.library;
        library.control(handle, control::SET_TIMER_SCALE, 1).map_err(refusal)?;
        library.control(handle, control::SET_TRANSMIT_ACKNOWLEDGE, 1).map_err(refusal)?;
        let clock_hz = if self.options.data_bitrate_bps.is_some() { FD_CLOCK_HZ } else { CLOCK_HZ };
        let bit = nominal(clock_hz, opening).ok_or(Refusal::BadTiming)?;
        library.set_bit_rate(handle, opening.bitrate_bps, bit).map_err(timing_refusal)?;
        if let Some(data_bitrate_bps) = self.options.data_bitrate_bps {
            let bit = data(data_bitrate_bps).ok_or(Refusal::BadTiming)?;
            library.set_data_bit_rate(handle, data_bitrate_bps, bit).map_err(timing_refusal)?;
        }
        let wanted = if opening.listen_only { output::SILENT } else { output::NORMAL };
        // Before it is on the bus: afterwards it would have acknowledged frames already.
        library.set_output_control(handle, wanted).map_err(refusal)?;
        if library.output_control(handle) != Ok(wanted) {
            return Err(Refusal::Unsupported);
        }
        library.bus_on(handle).map_err(refusal)
    }

    /// Reads up to `most` messages.
    fn receive(&mut self, handle: Handle, most: usize) {
        for _ in 0..most {
            match self.library.read(handle) {
                Ok(message) => self.take(&message, Instant::now()),
                Err(Error::NO_MESSAGE) => return,
                Err(error) => return self.channel.end(&self.library.describe(error)),
            }
        }
    }

    fn take(&mut self, message: &KvaserMessage, arrival: Instant) {
        let at = self.clock.place(message.stamp_us.into(), arrival, &mut self.channel.oddities);
        // The message is the first after a loss.
        self.channel.losses_before(message.flags, LOSSES, at);
        if message.flags & flag::ERROR_FRAME != 0 {
            return self.channel.report(error_of(message.flags, at));
        }
        if message.flags & flag::TRANSMIT_REQUEST != 0 {
            return;
        }
        let is_ours = message.flags & flag::TRANSMITTED != 0;
        if self.channel.take(frame_of(message), is_ours, at).is_some() {
            self.channel.oddities.count("confirmations of frames that were not under way");
        }
    }

    /// Gives a message to the library. Returns false if it cannot take it now.
    fn write(&mut self, handle: Handle, mailbox: u8, message: &KvaserMessage, frame: TraceFrame) -> bool {
        match self.library.write(handle, message) {
            Ok(()) => self.channel.sent(mailbox, frame),
            Err(Error::TRANSMIT_FULL) => return false,
            Err(_) => self.channel.not_sent(mailbox, REFUSED),
        }
        true
    }

    /// Asks for the state, now and then.
    fn look(&mut self, handle: Handle) {
        let now = Instant::now();
        if !self.channel.asks_now(now) {
            return;
        }
        let bits = match self.library.status(handle) {
            Ok(bits) => bits,
            Err(error) => return self.channel.end(&self.library.describe(error)),
        };
        let at = At::arrival(now);
        self.channel.losses(bits, LOSSES, at);
        self.channel.forget_losses(bits);
        let state = if bits & status::BUS_OFF != 0 {
            ErrorState::BusOff
        } else if bits & status::PASSIVE != 0 {
            ErrorState::Passive
        } else if bits & status::WARNING != 0 {
            ErrorState::Warning
        } else {
            ErrorState::Active
        };
        let counters = self.library.error_counters(handle).ok();
        let counters = counters.map(|(transmit, receive)| (transmit.min(255) as u8, receive.min(255) as u8));
        self.channel.state(state, counters, at);
    }
}

/// The bits of a status that report losses. They are those of a message's flags, too.
const LOSSES: [(u32, LossStage); 2] =
    [(status::HARDWARE_OVERRUN, LossStage::Controller), (status::SOFTWARE_OVERRUN, LossStage::Queue)];

/// An error of the library as the reason why a request is refused.
const fn refusal(error: Error) -> Refusal {
    match error {
        Error::NO_ACCESS => Refusal::Held,
        Error::NOT_SUPPORTED | Error::NOT_IMPLEMENTED => Refusal::Unsupported,
        _ => Refusal::Hardware,
    }
}

/// The same for a bit timing, which the device may not have.
const fn timing_refusal(error: Error) -> Refusal {
    match error {
        Error(-1) | Error::NOT_SUPPORTED => Refusal::BadTiming,
        other => refusal(other),
    }
}

fn nominal(clock_hz: u32, opening: Opening) -> Option<Segments> {
    let limits = Limits::up_to(16, 8, 4, 1024);
    let timing = limits.nominal(clock_hz, opening.bitrate_bps, opening.sample_point_permille)?;
    Some(Segments { first: timing.segment1, second: timing.segment2, jump_width: timing.jump_width })
}

fn data(bitrate_bps: u32) -> Option<Segments> {
    let limits = Limits::up_to(32, 16, 16, 2);
    let timing = limits.data(FD_CLOCK_HZ, bitrate_bps)?;
    Some(Segments { first: timing.segment1, second: timing.segment2, jump_width: timing.jump_width })
}

fn error_of(flags: u32, at: At) -> Incoming {
    let channel = Channel::Can1;
    let kinds = [
        (flag::STUFF, BusErrorKind::Stuff),
        (flag::FORM, BusErrorKind::Form),
        (flag::CRC, BusErrorKind::Crc),
        (flag::BIT0, BusErrorKind::BitDominant),
        (flag::BIT1, BusErrorKind::BitRecessive),
    ];
    match kinds.iter().find(|(flag, _)| flags & flag != 0) {
        Some((_, kind)) => Incoming::BusError { channel, kind: *kind, at },
        None => Incoming::BusErrors { channel, count: 1, at },
    }
}

/// What a message says, if it is a frame that can be.
fn frame_of(message: &KvaserMessage) -> Option<TraceFrame> {
    let raw = u32::try_from(message.id).ok()?;
    let id = if message.flags & flag::EXTENDED != 0 { Id::extended(raw) } else { Id::standard(raw) }?;
    let is_remote = message.flags & flag::REMOTE != 0;
    if message.flags & flag::FD != 0 {
        let len = usize::try_from(message.len).ok().filter(|len| *len <= 64)?;
        // Lengths of CAN FD frames alone.
        FD_LENGTHS.iter().find(|possible| usize::from(**possible) == len)?;
        let (brs, esi) = (message.flags & flag::BRS != 0, message.flags & flag::ESI != 0);
        return FdFrame::new(id, brs, esi, &message.data[..len]).filter(|_| !is_remote).map(TraceFrame::Fd);
    }
    let dlc = u8::try_from(message.len).ok().filter(|dlc| *dlc < 16)?;
    let mut eight = [0; 8];
    eight.copy_from_slice(&message.data[..8]);
    Some(Frame::from_bus(id, is_remote, dlc, eight).into())
}

impl Asked for Kvaser {
    fn channel(&mut self) -> &mut LibraryChannel {
        &mut self.channel
    }

    fn ask(&mut self) {
        if let Some(handle) = self.handle {
            self.look(handle);
            self.receive(handle, MESSAGES);
        }
    }
}

impl Driver for Kvaser {
    fn row(&self) -> &'static Row {
        row("kvaser").unwrap_or(&crate::ROWS[0])
    }

    fn serial(&self) -> String {
        self.name.clone()
    }

    fn open(&mut self, channel: Channel, opening: Opening) -> Result<(), Refusal> {
        let started = self.start(opening);
        if started.is_err() {
            self.close(channel);
        }
        self.channel.begin();
        started
    }

    fn close(&mut self, _channel: Channel) {
        if let Some(handle) = self.handle.take() {
            // If that fails, so will the next read, which has the reason.
            let _ = self.library.bus_off(handle);
            self.receive(handle, MESSAGES_AT_THE_END);
            let _ = self.library.close(handle);
        }
        self.channel.leave();
    }

    fn send(&mut self, _channel: Channel, mailbox: u8, frame: &Frame) -> bool {
        let Some(handle) = self.handle else { return false };
        let id = frame.id();
        let mut data = [0; 64];
        data[..8].copy_from_slice(&frame.padded_data());
        let flags = if id.is_extended() { flag::EXTENDED } else { flag::STANDARD };
        let flags = if frame.is_remote() { flags | flag::REMOTE } else { flags };
        let len = u32::from(frame.dlc());
        if len > 8 {
            self.channel.not_sent(mailbox, TOO_LONG);
            return true;
        }
        let message = KvaserMessage { id: id.raw().into(), flags, len, data, stamp_us: 0 };
        self.write(handle, mailbox, &message, (*frame).into())
    }

    fn sends_fd(&self) -> bool {
        self.options.data_bitrate_bps.is_some()
    }

    fn send_fd(&mut self, _channel: Channel, mailbox: u8, frame: &FdFrame) -> bool {
        let Some(handle) = self.handle else { return false };
        let id = frame.id();
        let mut data = [0; 64];
        data[..frame.data_len()].copy_from_slice(frame.data());
        let flag = |is: bool, bit: u32| if is { bit } else { 0 };
        let flags = flag::FD
            | if id.is_extended() { flag::EXTENDED } else { flag::STANDARD }
            | flag(frame.brs(), flag::BRS)
            | flag(frame.esi(), flag::ESI);
        let len = frame.data_len() as u32;
        let message = KvaserMessage { id: id.raw().into(), flags, len, data, stamp_us: 0 };
        self.write(handle, mailbox, &message, (*frame).into())
    }

    fn poll(&mut self, wait: Duration, reports: &mut Vec<Incoming>) -> Result<(), String> {
        poll_asked(self, wait, reports)
    }

    fn oddities(&self) -> (u32, String) {
        self.channel.oddities.summary()
    }
}

impl Drop for Kvaser {
    fn drop(&mut self) {
        self.close(Channel::Can1);
    }
}
