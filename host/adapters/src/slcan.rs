//! slcan: Lawicel's protocol, spoken by many adapters, and CANable's dialect of it.
//!
//! Lawicel's manual ("CAN232", version 3) answers each command with CR or BEL; CANable's firmware (`canable-fw`, `src/slcan.c`) answers none
//! but `V`, has `M1` for silent mode in place of `L`, and puts data bytes into remote frames. The lines `e` and `s` with errors and states are
//! those that Linux reads (`drivers/net/can/slcan/slcan-core.c`).

mod lines;

use std::time::{Duration, Instant};

use cantap_wire::record::{BusErrorKind, ErrorState, LossStage, Stamp};
use cantap_wire::{Channel, Frame, Id, Refusal};

use self::lines::line_of;
use crate::adapter_clock::AdapterClock;
use crate::driver::{At, Bytes, Driver, Incoming, Oddities, OpenError, Opening, poll_bytes};
use crate::line::Line;
use crate::rows::{Row, row};
use crate::source::Piece;
use crate::text_lines::{Mark, Splitter, Text, hex, number};

/// The speed of a serial line if the address gives none. USB adapters ignore it.
pub(crate) const DEFAULT_BAUD: u32 = 115_200;
/// Time limit for an answer.
const ANSWER_WITHIN: Duration = Duration::from_millis(500);
/// How long a line must be quiet to be empty.
const QUIET: Duration = Duration::from_millis(60);
/// How often the flags are asked for.
const FLAGS_EVERY: Duration = Duration::from_secs(1);
/// A refused frame is offered again after this time.
const RETRY_AFTER: Duration = Duration::from_millis(2);
/// An unanswered frame counts as taken after this time: the answer was lost.
const UNANSWERED: Duration = Duration::from_secs(1);
/// Bit rates of `S0` to `S8` in bit/s (Lawicel).
const RATES: [u32; 9] = [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000];

/// Bits of the flags (Lawicel, `F`).
const FLAG_FIFO_FULL: u8 = 1 << 0;
const FLAG_WARNING: u8 = 1 << 2;
const FLAG_OVERRUN: u8 = 1 << 3;
const FLAG_PASSIVE: u8 = 1 << 5;
const FLAG_BUS_ERROR: u8 = 1 << 7;

/// How an adapter answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Dialect {
    /// CR or BEL to each command.
    Lawicel { listens: bool },
    /// Nothing.
    Canable,
}

/// A frame that the adapter has been given and has not answered.
#[derive(Clone, Copy)]
struct InFlight {
    mailbox: u8,
    frame: Frame,
    given: Instant,
    /// It was refused, and is to be offered again then.
    again: Option<Instant>,
}

/// The driver.
pub(crate) struct Slcan {
    line: Line,
    dialect: Dialect,
    splitter: Splitter,
    version: [u16; 3],
    serial: String,
    is_open: bool,
    in_flight: Option<InFlight>,
    /// When the flags were last asked for; never again once an adapter has refused to answer.
    flags_asked: Option<Instant>,
    flags_refused: bool,
    ms_clock: AdapterClock,
    us_clock: AdapterClock,
    backlog: Vec<Incoming>,
    oddities: Oddities,
}

impl Slcan {
    /// Finds out what is at a port. The bus notices nothing: the channel is closed, and opened at most to listen.
    pub fn open_port(port: &str, baud: u32) -> Result<Self, OpenError> {
        Self::over(Line::serial(port, baud)?, port)
    }

    fn over(line: Line, address: &str) -> Result<Self, OpenError> {
        let mut slcan = Self {
            line,
            dialect: Dialect::Lawicel { listens: false },
            splitter: Splitter::new(Mark::Bell),
            version: [0; 3],
            serial: String::new(),
            is_open: false,
            in_flight: None,
            flags_asked: None,
            flags_refused: false,
            // Lawicel's stamps start again after a minute.
            ms_clock: AdapterClock::new(1_000_000, 60_000),
            us_clock: AdapterClock::new(1_000, 1 << 32),
            backlog: Vec::new(),
            oddities: Oddities::default(),
        };
        let foreign =
            |_: String| OpenError::Foreign { address: address.to_owned(), expected: "an slcan adapter" };
        slcan.greet().map_err(foreign)?;
        Ok(slcan)
    }

