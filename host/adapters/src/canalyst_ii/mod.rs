//! CANalyst-II and other adapters with its firmware ("Chuangxin Tech USBCAN/CANalyst-II"), by USB itself, without the maker's ControlCAN library.
//!
//! After `canalystii` (`protocol.py`, `device.py`), python-can's driver, whose authors found the protocol out: the maker does not publish it. How the
//! adapter is told to listen only is not known, so it acknowledges frames; it reports neither errors nor losses, and confirms nothing. It is asked how many
//! frames wait, as that driver asks, and they are read.

#[cfg(test)]
mod tests;
mod usb;
mod wire;

use std::time::{Duration, Instant};

use cantap_wire::record::LossStage;
use cantap_wire::{CHANNELS, Channel, Frame, Refusal};

use self::usb::{Usb, UsbAdapter};
use self::wire::{Command, Message, PACKET, messages, waiting};
use crate::adapter_clock::AdapterClock;
use crate::driver::{At, Driver, Incoming, Oddities, OpenError, Opening};
use crate::rows::{Row, row};

/// Messages in a packet.
const IN_PACKET: usize = 3;
/// Packets that are read at once, however many messages are said to wait.
const MOST_PACKETS: usize = 64;
/// Frames that may wait in the adapter to be sent: how many it has room for is not known.
const MOST_UNSENT: u32 = 16;
/// How often at the end it is asked for what it has received.
const READS_AT_THE_END: usize = 16;
/// Its stamps' unit.
const STAMP_NS: u32 = 100_000;

/// One channel.
struct Can {
    is_open: bool,
    clock: AdapterClock,
    /// Frames in the adapter that are to be sent, at most.
    unsent: u32,
}

/// The driver.
pub(crate) struct CanalystIi {
    usb: Box<dyn Usb>,
    serial: String,
    channels: [Can; CHANNELS],
    backlog: Vec<Incoming>,
    oddities: Oddities,
    ended: Option<String>,
}

impl CanalystIi {
    /// The adapter with a serial number, or the only one.
    pub fn connect(serial: &str, address: &str) -> Result<Self, OpenError> {
        let (usb, serial) = UsbAdapter::open(serial, address)?;
        Self::over(Box::new(usb), serial, address)
    }

    fn over(usb: Box<dyn Usb>, serial: String, address: &str) -> Result<Self, OpenError> {
        let channel = || Can { is_open: false, clock: AdapterClock::new(STAMP_NS, 1 << 32), unsent: 0 };
        let mut adapter = Self {
            usb,
            serial,
            channels: [channel(), channel()],
            backlog: Vec::new(),
            oddities: Oddities::default(),
            ended: None,
        };
        // Another program may have left them on.
        let is_one = (0..CHANNELS)
            .all(|channel| adapter.tell(channel, Command::Stop).is_ok() && adapter.ask(channel).is_ok());
        if is_one {
            Ok(adapter)
        } else {
            Err(OpenError::Foreign { address: address.to_owned(), expected: "a CANalyst-II" })
        }
    }

    fn tell(&mut self, channel: usize, command: Command) -> Result<(), String> {
        self.usb.command(channel, command.packet())
    }

    /// How many frames wait in the adapter to be read. Those that wait to be sent are noted.
    fn ask(&mut self, channel: usize) -> Result<u32, String> {
        self.tell(channel, Command::Waiting)?;
        let answer = self.usb.answer(channel)?;
        let (received, unsent) = waiting(&answer).ok_or("it answers what cannot be read")?;
        self.channels[channel].unsent = unsent;
        Ok(received)
    }

