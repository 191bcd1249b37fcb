//! PEAK's adapters through PCAN-Basic. One channel: a device with two is two adapters here, on one clock if both are given.

use std::ffi::CString;
use std::time::{Duration, Instant};

use cantap_trace::fd::FD_LENGTHS;
use cantap_trace::{TraceFrame, clean};
use cantap_vendor::pcan_basic::{Channel as Handle, PcanBasic, PcanMessage, STAMP_PERIOD_US, Status};
use cantap_vendor::pcan_basic::{kind, parameter, status};
use cantap_wire::record::{BusErrorKind, ErrorState, LossStage};
use cantap_wire::{Channel, FdFrame, Frame, Id, Refusal};

use crate::adapter_clock::AdapterClock;
use crate::bit_limits::{Limits, Timing};
use crate::driver::{At, Driver, Incoming, OpenError, Opening};
use crate::library_channel::{
    Asked, LibraryChannel, MESSAGES, MESSAGES_AT_THE_END, REFUSED, TOO_LONG, poll_asked,
};
use crate::maker_options::MakerOptions;
use crate::rows::{Row, row};

/// The clock of the bit timing registers, as for an SJA1000.
const CLOCK_HZ: u32 = 8_000_000;
/// The clock of CAN FD's bit timing, in MHz: every PCAN adapter with CAN FD has it.
const FD_CLOCK_MHZ: u32 = 80;

/// The driver.
pub(crate) struct Pcan {
    library: PcanBasic,
    handle: Handle,
    name: String,
    options: MakerOptions,
    is_open: bool,
    /// Whether sent frames come back once they were on the bus.
    echoes: bool,
    channel: LibraryChannel,
    clock: AdapterClock,
    identifies_until: Option<Instant>,
}

impl Pcan {
    /// The channel with a name, or the only one that is there.
    pub fn connect(channel: Option<Handle>, options: MakerOptions, address: &str) -> Result<Self, OpenError> {
        let library = PcanBasic::load(options.library.as_deref())
            .map_err(|error| OpenError::Library { address: address.to_owned(), source: error })?;
        let there: Vec<Handle> = Handle::all().filter(|channel| is_there(&library, *channel)).collect();
        let handle = match (channel, &there[..]) {
            (Some(channel), there) if there.contains(&channel) => channel,
            (None, [only]) => *only,
            _ => return Err(OpenError::no_channel(address, &there)),
        };
        let condition = library.get(handle, parameter::CHANNEL_CONDITION).unwrap_or(0);
        if condition & 1 == 0 {
            let reason = "another program has it; end that first".to_owned();
            return Err(OpenError::Channel { address: address.to_owned(), reason });
        }
        if let Some(data_bitrate_bps) = options.data_bitrate_bps {
            let has_fd = library.get(handle, parameter::CHANNEL_FEATURES).is_ok_and(|bits| bits & 1 == 1);
            if !has_fd || data_timing(data_bitrate_bps).is_none() {
                let address = address.to_owned();
                return Err(OpenError::NoDataBitRate { address, data_bitrate_bps });
            }
        }
        let name = library.text(handle, parameter::HARDWARE_NAME).unwrap_or_default();
        let id = library.get(handle, parameter::DEVICE_ID).unwrap_or(0);
        Ok(Self {
            library,
            handle,
            name: clean::line(format!("{name} {id:X} {handle}").trim()).into_owned(),
            options,
            is_open: false,
            echoes: false,
            channel: LibraryChannel::new(),
            clock: AdapterClock::new(1_000, STAMP_PERIOD_US),
            identifies_until: None,
        })
    }