    fn greet(&mut self) -> Result<(), String> {
        // Whatever half a line is there ends, and a channel that an earlier program left open is closed.
        self.line.write(b"\r\r\rC\r");
        self.line.discard(QUIET)?;
        self.splitter = Splitter::new(Mark::Bell);
        let Some(answer) = self.ask(b"V\r")? else { return Err("no answer".to_owned()) };
        if let Text::Line(text) = &answer
            && text.first() != Some(&b'V')
            && !text.is_empty()
        {
            self.dialect = Dialect::Canable;
            let text = String::from_utf8_lossy(text);
            text.split_whitespace().next().unwrap_or_default().clone_into(&mut self.serial);
            return Ok(());
        }
        if let Text::Line(text) = &answer {
            let digits = |range: std::ops::Range<usize>| number(text.get(range).unwrap_or_default());
            self.version = [digits(1..3), digits(3..5), 0];
        }
        match self.ask(b"N\r")? {
            Some(Text::Line(text)) if text.starts_with(b"V") => {
                // Everything would be taken for the answer to what is asked next, a refusal to be silent for none.
                return Err("its answers come twice".to_owned());
            }
            Some(Text::Line(text)) => {
                let serial = text.strip_prefix(b"N").unwrap_or_default();
                self.serial = String::from_utf8_lossy(serial).into_owned();
            }
            _ => {}
        }
        // Listening disturbs nobody, whatever the bit rate.
        let set = self.ask(b"S6\r")?;
        let listens = is_done(set.as_ref()) && is_done(self.ask(b"L\r")?.as_ref());
        self.ask(b"C\r")?;
        self.dialect = Dialect::Lawicel { listens };
        // What it received meanwhile belongs to nobody.
        self.backlog.clear();
        Ok(())
    }

