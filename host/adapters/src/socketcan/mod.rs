//! CAN interfaces of Linux: `can0`, `socketcan:can0`.
//!
//! The interface belongs to its owner: whoever opens it reads bit rate, mode and state (rtnetlink), and sets nothing. To set them is a request of its
//! own ([`set_can_interface`]). What is lost is counted where it is: by the
//! controller and its driver, by the kernel on the way to this program, and by the socket.

mod configure;
mod content;
mod interface;
mod link;
mod link_change;
mod linux;

use std::collections::VecDeque;
use std::io;
use std::time::{Duration, Instant, SystemTime};

use cantap_trace::TraceFrame;
use cantap_trace::socketcan::ErrorFrame;
use cantap_wire::record::{ErrorState, LossStage};
use cantap_wire::{Channel, FdFrame, Frame, Refusal};
use nix::libc::{
    EACCES, EAFNOSUPPORT, EAGAIN, EINTR, ENETDOWN, ENOBUFS, ENODEV, ENXIO, EPERM, EPROTONOSUPPORT,
};

use self::content::{Content, content};
use self::interface::Interface;
use self::link::Link;
use self::linux::{LinuxInterface, there};
use crate::adapter_clock::AdapterClock;
use crate::driver::{At, Driver, Incoming, Oddities, OpenError, Opening};
use crate::error_frames::ErrorFrames;
use crate::interface_name::same_rate;
use crate::raw_can::{BATCH, Message, raw_fd_frame, raw_frame};
use crate::rows::{Row, row};
use crate::under_way::are_alike;

pub use self::configure::{
    CanInterface, InterfaceError, InterfaceSettings, can_interface, restart_can_interface, set_can_interface,
    take_down_can_interface,
};
pub(crate) use self::linux::{exists, interfaces};

/// How often the kernel's figures are read.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// Messages that one call of [`Driver::poll`] takes, in system calls.
const BATCHES: usize = 8;
/// As many at the end: more than fit into the socket.
const BATCHES_AT_THE_END: usize = 4096;
/// A confirmation that may have been lost is waited for no longer than this.
const UNCONFIRMED: Duration = Duration::from_secs(1);
/// A stamp older than this when it is read belongs to a clock that was set.
const OLDEST: Duration = Duration::from_mins(1);

/// What has been reported as lost.
#[derive(Default)]
struct Counted {
    /// The kernel's own figures, as last read.
    overruns: u64,
    dropped: u64,
    by_socket: u32,
    /// Overruns that error frames have reported, and the kernel's figure did not contain yet.
    overruns_ahead: u64,
}

/// The driver.
pub(crate) struct SocketCan {
    interface: Box<dyn Interface>,
    name: String,
    row: &'static Row,
    is_open: bool,
    counted: Counted,
    in_flight: VecDeque<(u8, TraceFrame)>,
    takes_fd: bool,
    /// Since when a confirmation may be among the messages that were dropped.
    uncertain_since: Option<Instant>,
    errors: ErrorFrames,
    clock: AdapterClock,
    looked: Instant,
    backlog: Vec<Incoming>,
    oddities: Oddities,
    ended: Option<String>,
}

/// The bit rate of an interface in bit/s, if it has one.
pub(crate) fn bitrate_of(name: &str) -> Option<u32> {
    LinuxInterface::new(name).look().ok()?.bitrate_bps
}

/// The bit rate of the data phases of CAN FD frames, in bit/s, if it has one.
pub(crate) fn data_bitrate_of(name: &str) -> Option<u32> {
    LinuxInterface::new(name).look().ok()?.data_bitrate_bps
}

impl SocketCan {
    /// Looks at an interface. The socket is opened with the channel.
    pub fn connect(name: &str, address: &str) -> Result<Self, OpenError> {
        let interface = LinuxInterface::new(name);
        let has_hardware_stamps = interface.has_hardware_stamps();
        let is_known = has_hardware_stamps.as_ref().is_ok_and(|has| *has);
        let driver = Self::over(Box::new(interface), is_known, name, address)?;
        // What the interface itself lacks is said first.
        has_hardware_stamps.map(|_| driver).map_err(|source| unusable(address, source))
    }