    fn start(&mut self, opening: Opening) -> Result<(), Refusal> {
        let (library, handle) = (&self.library, self.handle);
        let listens = u32::from(opening.listen_only);
        // Before the channel is on the bus: afterwards it would have acknowledged frames already.
        if library.set(handle, parameter::LISTEN_ONLY, listens).is_err() && opening.listen_only {
            return Err(Refusal::Unsupported);
        }
        let initialized = match self.options.data_bitrate_bps {
            Some(data_bitrate_bps) => {
                let timing = fd_timing(opening, data_bitrate_bps).ok_or(Refusal::BadTiming)?;
                library.initialize_fd(handle, &timing)
            }
            None => library.initialize(handle, registers(opening).ok_or(Refusal::BadTiming)?),
        };
        initialized
            .map_err(|status| if status.has(status::IN_USE) { Refusal::Held } else { Refusal::Hardware })?;
        // What holds may be what another program has set before.
        if library.get(handle, parameter::LISTEN_ONLY) != Ok(listens) {
            return Err(Refusal::Unsupported);
        }
        for parameter in
            [parameter::BUS_OFF_AUTORESET, parameter::ALLOW_REMOTE_FRAMES, parameter::RECEIVE_STATUS]
        {
            library.set(handle, parameter, 1).map_err(|_| Refusal::Hardware)?;
        }
        for (parameter, kind) in [
            (parameter::ALLOW_STATUS_FRAMES, "status messages that are not switched on"),
            (parameter::ALLOW_ERROR_FRAMES, "error frames that are not switched on"),
        ] {
            if library.set(handle, parameter, 1).is_err() {
                self.channel.oddities.count(kind);
            }
        }
        // Older libraries do not know it.
        self.echoes = library.set(handle, parameter::ALLOW_ECHO_FRAMES, 1).is_ok();
        Ok(())
    }

    /// Reads up to `most` messages. Returns whether there were any.
    fn receive(&mut self, most: usize) -> bool {
        for taken in 0..most {
            let read = match self.options.data_bitrate_bps {
                Some(_) => self.library.read_fd(self.handle),
                None => self.library.read(self.handle),
            };
            match read {
                Ok((message, stamp_us)) => self.take(&message, stamp_us, Instant::now()),
                Err(status) if status.is_failure() => {
                    self.channel.end(&self.library.describe(status));
                    return taken > 0;
                }
                Err(status) => {
                    self.channel.losses(status.0, LOSSES, At::arrival(Instant::now()));
                    // Only the bits of the bus: whatever is said, another question may not be answered better.
                    if status.has(status::RECEIVE_EMPTY) || taken + 1 == most {
                        return taken > 0;
                    }
                }
            }
        }
        true
    }

    fn take(&mut self, message: &PcanMessage, stamp_us: u64, arrival: Instant) {
        let at = self.clock.place(stamp_us, arrival, &mut self.channel.oddities);
        if message.kind & kind::STATUS != 0 {
            let [a, b, c, d, ..] = message.data;
            let status = Status(u32::from_be_bytes([a, b, c, d]));
            self.channel.losses(status.0, LOSSES, at);
            return self.channel.state(state_of(status), None, at);
        }
        if message.kind & kind::ERROR != 0 {
            return self.error(message, at);
        }
        let is_ours = message.kind & kind::ECHO != 0;
        if let Some(frame) = self.channel.take(frame_of(message), is_ours, at) {
            // Sent by another program of this computer.
            self.channel.report(Incoming::Received { channel: Channel::Can1, frame, at });
        }
    }

    /// An error frame: its identifier says which, its data the error counters.
    fn error(&mut self, message: &PcanMessage, at: At) {
        let channel = Channel::Can1;
        let [_, _, receive, transmit, ..] = message.data;
        self.channel.counters((transmit, receive), at);
        let kind = match message.id {
            2 => Some(BusErrorKind::Form),
            4 => Some(BusErrorKind::Stuff),
            _ => None,
        };
        self.channel.report(match kind {
            Some(kind) => Incoming::BusError { channel, kind, at },
            None => Incoming::BusErrors { channel, count: 1, at },
        });
    }

    /// Gives a message to the library. Returns false if it cannot take it now.
    fn write(&mut self, mailbox: u8, message: &PcanMessage, frame: TraceFrame) -> bool {
        let written = match self.options.data_bitrate_bps {
            Some(_) => self.library.write_fd(self.handle, message),
            None => self.library.write(self.handle, message),
        };
        match written {
            Err(status) if !status.is_failure() && status.has(status::TRANSMIT_FULL | status::QUEUE_FULL) => {
                return false;
            }
            Err(status) if status.is_failure() => self.channel.not_sent(mailbox, REFUSED),
            // Taken, whatever is said about the bus beside it.
            Ok(()) | Err(_) if self.echoes => self.channel.sent(mailbox, frame),
            Ok(()) | Err(_) => {
                let at = At::arrival(Instant::now());
                self.channel.report(Incoming::Sent { channel: Channel::Can1, mailbox, at });
            }
        }
        true
    }

    fn look_after_time(&mut self) {
        let now = Instant::now();
        if self.identifies_until.is_some_and(|until| until <= now) {
            self.identifies_until = None;
            // If it goes on, it does no harm.
            let _ = self.library.set(self.handle, parameter::IDENTIFYING, 0);
        }
        if !self.is_open || !self.channel.asks_now(now) {
            return;
        }
        let status = self.library.status(self.handle);
        if status.is_failure() {
            return self.channel.end(&self.library.describe(status));
        }
        let at = At::arrival(now);
        self.channel.losses(status.0, LOSSES, at);
        self.channel.forget_losses(status.0);
        self.channel.state(state_of(status), None, at);
    }
}