    /// Sends a command and returns the first line that is no frame, if one comes in time.
    fn ask(&mut self, command: &[u8]) -> Result<Option<Text>, String> {
        self.line.write(command);
        // Else it has a letter of its own, or answers a question that was put before.
        let asks = matches!(command.first(), Some(b'V' | b'N'));
        let deadline = Instant::now() + ANSWER_WITHIN;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            // Also while it says other things without an end.
            if left.is_zero() {
                return Ok(None);
            }
            let Some(piece) = self.line.next(left)? else { continue };
            let mut lines = Vec::new();
            self.splitter.push(&piece.content, |text| lines.push(text));
            let mut answer = None;
            for text in lines {
                let is_other = matches!(&text, Text::Line(line) if match line.first() {
                    Some(b't' | b'T' | b'r' | b'R' | b'e' | b's') => true,
                    Some(b'V' | b'N' | b'F' | b'z' | b'Z') => !asks,
                    _ => false,
                });
                if answer.is_none() && !is_other {
                    answer = Some(text);
                } else {
                    self.take(text, piece.at);
                }
            }
            if answer.is_some() {
                return Ok(answer);
            }
        }
    }

    /// A command that must be answered with CR where anything is answered.
    fn order(&mut self, command: &[u8], refusal: Refusal) -> Result<(), Refusal> {
        if self.dialect == Dialect::Canable {
            self.line.write(command);
            return Ok(());
        }
        match self.ask(command) {
            Ok(answer) if is_done(answer.as_ref()) => Ok(()),
            Ok(Some(_)) => Err(refusal),
            Ok(None) | Err(_) => Err(Refusal::Hardware),
        }
    }

    fn take(&mut self, text: Text, arrival: Instant) {
        let at = At::arrival(arrival);
        let line = match text {
            Text::Line(line) => line,
            Text::Mark => {
                match &mut self.in_flight {
                    Some(frame) => frame.again = Some(Instant::now() + RETRY_AFTER),
                    None if self.flags_asked.is_some() => self.flags_refused = true,
                    None => self.oddities.count("refusals of nothing"),
                }
                return;
            }
            Text::TooLong => return self.damaged("lines longer than any", at),
        };
        match line.split_first() {
            // CR alone, or z and Z, answer a frame; otherwise an earlier command.
            None | Some((b'z' | b'Z', _)) => self.confirm(at),
            Some((b't' | b'T' | b'r' | b'R', _)) => match self.frame(&line, arrival) {
                Some((frame, at)) => {
                    self.backlog.push(Incoming::Received { channel: Channel::Can1, frame: frame.into(), at });
                }
                None => self.damaged("frames that cannot be read", at),
            },
            Some((b'F', digits)) if digits.len() == 2 => match hex(digits) {
                Some(flags) => self.flags(flags as u8, at),
                None => self.oddities.count("flags that cannot be read"),
            },
            Some((b'e', rest)) => self.errors(rest, at),
            Some((b's', rest)) => self.state(rest, at),
            Some(_) => self.oddities.count("lines of unknown meaning"),
        }
    }

    /// Something unreadable came where frames do: at least one may be missing.
    fn damaged(&mut self, kind: &'static str, at: At) {
        self.oddities.count(kind);
        let (channel, stage) = (Channel::Can1, LossStage::Link);
        self.backlog.push(Incoming::Lost { channel, stage, count: 1, at_least: true, at });
    }

    fn confirm(&mut self, at: At) {
        if let Some(InFlight { mailbox, again: None, .. }) = self.in_flight {
            self.in_flight = None;
            self.backlog.push(Incoming::Sent { channel: Channel::Can1, mailbox, at });
        } else {
            self.oddities.count("answers to nothing");
        }
    }

    /// A received frame, with a stamp if the adapter adds one.
    fn frame(&mut self, line: &[u8], arrival: Instant) -> Option<(Frame, At)> {
        let (kind, rest) = line.split_first()?;
        let (id_len, remote) = match kind {
            b't' => (3, false),
            b'T' => (8, false),
            b'r' => (3, true),
            _ => (8, true),
        };
        let (id, rest) = rest.split_at_checked(id_len)?;
        let raw = hex(id)?;
        let id = if id_len == 3 { Id::standard(raw) } else { Id::extended(raw) }?;
        let (dlc, rest) = rest.split_at_checked(1)?;
        let dlc = hex(dlc)? as u8;
        let data_len = usize::from(dlc.min(8));
        let (data, stamp) = match rest.len() {
            // CANable's remote frames have data bytes, which mean nothing.
            len if remote && (len == 0 || len == 4 || len == 8) && len != 2 * data_len => rest.split_at(0),
            _ => rest.split_at_checked(2 * data_len)?,
        };
        let mut bytes = [0; 8];
        for (byte, digits) in bytes.iter_mut().zip(data.chunks(2)) {
            *byte = hex(digits)? as u8;
        }
        let at = match stamp.len() {
            0 => At::arrival(arrival),
            4 => self.ms_clock.place(u64::from(hex(stamp)?), arrival, &mut self.oddities),
            8 => self.us_clock.place(u64::from(hex(stamp)?), arrival, &mut self.oddities),
            _ => return None,
        };
        // A millisecond tells less than the arrival, but no more than it knows is claimed: it is an upper bound either way.
        let at = if stamp.len() == 4 { At { stamp: Stamp::UpperBound, ..at } } else { at };
        let data = if remote { [0; 8] } else { bytes };
        Some((Frame::from_bus(id, remote, dlc, data), at))
    }

    fn flags(&mut self, flags: u8, at: At) {
        let channel = Channel::Can1;
        if flags & (FLAG_FIFO_FULL | FLAG_OVERRUN) != 0 {
            let stage = LossStage::Controller;
            self.backlog.push(Incoming::Lost { channel, stage, count: 1, at_least: true, at });
        }
        if flags & FLAG_BUS_ERROR != 0 {
            self.backlog.push(Incoming::BusErrors { channel, count: 1, at });
        }
        let state = match flags {
            _ if flags & FLAG_PASSIVE != 0 => ErrorState::Passive,
            _ if flags & FLAG_WARNING != 0 => ErrorState::Warning,
            _ => ErrorState::Active,
        };
        self.backlog.push(Incoming::State { channel, state, counters: (0, 0), at });
    }

    /// `e`, a digit, and so many letters.
    fn errors(&mut self, rest: &[u8], at: At) {
        let channel = Channel::Can1;
        let letters = rest.split_first().and_then(|(count, letters)| {
            let count = char::from(*count).to_digit(10)? as usize;
            letters.get(..count)
        });
        let Some(letters) = letters else { return self.oddities.count("error reports that cannot be read") };
        // A kind occurs three times in a report of one event, since Linux reads no shorter line.
        let mut seen = Vec::new();
        for letter in letters {
            if seen.contains(letter) {
                continue;
            }
            seen.push(*letter);
            match (letter, BusErrorKind::from_slcan_letter(*letter)) {
                (_, Some(kind)) => self.backlog.push(Incoming::BusError { channel, kind, at }),
                (b'o', _) => {
                    let stage = LossStage::Controller;
                    self.backlog.push(Incoming::Lost { channel, stage, count: 1, at_least: true, at });
                }
                (b'O', _) => {}
                _ => self.oddities.count("error reports of unknown kind"),
            }
        }
    }

    /// `s`, a letter, and receive and transmit counter of three digits each.
    fn state(&mut self, rest: &[u8], at: At) {
        let state = match rest.first() {
            Some(b'f') => Some(ErrorState::BusOff),
            letter => letter.and_then(|letter| ErrorState::from_slcan_letter(*letter)),
        };
        let Some(state) = state else { return self.oddities.count("states that cannot be read") };
        let number = |range: std::ops::Range<usize>| {
            std::str::from_utf8(rest.get(range)?).ok()?.parse::<u16>().ok().map(|value| value.min(255) as u8)
        };
        let (Some(rec), Some(tec)) = (number(1..4), number(4..7)) else {
            return self.oddities.count("states that cannot be read");
        };
        self.backlog.push(Incoming::State { channel: Channel::Can1, state, counters: (tec, rec), at });
    }

    /// Offers a refused frame again; asks for the flags.
    fn look_after_time(&mut self) {
        let now = Instant::now();
        if let Some(frame) = &mut self.in_flight {
            if frame.again.is_some_and(|again| again <= now) {
                (frame.again, frame.given) = (None, now);
                let text = line_of(&frame.frame);
                self.line.write(&text);
            } else if frame.again.is_none() && now.duration_since(frame.given) > UNANSWERED {
                self.oddities.count("frames sent and not answered");
                self.confirm(At::arrival(now));
            }
        }
        let asks = self.is_open
            && self.dialect != Dialect::Canable
            && !self.flags_refused
            && self.in_flight.is_none();
        if asks && self.flags_asked.is_none_or(|asked| now.duration_since(asked) >= FLAGS_EVERY) {
            self.flags_asked = Some(now);
            self.line.write(b"F\r");
        }
    }
}

