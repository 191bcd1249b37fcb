//! ELM327 chips, their many copies, and the STN family (OBDLink), for listening to a bus.
//!
//! After the ELM327's data sheet (v2.2, ELM327DSJ) and the STN1100 family's manual (STN1100FRPMA). Such a chip prints each frame as a line of
//! hexadecimal digits, without a stamp, a length or a checksum, into a buffer of half a kilobyte: on a busy bus it says `BUFFER FULL` and stops
//! until it is told to go on. How many frames that costs nobody knows, nor whether it received every one before. Nothing is sent through it.

mod content;
mod setup;

use std::time::{Duration, Instant};

use cantap_wire::record::LossStage;
use cantap_wire::{Channel, Frame, Refusal};

use self::content::Content;
use crate::driver::{At, Bytes, Driver, Incoming, Oddities, OpenError, Opening, poll_bytes};
use crate::line::Line;
use crate::rows::{Row, row};
use crate::source::Piece;
use crate::text_lines::{Mark, Splitter, Text};

/// Which family's commands are used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Family {
    /// `AT` alone, which copies know, too.
    Elm,
    /// `ST` commands as well.
    Stn,
}

/// Which identifiers are received.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Ids {
    Both,
    Standard,
    Extended,
}

impl Family {
    /// The speed of a serial line if the address gives none: that of chips as they are sold.
    pub const fn default_baud(self) -> u32 {
        match self {
            Self::Elm => 38_400,
            Self::Stn => 115_200,
        }
    }

    const fn expected(self) -> &'static str {
        match self {
            Self::Elm => "an ELM327",
            Self::Stn => "an STN chip (OBDLink)",
        }
    }
}

/// The TCP port of adapters with WLAN, if the address gives none.
pub(crate) const PORT: u16 = 35_000;
/// Time limit for an answer.
const ANSWER_WITHIN: Duration = Duration::from_millis(700);
/// The same for a start, with a test of the lamps.
const START_WITHIN: Duration = Duration::from_secs(3);
/// How long a line must be quiet to be empty.
const QUIET: Duration = Duration::from_millis(60);
/// How soon monitoring is refused, if it is.
const REFUSED_WITHIN: Duration = Duration::from_millis(100);
/// How long the bus is left alone after the chip could not use it.
const RETRY_AFTER: Duration = Duration::from_millis(250);
/// It is told to go on no sooner than this after the last time: one that prompts without an end is not answered without an end.
const GO_ON_EVERY: Duration = Duration::from_millis(20);
/// How soon it prompts once it has stopped, how often it is asked for that before it is given up, and the command for it, which it has had before.
const PROMPTS_WITHIN: Duration = Duration::from_secs(1);
const MAX_UNPROMPTED: u32 = 3;
const ASK_FOR_PROMPT: &[u8] = b"ATL0\r";
/// Lines kept of an answer. None has as many.
const MAX_ANSWER_LINES: usize = 32;
/// Refusals in a row after which there is no more monitoring.
const MAX_REFUSALS: u32 = 3;
/// Ends monitoring, and is thrown away. A chip that waits for a command takes it as part of that; CR would repeat the last one.
const INTERRUPT: &[u8] = b" ";

/// Whether the chip monitors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Monitoring {
    Off,
    On,
    /// It has stopped on its own, and is told to go on once it prompts.
    Ending {
        again: Instant,
    },
    /// It waits for a command, and is to monitor from then on.
    Due {
        again: Instant,
    },
}

/// The driver.
pub(crate) struct Elm327 {
    line: Line,
    family: Family,
    splitter: Splitter,
    version: [u16; 3],
    /// The manual says which frames it receives.
    ids: Ids,
    /// It has confirmed that it does not acknowledge frames.
    is_silent: bool,
    /// Lines have a data length code.
    has_dlc: bool,
    monitoring: Monitoring,
    /// When it was last told to monitor.
    started: Instant,
    refusals: u32,
    /// Times that it was asked for its prompt since it stopped.
    unprompted: u32,
    /// Why it has ended.
    ended: Option<String>,
    backlog: Vec<Incoming>,
    oddities: Oddities,
}

impl Elm327 {
    /// Finds out what is at the other end of a line. Its bus notices nothing.
    pub fn over(line: Line, family: Family, ids: Option<Ids>, address: &str) -> Result<Self, OpenError> {
        let mut elm = Self {
            line,
            family,
            splitter: Splitter::new(Mark::Prompt),
            version: [0; 3],
            ids: Ids::Both,
            is_silent: false,
            has_dlc: false,
            monitoring: Monitoring::Off,
            started: Instant::now(),
            refusals: 0,
            unprompted: 0,
            ended: None,
            backlog: Vec::new(),
            oddities: Oddities::default(),
        };
        elm.set_up(ids, address)?;
        elm.backlog.clear();
        Ok(elm)
    }