/// The bits of a status that report losses.
const LOSSES: [(u32, LossStage); 2] =
    [(status::OVERRUN, LossStage::Controller), (status::QUEUE_OVERRUN, LossStage::Queue)];

const fn state_of(status: Status) -> ErrorState {
    if status.has(status::BUS_OFF) {
        ErrorState::BusOff
    } else if status.has(status::BUS_PASSIVE) {
        ErrorState::Passive
    } else if status.has(status::BUS_HEAVY | status::BUS_LIGHT) {
        ErrorState::Warning
    } else {
        ErrorState::Active
    }
}

/// Whether the library has this channel, free or not.
fn is_there(library: &PcanBasic, channel: Handle) -> bool {
    library.get(channel, parameter::CHANNEL_CONDITION).is_ok_and(|condition| condition & 3 != 0)
}

/// What a message says, if it is a frame that can be.
fn frame_of(message: &PcanMessage) -> Option<TraceFrame> {
    let id =
        if message.kind & kind::EXTENDED != 0 { Id::extended(message.id) } else { Id::standard(message.id) }?;
    let is_remote = message.kind & kind::REMOTE != 0;
    if message.dlc > 15 {
        return None;
    }
    if message.kind & kind::FD != 0 {
        let data = &message.data[..usize::from(FD_LENGTHS[usize::from(message.dlc)])];
        let (brs, esi) = (message.kind & kind::BRS != 0, message.kind & kind::ESI != 0);
        return FdFrame::new(id, brs, esi, data).filter(|_| !is_remote).map(TraceFrame::Fd);
    }
    let mut eight = [0; 8];
    eight.copy_from_slice(&message.data[..8]);
    Some(Frame::from_bus(id, is_remote, message.dlc, eight).into())
}

/// The bit timing registers of an SJA1000: BTR0 in the upper byte.
fn registers(opening: Opening) -> Option<u16> {
    let limits = Limits::up_to(16, 8, 4, 64);
    let timing = limits.nominal(CLOCK_HZ, opening.bitrate_bps, opening.sample_point_permille)?;
    let btr0 = (timing.jump_width - 1) << 6 | (timing.prescaler - 1);
    let btr1 = (timing.segment2 - 1) << 4 | (timing.segment1 - 1);
    Some((btr0 << 8 | btr1) as u16)
}

fn data_timing(bitrate_bps: u32) -> Option<Timing> {
    let limits = Limits::up_to(32, 16, 16, 1024);
    limits.data(FD_CLOCK_MHZ * 1_000_000, bitrate_bps)
}

/// Both bit timings as the library wants them.
fn fd_timing(opening: Opening, data_bitrate_bps: u32) -> Option<CString> {
    let limits = Limits::up_to(256, 128, 128, 1024);
    let clock_hz = FD_CLOCK_MHZ * 1_000_000;
    let timings = [
        ("nom", limits.nominal(clock_hz, opening.bitrate_bps, opening.sample_point_permille)?),
        ("data", data_timing(data_bitrate_bps)?),
    ];
    let parts = timings.map(|(name, Timing { prescaler, segment1, segment2, jump_width })| {
        format!(
            "{name}_brp={prescaler},{name}_tseg1={segment1},{name}_tseg2={segment2},{name}_sjw={jump_width}"
        )
    });
    CString::new(format!("f_clock_mhz={FD_CLOCK_MHZ},{}", parts.join(","))).ok()
}

impl Asked for Pcan {
    fn channel(&mut self) -> &mut LibraryChannel {
        &mut self.channel
    }

    fn ask(&mut self) {
        self.look_after_time();
        if self.is_open {
            self.receive(MESSAGES);
        }
    }
}