impl Bytes for Slcan {
    fn next(&mut self, wait: Duration) -> Result<Option<Piece<Vec<u8>>>, String> {
        self.line.next(wait)
    }

    fn push(&mut self, bytes: &[u8], arrival: Instant) {
        let mut lines = Vec::new();
        self.splitter.push(bytes, |text| lines.push(text));
        for text in lines {
            self.take(text, arrival);
        }
    }

    fn backlog(&mut self) -> &mut Vec<Incoming> {
        &mut self.backlog
    }
}

impl Driver for Slcan {
    fn row(&self) -> &'static Row {
        let board = match self.dialect {
            Dialect::Lawicel { listens: true } => "slcan",
            Dialect::Lawicel { listens: false } => "slcan-normal",
            Dialect::Canable => "slcan-canable",
        };
        row(board).unwrap_or(&crate::ROWS[0])
    }

    fn serial(&self) -> String {
        self.serial.clone()
    }

    fn version(&self) -> [u16; 3] {
        self.version
    }

    fn open(&mut self, _channel: Channel, opening: Opening) -> Result<(), Refusal> {
        let index = RATES.iter().position(|rate| *rate == opening.bitrate_bps).ok_or(Refusal::BadTiming)?;
        self.order(format!("S{index}\r").as_bytes(), Refusal::BadTiming)?;
        match self.dialect {
            Dialect::Canable => {
                self.order(if opening.listen_only { b"M1\r" } else { b"M0\r" }, Refusal::Unsupported)?;
                self.order(b"O\r", Refusal::Unsupported)?;
            }
            Dialect::Lawicel { .. } => {
                self.order(if opening.listen_only { b"L\r" } else { b"O\r" }, Refusal::Unsupported)?;
            }
        }
        self.is_open = true;
        self.flags_asked = Some(Instant::now());
        Ok(())
    }

    fn close(&mut self, _channel: Channel) {
        self.is_open = false;
        self.in_flight = None;
        // If it does not answer, there is nothing to be done about it.
        let _ = self.order(b"C\r", Refusal::Hardware);
    }

    fn send(&mut self, _channel: Channel, mailbox: u8, frame: &Frame) -> bool {
        // One at a time: the answers do not say to which frame they belong.
        if self.in_flight.is_some() {
            return false;
        }
        let text = line_of(frame);
        self.line.write(&text);
        let now = Instant::now();
        if self.dialect == Dialect::Canable {
            self.backlog.push(Incoming::Sent { channel: Channel::Can1, mailbox, at: At::arrival(now) });
        } else {
            self.in_flight = Some(InFlight { mailbox, frame: *frame, given: now, again: None });
        }
        true
    }

    fn poll(&mut self, wait: Duration, reports: &mut Vec<Incoming>) -> Result<(), String> {
        self.look_after_time();
        poll_bytes(self, wait, reports)
    }

    fn oddities(&self) -> (u32, String) {
        self.oddities.summary()
    }
}

fn is_done(answer: Option<&Text>) -> bool {
    matches!(answer, Some(Text::Line(_)))
}