    /// Sends a command and returns its answer, line by line, if its prompt comes in time. Frames that come first are taken.
    fn ask(&mut self, command: &str, within: Duration) -> Result<Option<Vec<String>>, String> {
        self.line.write(format!("{command}\r").as_bytes());
        self.until_prompt(within)
    }

    /// What comes until the next prompt. Frames among it are taken.
    fn until_prompt(&mut self, within: Duration) -> Result<Option<Vec<String>>, String> {
        let deadline = Instant::now() + within;
        let mut lines = Vec::new();
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            // Also while it says other things without an end.
            if left.is_zero() {
                return Ok(None);
            }
            let Some(piece) = self.line.next(left)? else { continue };
            let mut texts = Vec::new();
            self.splitter.push(&piece.content, |text| texts.push(text));
            let mut prompted = false;
            for text in texts {
                match text {
                    Text::Mark => prompted = true,
                    Text::Line(line) if self.monitoring != Monitoring::Off => self.take_line(&line, piece.at),
                    Text::Line(line) if lines.len() < MAX_ANSWER_LINES => {
                        lines.push(String::from_utf8_lossy(&line).trim().to_owned());
                    }
                    Text::Line(_) => self.oddities.count("lines of too long an answer"),
                    Text::TooLong => self.damaged("lines longer than any", At::arrival(piece.at)),
                }
            }
            if prompted {
                lines.retain(|line| !line.is_empty());
                return Ok(Some(lines));
            }
        }
    }

    fn take(&mut self, text: Text, arrival: Instant) {
        let at = At::arrival(arrival);
        match text {
            Text::Line(line) => self.take_line(&line, arrival),
            Text::TooLong => self.damaged("lines longer than any", at),
            Text::Mark => match self.monitoring {
                // It has stopped, and says no reason.
                Monitoring::On => {
                    self.gap(LossStage::Controller, at);
                    self.oddities.count("ends of monitoring without a reason");
                    self.monitoring = Monitoring::Due { again: self.next_start(arrival) };
                }
                Monitoring::Ending { again } => {
                    self.unprompted = 0;
                    self.monitoring = Monitoring::Due { again };
                }
                Monitoring::Off | Monitoring::Due { .. } => self.oddities.count("prompts without a command"),
            },
        }
    }

    fn take_line(&mut self, line: &[u8], arrival: Instant) {
        let at = At::arrival(arrival);
        let channel = Channel::Can1;
        let content = content::read(line, self.has_dlc);
        if matches!(content, Content::Frame(_)) {
            self.refusals = 0;
        }
        match content {
            Content::Frame(frame) => {
                self.backlog.push(Incoming::Received { channel, frame: frame.into(), at });
            }
            Content::Nothing => {}
            Content::Damaged => {
                self.oddities.count("frames that the adapter marks as damaged");
                let stage = LossStage::Controller;
                self.backlog.push(Incoming::Lost { channel, stage, count: 1, at_least: false, at });
            }
            Content::BusError => self.backlog.push(Incoming::BusErrors { channel, count: 1, at }),
            Content::BufferFull => {
                self.stops(LossStage::Queue, "times the adapter's buffer was full", at, Duration::ZERO);
            }
            Content::Stopped => {
                self.stops(LossStage::Controller, "ends of monitoring by a stray byte", at, Duration::ZERO);
            }
            Content::Unusable(reason) => {
                self.backlog.push(Incoming::BusErrors { channel, count: 1, at });
                self.stops(LossStage::Controller, reason, at, RETRY_AFTER);
            }
            Content::Refused => {
                // Otherwise this is what is left of a command whose first letter ended monitoring.
                self.refusals += u32::from(self.monitoring == Monitoring::On);
                self.stops(LossStage::Controller, "refusals of monitoring", at, RETRY_AFTER);
                if self.refusals >= MAX_REFUSALS {
                    self.end("it refuses to monitor the bus");
                }
            }
            Content::Restarted(word) => {
                self.gap(LossStage::Controller, at);
                self.oddities.count(word);
                self.end("it has started again, and has forgotten how it was set");
            }
            // Its own command, in spite of `ATE0`.
            Content::Unreadable if line.trim_ascii().starts_with(self.monitor_command().as_bytes()) => {}
            Content::Unreadable => self.damaged("lines that cannot be read", at),
        }
    }

    /// It stops monitoring. What it misses until it goes on is one loss, of unknown size.
    fn stops(&mut self, stage: LossStage, kind: &'static str, at: At, pause: Duration) {
        self.oddities.count(kind);
        if self.monitoring == Monitoring::On {
            self.gap(stage, at);
            self.monitoring = Monitoring::Ending { again: self.next_start(at.instant + pause) };
        }
    }

    fn next_start(&self, at: Instant) -> Instant {
        at.max(self.started + GO_ON_EVERY)
    }

    fn gap(&mut self, stage: LossStage, at: At) {
        self.backlog.push(Incoming::Lost { channel: Channel::Can1, stage, count: 0, at_least: true, at });
    }

    fn damaged(&mut self, kind: &'static str, at: At) {
        self.oddities.count(kind);
        let (channel, stage) = (Channel::Can1, LossStage::Link);
        self.backlog.push(Incoming::Lost { channel, stage, count: 1, at_least: true, at });
    }

    fn end(&mut self, reason: &str) {
        self.ended.get_or_insert_with(|| reason.to_owned());
    }

    /// Monitors again where that is due.
    fn look_after_time(&mut self) {
        let now = Instant::now();
        match self.monitoring {
            Monitoring::Due { again } if again <= now => self.start_monitoring(),
            Monitoring::Ending { again } if again + PROMPTS_WITHIN <= now => {
                if self.unprompted == MAX_UNPROMPTED {
                    return self.end("it has stopped, and no longer answers; unplug it and plug it in again");
                }
                self.oddities.count("prompts that did not come");
                self.unprompted += 1;
                self.line.write(ASK_FOR_PROMPT);
                self.monitoring = Monitoring::Ending { again: now };
            }
            _ => {}
        }
    }

    fn start_monitoring(&mut self) {
        let command = format!("{}\r", self.monitor_command());
        self.line.write(command.as_bytes());
        self.started = Instant::now();
        self.monitoring = Monitoring::On;
    }
}

