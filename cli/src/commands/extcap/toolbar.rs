//! Wireshark's toolbar during a capture: what it shows, and what the user changes. Messages are as in the developer's guide: `T`, the
//! length of the rest in three bytes, the control's number, the command, its payload.

use std::fs::{File, OpenOptions};
use std::io::{self, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, channel};

use cantap::Channel;
use cantap::wire::message::Mode;

use super::bit_rates::OFFERED;
use crate::args;

/// How to take part in a bus.
pub const MODES: [(&str, &str); 2] = [
    ("listen-only", "listen only: send and acknowledge nothing"),
    ("normal", "take part: acknowledge frames"),
];

// Commands.
const INITIALIZED: u8 = 0;
const SET: u8 = 1;
const ADD: u8 = 2;
const DISABLE: u8 = 5;
const STATUS: u8 = 6;

const SYNC: u8 = b'T';
/// Used instead of a control's number if a message concerns none.
const NO_CONTROL: u8 = 255;
/// Wireshark's messages are far shorter than this.
const MAX_MESSAGE_BYTES: usize = 64 * 1024;

/// A part of the toolbar.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Control {
    BitRate1,
    BitRate2,
    Mode,
    Load,
    Lost,
    Log,
}

impl Control {
    pub const ALL: [Self; 6] =
        [Self::BitRate1, Self::BitRate2, Self::Mode, Self::Load, Self::Lost, Self::Log];

    pub const fn number(self) -> u8 {
        self as u8
    }

    /// The rest of its sentence.
    pub const fn description(self) -> &'static str {
        match self {
            Self::BitRate1 => {
                "{type=selector}{display=Channel 1}{tooltip=Bit rate; changing it reopens the channel}"
            }
            Self::BitRate2 => {
                "{type=selector}{display=Channel 2}{tooltip=Bit rate; changing it reopens the channel}"
            }
            Self::Mode => {
                "{type=selector}{display=Mode}{tooltip=How both channels take part; changing it reopens them}"
            }
            Self::Load => "{type=string}{display=Load}{tooltip=Bus load of each channel in the last second}",
            Self::Lost => {
                "{type=string}{display=Lost}{tooltip=Frames lost on the way from each channel so far}"
            }
            Self::Log => {
                "{type=button}{role=logger}{display=Log}{tooltip=Losses and other events of this capture}"
            }
        }
    }

    fn of_channel(channel: Channel) -> Self {
        if channel == Channel::Can1 { Self::BitRate1 } else { Self::BitRate2 }
    }
}

/// A change that the user wants.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// Another bit rate, in bit/s.
    BitRate(Channel, u32),
    /// Another mode of all channels that are open.
    Mode(Mode),
}

/// The toolbar, if there is one: tshark has none.
pub struct Toolbar {
    pub screen: Screen,
    changes: Option<Receiver<Change>>,
}

/// The half that shows something.
#[derive(Clone)]
pub struct Screen(
    /// Messages to the thread that writes, so that a Wireshark that does not read delays nothing.
    Option<Sender<Vec<u8>>>,
);

impl Toolbar {
    /// Opens the pipes named by Wireshark, in separate threads because opening can wait for Wireshark.
    pub fn open(control_in: Option<&Path>, control_out: Option<&Path>) -> io::Result<Self> {
        let thread = |name: &str| std::thread::Builder::new().name(name.to_owned());
        let mut toolbar = Self { screen: Screen(None), changes: None };
        if let Some(path) = control_out.map(PathBuf::from) {
            let (sender, messages) = channel::<Vec<u8>>();
            thread("cantap-toolbar-out").spawn(move || -> io::Result<()> {
                let mut pipe = OpenOptions::new().write(true).open(path)?;
                messages.iter().try_for_each(|message| pipe.write_all(&message))
            })?;
            toolbar.screen = Screen(Some(sender));
        }
        if let Some(path) = control_in.map(PathBuf::from) {
            let (sender, changes) = channel();
            thread("cantap-toolbar-in").spawn(move || {
                // The end of this pipe means that Wireshark has ended, which the capture's own pipe shows.
                let _ = File::open(path).and_then(|pipe| listen(BufReader::new(pipe), &sender));
            })?;
            toolbar.changes = Some(changes);
        }
        Ok(toolbar)
    }

    /// What the user has changed since the last call.
    pub fn changes(&self) -> Vec<Change> {
        self.changes.iter().flat_map(Receiver::try_iter).collect()
    }
}

impl Screen {
    /// A toolbar that a test can examine.
    #[cfg(test)]
    pub fn of_test() -> (Self, Receiver<Vec<u8>>) {
        let (sender, messages) = channel();
        (Self(Some(sender)), messages)
    }

    /// Whether anybody sees it.
    pub const fn is_there(&self) -> bool {
        self.0.is_some()
    }

    /// Sets its initial state for the capture.
    pub fn begin(&self) {
        for control in [Control::Load, Control::Lost] {
            self.send(control.number(), DISABLE, "");
        }
    }