    fn over(
        mut interface: Box<dyn Interface>,
        has_hardware_stamps: bool,
        name: &str,
        address: &str,
    ) -> Result<Self, OpenError> {
        let link = match interface.look() {
            Ok(link) if link.is_can => link,
            Err(error) if error.raw_os_error() != Some(ENODEV) => {
                return Err(unusable(address, error));
            }
            _ => {
                return Err(OpenError::NoInterface { address: address.to_owned(), there: there() });
            }
        };
        if !link.is_up {
            let rate = if link.kind == "can" && link.bitrate_bps.is_none() {
                " type can bitrate 500000, with the bus's bit rate"
            } else {
                ""
            };
            let command = format!("ip link set {name} up{rate}");
            return Err(OpenError::InterfaceDown { address: address.to_owned(), command });
        }
        Ok(Self {
            row: row_of(&link, has_hardware_stamps),
            takes_fd: link.takes_fd,
            interface,
            name: name.to_owned(),
            is_open: false,
            counted: Counted::default(),
            in_flight: VecDeque::new(),
            uncertain_since: None,
            errors: ErrorFrames::default(),
            // Nanoseconds that never start again.
            clock: AdapterClock::new(1, 1 << 62),
            looked: Instant::now(),
            backlog: Vec::new(),
            oddities: Oddities::default(),
            ended: None,
        })
    }

    /// Takes what has arrived, in so many system calls at most.
    fn drain(&mut self, batches: usize) {
        let mut messages = Vec::with_capacity(BATCH);
        for _ in 0..batches {
            messages.clear();
            let received = self.interface.receive(&mut messages);
            let (here, since_1970) = (Instant::now(), SystemTime::UNIX_EPOCH.elapsed().unwrap_or_default());
            for message in &messages {
                let age = message.software.and_then(|stamp| since_1970.checked_sub(stamp));
                let arrival =
                    age.filter(|age| *age < OLDEST).and_then(|age| here.checked_sub(age)).unwrap_or(here);
                self.take(message, arrival);
            }
            match received {
                Err(error) if self.ended.is_none() => self.end(&error),
                // It said so before.
                Err(_) => break,
                Ok(()) if messages.is_empty() => break,
                Ok(()) => {}
            }
        }
    }

    fn take(&mut self, message: &Message, arrival: Instant) {
        let channel = Channel::Can1;
        if let Some(dropped) = message.dropped {
            self.count_dropped(dropped, At::arrival(arrival));
        }
        let at = match message.hardware {
            Some(stamp) => self.clock.place(stamp.as_nanos() as u64, arrival, &mut self.oddities),
            None => At::arrival(arrival),
        };
        match content(message.bytes()) {
            Content::Frame(frame) if message.is_own => self.confirm(&frame, at),
            Content::Frame(frame) => self.backlog.push(Incoming::Received { channel, frame, at }),
            Content::Error(error) => self.error(error, At::arrival(arrival)),
            Content::Other => {
                self.oddities.count("messages of unknown form");
                self.lost(LossStage::Link, 1, true, at);
            }
        }
    }

    fn lost(&mut self, stage: LossStage, count: u64, at_least: bool, at: At) {
        let count = u32::try_from(count).unwrap_or(u32::MAX);
        self.backlog.push(Incoming::Lost { channel: Channel::Can1, stage, count, at_least, at });
    }

    /// The socket has dropped so many messages in all.
    fn count_dropped(&mut self, total: u32, at: At) {
        let more = total.wrapping_sub(self.counted.by_socket);
        // An older figure than the last is not a rise by four thousand million.
        if more == 0 || more > u32::MAX / 2 {
            return;
        }
        self.counted.by_socket = total;
        self.lost(LossStage::Queue, more.into(), false, at);
        if !self.in_flight.is_empty() {
            self.uncertain_since = Some(Instant::now());
        }
    }

    fn confirm(&mut self, frame: &TraceFrame, at: At) {
        match self.in_flight.iter().position(|(_, sent)| are_alike(sent, frame)) {
            Some(place) => {
                if let Some((mailbox, _)) = self.in_flight.remove(place) {
                    self.backlog.push(Incoming::Sent { channel: Channel::Can1, mailbox, at });
                }
            }
            None => self.oddities.count("confirmations of frames that were not under way"),
        }
    }