impl Bytes for Elm327 {
    fn next(&mut self, wait: Duration) -> Result<Option<Piece<Vec<u8>>>, String> {
        self.line.next(wait)
    }

    fn push(&mut self, bytes: &[u8], arrival: Instant) {
        let mut texts = Vec::new();
        self.splitter.push(bytes, |text| texts.push(text));
        for text in texts {
            self.take(text, arrival);
        }
    }

    fn backlog(&mut self) -> &mut Vec<Incoming> {
        &mut self.backlog
    }
}

impl Driver for Elm327 {
    fn row(&self) -> &'static Row {
        let board = match (self.family, self.ids, self.is_silent) {
            (Family::Stn, _, true) => "stn",
            (Family::Stn, _, false) => "stn-normal",
            (Family::Elm, Ids::Both, true) => "elm327",
            (Family::Elm, Ids::Both, false) => "elm327-normal",
            (Family::Elm, Ids::Standard, true) => "elm327-standard",
            (Family::Elm, Ids::Standard, false) => "elm327-standard-normal",
            (Family::Elm, Ids::Extended, true) => "elm327-extended",
            (Family::Elm, Ids::Extended, false) => "elm327-extended-normal",
        };
        row(board).unwrap_or(&crate::ROWS[0])
    }

    fn version(&self) -> [u16; 3] {
        self.version
    }

    fn open(&mut self, _channel: Channel, opening: Opening) -> Result<(), Refusal> {
        self.select(opening)?;
        self.refusals = 0;
        self.start_monitoring();
        // A quiet bus says nothing either: only a refusal comes at once.
        let deadline = Instant::now() + REFUSED_WITHIN;
        while self.ended.is_none() && self.monitoring == Monitoring::On {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.line.next(left) {
                _ if left.is_zero() => break,
                Ok(Some(piece)) => self.push(&piece.content, piece.at),
                Ok(None) => {}
                Err(_) => return Err(Refusal::Hardware),
            }
        }
        if self.ended.is_some() || self.refusals > 0 {
            self.monitoring = Monitoring::Off;
            return Err(Refusal::Unsupported);
        }
        Ok(())
    }

    fn close(&mut self, _channel: Channel) {
        if self.monitoring == Monitoring::On {
            self.line.write(INTERRUPT);
            // If it does not answer, there is nothing to be done about it. Its last frames come before its prompt.
            let _ = self.until_prompt(ANSWER_WITHIN);
        }
        self.monitoring = Monitoring::Off;
        // It leaves the bus.
        let _ = self.ask("ATPC", ANSWER_WITHIN);
    }

    fn send(&mut self, channel: Channel, mailbox: u8, _frame: &Frame) -> bool {
        let at = At::arrival(Instant::now());
        self.backlog.push(Incoming::NotSent { channel, mailbox, at });
        true
    }

    fn poll(&mut self, wait: Duration, reports: &mut Vec<Incoming>) -> Result<(), String> {
        self.look_after_time();
        let polled = poll_bytes(self, wait, reports);
        match self.ended.clone() {
            Some(reason) => Err(reason),
            None => polled,
        }
    }

    fn oddities(&self) -> (u32, String) {
        self.oddities.summary()
    }
}