    /// Shows a text.
    pub fn set(&self, control: Control, text: &str) {
        self.send(control.number(), SET, text);
    }

    /// Shows a channel's settings.
    pub fn show_channel(&self, channel: Channel, bitrate_bps: u32, mode: Mode) {
        let control = Control::of_channel(channel);
        let mut offered = OFFERED.iter().map(|(offered, _)| *offered);
        if let Some(offered) = offered.find(|offered| args::bitrate(offered) == Ok(bitrate_bps)) {
            self.set(control, offered);
        } else {
            self.send(control.number(), ADD, &format!("{bitrate_bps}\0{bitrate_bps} bit/s"));
            self.set(control, &bitrate_bps.to_string());
        }
        self.set(Control::Mode, mode.name());
    }

    /// Shows a message in the status bar and in the log.
    pub fn report(&self, text: &str) {
        self.send(NO_CONTROL, STATUS, text);
        self.log(text);
    }

    /// Adds a line to the log.
    pub fn log(&self, line: &str) {
        self.send(Control::Log.number(), ADD, &format!("{line}\n"));
    }

    fn send(&self, control: u8, command: u8, payload: &str) {
        if let Some(out) = &self.0 {
            // If the thread has ended, nobody reads.
            let _ = out.send(message(control, command, payload.as_bytes()));
        }
    }
}

fn message(control: u8, command: u8, payload: &[u8]) -> Vec<u8> {
    let payload = &payload[..payload.len().min(MAX_MESSAGE_BYTES)];
    let [_, length @ ..] = (payload.len() as u32 + 2).to_be_bytes();
    [&[SYNC], &length[..], &[control, command], payload].concat()
}

/// Passes on the user's changes, until the pipe ends. What Wireshark sends before it is initialised are values left in the toolbar by an
/// earlier capture: nobody has requested them for this one.
fn listen(mut pipe: impl Read, changes: &Sender<Change>) -> io::Result<()> {
    let mut is_initialized = false;
    loop {
        let mut head = [0; 6];
        pipe.read_exact(&mut head)?;
        let [sync, length @ .., control, command] = head;
        let [a, b, c] = length;
        let length = u32::from_be_bytes([0, a, b, c]) as usize;
        if sync != SYNC || !(2..=MAX_MESSAGE_BYTES).contains(&length) {
            return Err(io::ErrorKind::InvalidData.into());
        }
        let mut payload = vec![0; length - 2];
        pipe.read_exact(&mut payload)?;
        let text = String::from_utf8_lossy(&payload);
        match command {
            INITIALIZED => is_initialized = true,
            SET if is_initialized => {
                if let Some(change) = change(control, text.trim_end_matches('\0'))
                    && changes.send(change).is_err()
                {
                    return Ok(());
                }
            }
            _ => {}
        }
    }
}

fn change(control: u8, value: &str) -> Option<Change> {
    let control = Control::ALL.into_iter().find(|known| known.number() == control)?;
    let rate = || args::bitrate(value).ok();
    match control {
        Control::BitRate1 => rate().map(|bitrate_bps| Change::BitRate(Channel::Can1, bitrate_bps)),
        Control::BitRate2 => rate().map(|bitrate_bps| Change::BitRate(Channel::Can2, bitrate_bps)),
        Control::Mode => {
            [Mode::ListenOnly, Mode::Normal].into_iter().find(|mode| mode.name() == value).map(Change::Mode)
        }
        Control::Load | Control::Lost | Control::Log => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_clicked_during_the_capture_is_done() {
        let (sender, changes) = channel();
        let said = [
            message(Control::Mode.number(), SET, b"normal"),
            message(NO_CONTROL, INITIALIZED, b""),
            message(Control::BitRate2.number(), SET, b"250k"),
            message(Control::BitRate1.number(), SET, b""),
            message(Control::Log.number(), SET, b"x"),
            message(99, SET, b"x"),
            message(Control::Mode.number(), SET, b"loopback"),
            message(Control::Mode.number(), SET, b"normal"),
        ];
        assert_eq!(listen(&said.concat()[..], &sender).unwrap_err().kind(), io::ErrorKind::UnexpectedEof);
        assert_eq!(
            changes.try_iter().collect::<Vec<_>>(),
            [Change::BitRate(Channel::Can2, 250_000), Change::Mode(Mode::Normal)]
        );
    }

    #[test]
    fn a_message_is_as_the_guide_has_it_and_garbage_ends_the_pipe() {
        assert_eq!(message(3, SET, b"48 %"), b"T\0\0\x06\x03\x0148 %");
        let (sender, _orders) = channel();
        for garbage in [&b"X\0\0\x02\0\0"[..], b"T\0\0\x01\0\0", b"T\xFF\xFF\xFF\0\0"] {
            assert_eq!(listen(garbage, &sender).unwrap_err().kind(), io::ErrorKind::InvalidData);
        }
    }
}