impl Driver for Pcan {
    fn row(&self) -> &'static Row {
        row("pcan").unwrap_or(&crate::ROWS[0])
    }

    fn serial(&self) -> String {
        self.name.clone()
    }

    fn open(&mut self, _channel: Channel, opening: Opening) -> Result<(), Refusal> {
        let started = self.start(opening);
        if started.is_err() {
            // Half set up, it might acknowledge frames, or destroy them.
            let _ = self.library.uninitialize(self.handle);
        }
        self.is_open = started.is_ok();
        self.channel.begin();
        started
    }

    fn close(&mut self, _channel: Channel) {
        if self.is_open {
            // What was received so far, and no more of it: leaving the bus empties the queue.
            let _ = self.library.set(self.handle, parameter::RECEIVE_STATUS, 0);
            self.receive(MESSAGES_AT_THE_END);
        }
        // If that fails, so will the next read, which has the reason.
        let _ = self.library.uninitialize(self.handle);
        self.is_open = false;
        self.channel.leave();
    }

    fn send(&mut self, _channel: Channel, mailbox: u8, frame: &Frame) -> bool {
        let id = frame.id();
        let mut data = [0; 64];
        data[..8].copy_from_slice(&frame.padded_data());
        let kind = if frame.is_remote() { kind::REMOTE } else { 0 };
        let kind = if id.is_extended() { kind | kind::EXTENDED } else { kind };
        let message = PcanMessage { id: id.raw(), kind, dlc: frame.dlc(), data };
        if message.dlc > 8 {
            self.channel.not_sent(mailbox, TOO_LONG);
            return true;
        }
        self.write(mailbox, &message, (*frame).into())
    }

    fn sends_fd(&self) -> bool {
        self.options.data_bitrate_bps.is_some()
    }

    fn send_fd(&mut self, _channel: Channel, mailbox: u8, frame: &FdFrame) -> bool {
        let id = frame.id();
        let mut data = [0; 64];
        data[..frame.data_len()].copy_from_slice(frame.data());
        let flag = |is: bool, bit: u8| if is { bit } else { 0 };
        let kind = kind::FD
            | flag(id.is_extended(), kind::EXTENDED)
            | flag(frame.brs(), kind::BRS)
            | flag(frame.esi(), kind::ESI);
        let message = PcanMessage { id: id.raw(), kind, dlc: frame.dlc(), data };
        self.write(mailbox, &message, (*frame).into())
    }

    fn poll(&mut self, wait: Duration, reports: &mut Vec<Incoming>) -> Result<(), String> {
        poll_asked(self, wait, reports)
    }

    fn identify(&mut self, seconds: u8) -> Result<(), Refusal> {
        self.library
            .set(self.handle, parameter::IDENTIFYING, u32::from(seconds > 0))
            .map_err(|_| Refusal::Unsupported)?;
        self.identifies_until = Some(Instant::now() + Duration::from_secs(seconds.into()));
        Ok(())
    }

    fn oddities(&self) -> (u32, String) {
        self.channel.oddities.summary()
    }
}

impl Drop for Pcan {
    fn drop(&mut self) {
        // If it is on no bus, that is an error of no meaning.
        let _ = self.library.uninitialize(self.handle);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn registers_are_those_of_peak_s_header() {
        // `PCAN_BAUD_…` with the same sample points; jump widths are larger here where there is room.
        let of = |bitrate_bps, sample_point_permille| {
            registers(Opening { bitrate_bps, sample_point_permille, listen_only: true })
        };
        let without_jump_width = |value: u16| value & 0x3FFF;
        for (bitrate_bps, permille, wanted) in [
            (1_000_000, 750, 0x0014),
            (500_000, 875, 0x001C),
            (250_000, 875, 0x011C),
            (125_000, 875, 0x031C),
            (100_000, 850, 0x432F),
            (50_000, 850, 0x472F),
            (10_000, 850, 0x672F),
        ] {
            let registers = of(bitrate_bps, permille).unwrap();
            assert_eq!(
                without_jump_width(registers),
                without_jump_width(wanted),
                "{bitrate_bps}: {registers:04X}"
            );
        }
        assert_eq!(of(700_000, 875), None);
    }

    #[test]
    fn can_fd_s_timing_is_a_text() {
        let opening = Opening { bitrate_bps: 500_000, sample_point_permille: 800, listen_only: true };
        let text = fd_timing(opening, 2_000_000).unwrap();
        let text = text.to_str().unwrap();
        let value = |name: &str| -> u32 {
            let part = text.split(',').find_map(|part| part.strip_prefix(name)?.strip_prefix('='));
            part.unwrap().parse().unwrap()
        };
        assert_eq!(value("f_clock_mhz"), 80);
        assert_eq!(80_000_000 / value("nom_brp") / (1 + value("nom_tseg1") + value("nom_tseg2")), 500_000);
        assert_eq!(
            80_000_000 / value("data_brp") / (1 + value("data_tseg1") + value("data_tseg2")),
            2_000_000
        );
    }
}