    fn error(&mut self, error: ErrorFrame, at: At) {
        if self.errors.take(error, Channel::Can1, at, &mut self.backlog, &mut self.oddities) {
            self.counted.overruns_ahead += 1;
        }
        self.follow_state(at);
    }

    fn follow_state(&mut self, at: At) {
        if self.errors.state() == Some(ErrorState::BusOff) {
            // The driver drops them.
            self.give_up(at);
        }
    }

    /// What became of a frame that was given to the interface: false if it cannot take it now.
    fn handed_over(
        &mut self,
        sent: io::Result<()>,
        channel: Channel,
        mailbox: u8,
        frame: TraceFrame,
    ) -> bool {
        let Err(error) = sent else {
            self.in_flight.push_back((mailbox, frame));
            return true;
        };
        match error.raw_os_error() {
            // The interface's queue is full.
            Some(EAGAIN | EINTR | ENOBUFS) => return false,
            Some(ENETDOWN | ENODEV | ENXIO) => self.end(&error),
            _ => self.oddities.count("frames that the interface refused"),
        }
        self.backlog.push(Incoming::NotSent { channel, mailbox, at: At::arrival(Instant::now()) });
        true
    }

    /// What is under way will not be sent.
    fn give_up(&mut self, at: At) {
        let channel = Channel::Can1;
        let given_up = self.in_flight.drain(..);
        self.backlog.extend(given_up.map(|(mailbox, _)| Incoming::NotSent { channel, mailbox, at }));
    }

    /// Reads the kernel's figures.
    fn look(&mut self) {
        self.looked = Instant::now();
        let at = At::arrival(self.looked);
        match self.interface.look() {
            Ok(link) => {
                self.count_losses(&link, at);
                if let Some(state) = link.state {
                    self.errors.set(state, link.counters, Channel::Can1, at, &mut self.backlog);
                    self.follow_state(at);
                }
                if !link.is_up {
                    self.end(&io::Error::from_raw_os_error(ENETDOWN));
                }
            }
            Err(error) if error.raw_os_error() == Some(ENODEV) => self.end(&error),
            Err(_) => self.oddities.count("questions that the kernel did not answer"),
        }
        if self.is_open
            && let Some(dropped) = self.interface.dropped()
        {
            self.count_dropped(dropped, at);
        }
    }

    fn count_losses(&mut self, link: &Link, at: At) {
        // A figure that starts again begins with a driver that does.
        let overruns = link.overruns.saturating_sub(self.counted.overruns);
        let dropped = link.dropped.saturating_sub(self.counted.dropped);
        (self.counted.overruns, self.counted.dropped) = (link.overruns, link.dropped);
        let ahead = self.counted.overruns_ahead.min(overruns);
        self.counted.overruns_ahead -= ahead;
        if overruns > ahead {
            self.lost(LossStage::Controller, overruns - ahead, true, at);
        }
        if dropped > 0 {
            self.lost(LossStage::Link, dropped, false, at);
        }
    }

    /// The interface is of no more use.
    fn end(&mut self, error: &io::Error) {
        let name = &self.name;
        let mut code = error.raw_os_error();
        // Before it is deleted, an interface is taken down.
        if code == Some(ENETDOWN)
            && let Err(error) = self.interface.look()
        {
            code = error.raw_os_error();
        }
        let reason = match code {
            Some(ENETDOWN) => format!("the interface {name} was taken down; as root: ip link set {name} up"),
            Some(ENODEV | ENXIO) => format!(
                "the interface {name} is gone, and has to be set up again once it is back: cantap interface {name} -b RATE"
            ),
            _ => format!("the interface {name} fails: {error}"),
        };
        self.ended.get_or_insert(reason);
        self.give_up(At::arrival(Instant::now()));
    }

    /// Takes and counts the rest.
    fn finish(&mut self) {
        self.drain(BATCHES_AT_THE_END);
        self.look();
    }