    /// Reads what a channel has received. Returns whether there was any.
    fn receive(&mut self, channel: usize) -> Result<bool, String> {
        let received = self.ask(channel)? as usize;
        if received == 0 {
            return Ok(false);
        }
        // One more than they need: a frame may be in the packet after the one in which it should be.
        let packets = (received.div_ceil(IN_PACKET) + 1).min(MOST_PACKETS);
        let bytes = self.usb.read(channel, packets * PACKET)?;
        let arrival = Instant::now();
        let Some(number) = Channel::from_number(channel as u8 + 1) else { return Ok(true) };
        for message in messages(&bytes) {
            match message {
                Message::Frame(frame, stamp) => {
                    let clock = &mut self.channels[channel].clock;
                    let at = stamp.map_or(At::arrival(arrival), |stamp| {
                        clock.place(stamp.into(), arrival, &mut self.oddities)
                    });
                    self.backlog.push(Incoming::Received { channel: number, frame: frame.into(), at });
                }
                Message::Damaged => {
                    self.oddities.count("messages that cannot be read");
                    let (stage, at) = (LossStage::Link, At::arrival(arrival));
                    self.backlog.push(Incoming::Lost {
                        channel: number,
                        stage,
                        count: 1,
                        at_least: true,
                        at,
                    });
                }
            }
        }
        Ok(true)
    }

    fn start(&mut self, channel: usize, set: Command) -> Result<(), String> {
        for command in [set, Command::Clear, Command::Start] {
            self.tell(channel, command)?;
        }
        self.ask(channel).map(|_| ())
    }

    fn end(&mut self, reason: String) {
        self.ended.get_or_insert(reason);
    }
}

impl Driver for CanalystIi {
    fn row(&self) -> &'static Row {
        row("canalyst-ii").unwrap_or(&crate::ROWS[0])
    }

    fn channels(&self) -> u8 {
        CHANNELS as u8
    }

    fn serial(&self) -> String {
        self.serial.clone()
    }

    fn open(&mut self, channel: Channel, opening: Opening) -> Result<(), Refusal> {
        if opening.listen_only {
            return Err(Refusal::Unsupported);
        }
        let set = wire::set(opening.bitrate_bps).ok_or(Refusal::BadTiming)?;
        let number = channel.index();
        if self.start(number, set).is_err() {
            // If that fails, so will the next read, which has the reason.
            let _ = self.tell(number, Command::Stop);
            return Err(Refusal::Hardware);
        }
        self.channels[number].is_open = true;
        Ok(())
    }

    fn close(&mut self, channel: Channel) {
        let number = channel.index();
        self.channels[number].is_open = false;
        let stopped = self.tell(number, Command::Stop);
        // What it received before that; then the other channel goes on.
        for _ in 0..READS_AT_THE_END {
            if stopped.is_err() || !self.receive(number).unwrap_or(false) {
                break;
            }
        }
    }

    fn send(&mut self, channel: Channel, mailbox: u8, frame: &Frame) -> bool {
        let number = channel.index();
        if self.channels[number].unsent >= MOST_UNSENT {
            return false;
        }
        let at = At::arrival(Instant::now());
        match self.usb.write(number, wire::frame(frame)) {
            Ok(()) => {
                self.channels[number].unsent += 1;
                self.backlog.push(Incoming::Sent { channel, mailbox, at });
            }
            Err(reason) => {
                self.end(reason);
                self.backlog.push(Incoming::NotSent { channel, mailbox, at });
            }
        }
        true
    }

    fn poll(&mut self, wait: Duration, reports: &mut Vec<Incoming>) -> Result<(), String> {
        let mut is_quiet = self.backlog.is_empty();
        for number in 0..CHANNELS {
            if self.channels[number].is_open && self.ended.is_none() {
                match self.receive(number) {
                    Ok(some) => is_quiet &= !some,
                    Err(reason) => self.end(reason),
                }
            }
        }
        reports.append(&mut self.backlog);
        if let Some(reason) = &self.ended {
            return Err(reason.clone());
        }
        if is_quiet {
            std::thread::sleep(wait);
        }
        Ok(())
    }

    fn oddities(&self) -> (u32, String) {
        self.oddities.summary()
    }
}