    fn look_after_time(&mut self) {
        if self.uncertain_since.is_some_and(|since| since.elapsed() > UNCONFIRMED)
            && self.errors.state().is_none_or(|state| state < ErrorState::Passive)
        {
            self.uncertain_since = None;
            let (channel, at) = (Channel::Can1, At::arrival(Instant::now()));
            for (mailbox, _) in std::mem::take(&mut self.in_flight) {
                self.oddities.count("frames sent whose confirmation was lost");
                self.backlog.push(Incoming::Sent { channel, mailbox, at });
            }
        }
        if self.looked.elapsed() >= LOOK_EVERY {
            self.look();
        }
    }
}

/// The kernel gives no socket for the interface.
fn unusable(address: &str, source: io::Error) -> OpenError {
    let advice = match source.raw_os_error() {
        Some(EAFNOSUPPORT | EPROTONOSUPPORT) => {
            "this kernel has no sockets for CAN; as root: modprobe can-raw"
        }
        Some(EPERM | EACCES) => {
            "a container or a sandbox forbids it; it needs the host's network (docker run --network host), or run this outside"
        }
        _ => "the kernel's log (dmesg) may say more",
    };
    OpenError::Interface { address: address.to_owned(), source, advice }
}

/// What can be told of an interface.
fn row_of(link: &Link, has_hardware_stamps: bool) -> &'static Row {
    let board = match (link.bitrate_bps, link.listen_only, has_hardware_stamps, link.echoes) {
        (None, ..) => "socketcan-virtual",
        (_, true, true, _) => "socketcan-hw-silent",
        (_, true, false, _) => "socketcan-silent",
        (_, false, true, true) => "socketcan-hw",
        (_, false, true, false) => "socketcan-hw-no-echo",
        (_, false, false, true) => "socketcan",
        (_, false, false, false) => "socketcan-no-echo",
    };
    row(board).unwrap_or(&crate::ROWS[0])
}

impl Driver for SocketCan {
    fn row(&self) -> &'static Row {
        self.row
    }

    fn serial(&self) -> String {
        self.name.clone()
    }

    fn open(&mut self, _channel: Channel, opening: Opening) -> Result<(), Refusal> {
        let link = self.interface.look().map_err(|_| Refusal::Hardware)?;
        if !link.is_up {
            return Err(Refusal::Hardware);
        }
        if link.bitrate_bps.is_some_and(|rate| !same_rate(rate, opening.bitrate_bps)) {
            return Err(Refusal::BadTiming);
        }
        if !opening.listen_only && link.listen_only {
            return Err(Refusal::Unsupported);
        }
        self.interface.open().map_err(|_| Refusal::Hardware)?;
        let (overruns, dropped) = (link.overruns, link.dropped);
        self.counted = Counted { overruns, dropped, ..Counted::default() };
        self.errors = ErrorFrames::default();
        self.is_open = true;
        Ok(())
    }

    fn close(&mut self, _channel: Channel) {
        if self.is_open && self.ended.is_none() {
            self.finish();
        }
        self.is_open = false;
        (self.uncertain_since, self.errors) = (None, ErrorFrames::default());
        self.in_flight.clear();
        self.interface.close();
    }

    fn send(&mut self, channel: Channel, mailbox: u8, frame: &Frame) -> bool {
        let sent = self.interface.send(&raw_frame(frame));
        self.handed_over(sent, channel, mailbox, (*frame).into())
    }

    fn sends_fd(&self) -> bool {
        self.takes_fd
    }

    fn send_fd(&mut self, channel: Channel, mailbox: u8, frame: &FdFrame) -> bool {
        let sent = self.interface.send_fd(&raw_fd_frame(frame));
        self.handed_over(sent, channel, mailbox, (*frame).into())
    }

    fn poll(&mut self, wait: Duration, reports: &mut Vec<Incoming>) -> Result<(), String> {
        self.look_after_time();
        let wait = if self.backlog.is_empty() && self.ended.is_none() { wait } else { Duration::ZERO };
        if self.is_open {
            self.interface.wait(wait);
            self.drain(BATCHES);
        } else {
            std::thread::sleep(wait);
        }
        if self.ended.is_some() && self.is_open {
            self.finish();
            self.is_open = false;
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
