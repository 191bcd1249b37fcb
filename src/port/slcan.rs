//! slcan: Lawicel's ASCII protocol on channel 1, for python-can, slcand and terminal programs.
//!
//! Commands follow the CANUSB manual (Lawicel AB, version 1.0D): a letter, parameters, CR; answered by CR, or BEL for a
//! refusal. `I` and `Y`, the registers now and at the last error, are those of an earlier analyser. Losses show in the flags
//! that `F` reads, and with `K1` as separate lines.

mod report;

use core::fmt::Write;

use cantap_wire::message::{ChannelConfig, Filter, FrameKind, Mode, RegisterSet, TxFrame};
use cantap_wire::record::{self, ErrorState, LossStage, Record, TransmitFailure};
use cantap_wire::{BitTiming, Channel, Command, Event, Frame, Id, Refusal};
use heapless::{String, Vec};

use crate::bus::queue::Consumer;
use crate::port::board::Board;
use crate::port::command::{Commands, Step, Work, send};
use crate::{CAN_CLOCK_HZ, TICKS_PER_MS, TICKS_PER_US};

/// The channel that slcan works on.
const CHANNEL: Channel = Channel::Can1;
/// Bit rates of `S0` to `S9`, in bit/s. Lawicel's manual ends with `S8`; python-can uses `S9` for 83.3 kbit/s.
const RATES_BPS: [u32; 10] =
    [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000, 83_333];
/// The bit rate that python-can means by `S7`. It can be recognised by the empty line that it sends after every `S`, in
/// place of a data bit rate (python-can 4.5, `interfaces/slcan.py`).
const S7_OF_PYTHON_CAN_BPS: u32 = 750_000;
/// Clock that the registers of `s` refer to: an SJA1000 at 16 MHz, which it halves.
const SJA1000_HZ: u32 = 8_000_000;
/// Stamps of `Z1` wrap after a minute.
const STAMP_WRAP_MS: u64 = 60_000;
/// Longest line for a frame: `T`, 8 identifier, 1 DLC, 16 data, 8 stamp, CR.
const MAX_FRAME_LINE: usize = 1 + 8 + 1 + 16 + 8 + 1;
/// How long a frame waits for room in a queue in which nothing moves: no frame at 10 kbit/s and above takes longer.
const FULL_TICKS: u32 = 100 * TICKS_PER_MS;
/// Bytes of lines for one filling of the outbox.
const MAX_LINES_BYTES: usize = 1024;

/// Bits of the answer to `F`.
mod flag {
    pub const RX_FULL: u8 = 1 << 0;
    pub const TX_FULL: u8 = 1 << 1;
    pub const WARNING: u8 = 1 << 2;
    pub const OVERRUN: u8 = 1 << 3;
    pub const PASSIVE: u8 = 1 << 5;
    pub const ARBITRATION_LOST: u8 = 1 << 6;
    pub const BUS_ERROR: u8 = 1 << 7;
}

/// How a line is answered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Answer {
    /// CR.
    Ok,
    /// BEL.
    Refused,
    /// This text and CR.
    Text(String<64>),
}

/// Stamps after frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stamps {
    Off,
    /// `Z1`: four digits.
    Milliseconds,
    /// `Z2`: eight digits.
    Microseconds,
}

/// The bit rate that the host asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Rate {
    /// None: the saved one applies.
    Unset,
    /// One that is not available. Few programs check the answers, so this is remembered: no channel is opened at a rate that was
    /// not asked for.
    Refused,
    Set(BitTiming),
}

impl Rate {
    /// The rate that an `S` asks for, if there is a timing for it.
    fn of(bitrate_bps: u32) -> Option<Self> {
        BitTiming::choose(CAN_CLOCK_HZ, bitrate_bps, None).ok().map(Self::Set)
    }
}

/// The slcan side of a session.
pub struct Slcan {
    answer: Option<Answer>,
    rate: Rate,
    /// The last line was `S7`.
    is_seven: bool,
    stamps: Stamps,
    /// Frames are sent as they come (`X1`), rather than on `P` and `A`. On from the start, as
    /// python-can and slcand expect.
    auto_poll: bool,
    /// Frames requested by `P` and `A` and not sent yet.
    polled: u32,
    /// `A` ends its frames with an `A`.
    polling_all: bool,
    /// `W1`: one long filter rather than two short ones.
    single_filter: bool,
    code: u32,
    mask: u32,
    flags: u8,
    /// What `K` set, if it was sent: whether losses, errors and states are reported as lines.
    asked_reports: Option<bool>,
    /// Whether they are reported, as decided when the channel was opened: without a `K`, as saved.
    reports: bool,
    /// A frame was refused because there was no room, and this has not been reported yet.
    refused_frame: bool,
    tag: u32,
    running_ticks: u64,
    /// Since when the transmit queue has been full.
    full_since: Option<u32>,
}

impl Slcan {
    /// Longest line, CR not counted: `T`, 8 identifier, 1 DLC, 16 data; and room beyond that, so that a longer line is still read
    /// and refused.
    pub const MAX_LINE: usize = 64;

    /// The state after `C`.
    pub const fn new() -> Self {
        Self {
            answer: None,
            rate: Rate::Unset,
            is_seven: false,
            stamps: Stamps::Off,
            auto_poll: true,
            polled: 0,
            polling_all: false,
            single_filter: false,
            code: 0,
            mask: u32::MAX,
            flags: 0,
            asked_reports: None,
            reports: false,
            refused_frame: false,
            tag: 0,
            running_ticks: 0,
            full_since: None,
        }
    }

    /// A session begins at `now`.
    pub fn restart(&mut self, now: u64) {
        *self = Self { running_ticks: now, ..Self::new() };
    }

    /// Whether an answer is waiting to be sent.
    pub const fn is_answering(&self) -> bool {
        self.answer.is_some()
    }

    /// Whether a line that begins with this byte must wait, as a frame to be sent does for room in the queue. Few programs check
    /// the answers, so a refused frame would simply be lost. If nothing has left the queue for a while, it is refused
    /// nevertheless.
    pub fn must_wait<'q, const N: usize>(
        &mut self,
        first: Option<u8>,
        board: &mut impl Board<'q, N>,
    ) -> bool {
        if !matches!(first, Some(b't' | b'T' | b'r' | b'R')) {
            return false;
        }
        let has_room = board.with_capture(|capture, _, _| {
            capture.config(CHANNEL).is_none() || capture.transmitter(CHANNEL).free() > 0
        });
        if has_room {
            self.full_since = None;
            return false;
        }
        let now = board.now();
        now.wrapping_sub(*self.full_since.get_or_insert(now)) < FULL_TICKS
    }

    /// Answers the last line.
    pub fn answer(&mut self, answer: Answer) {
        self.answer = Some(answer);
    }

    /// Handles one line: answers it, or returns the work whose result answers it.
    pub fn line<'q, const N: usize>(
        &mut self,
        line: &[u8],
        commands: &mut Commands,
        board: &mut impl Board<'q, N>,
    ) -> Option<Work> {
        // Empty lines are answered, since hosts send them to synchronise.
        let line = line.trim_ascii();
        let was_seven = core::mem::take(&mut self.is_seven);
        let Some((&letter, parameters)) = line.split_first() else {
            if was_seven {
                self.rate = Rate::of(S7_OF_PYTHON_CAN_BPS).unwrap_or(Rate::Refused);
            }
            self.answer = Some(Answer::Ok);
            return None;
        };
        match self.obey(letter, parameters, commands, board) {
            Some(Done::Answer(answer)) => self.answer = Some(answer),
            Some(Done::Begun(work)) => return Some(work),
            Some(Done::Silent) => {}
            None => self.answer = Some(Answer::Refused),
        }
        None
    }

    /// Carries out a line. `None` is a refusal.
    fn obey<'q, const N: usize>(
        &mut self,
        letter: u8,
        parameters: &[u8],
        commands: &mut Commands,
        board: &mut impl Board<'q, N>,
    ) -> Option<Done> {
        let config = board.with_capture(|capture, _, _| capture.config(CHANNEL).copied());
        let open = config.is_some();
        let ok = Done::Answer(Answer::Ok);
        match (letter, parameters) {
            (b'S' | b's', parameters) if !open => {
                self.rate = Rate::Refused;
                self.rate = match (letter, parameters) {
                    (b'S', &[digit @ b'0'..=b'9']) => {
                        self.is_seven = digit == b'7';
                        Rate::of(RATES_BPS[usize::from(digit - b'0')])?
                    }
                    (b's', registers) if registers.len() == 4 => {
                        Rate::Set(timing_of_sja1000(hex(registers)? as u16)?)
                    }
                    _ => return None,
                };
                Some(ok)
            }
            (b'O', []) if !open => self.open(Mode::Normal, commands, board),
            (b'L', []) if !open => self.open(Mode::ListenOnly, commands, board),
            // What a gateway without a host has opened, is not a program's to close; many begin with this.
            (b'C', []) if !board.with_capture(|capture, _, _| capture.is_standalone()) => {
                run(Command::Close { channel: CHANNEL }, commands, board)
            }
            (b't' | b'T' | b'r' | b'R', parameters) => {
                let frame = parse_frame(letter, parameters)?;
                self.transmit(frame, letter, board)
            }
            (b'Z', &[digit @ b'0'..=b'2']) if !open => {
                self.stamps =
                    [Stamps::Off, Stamps::Milliseconds, Stamps::Microseconds][usize::from(digit - b'0')];
                Some(ok)
            }
            (b'X', &[digit @ b'0'..=b'1']) if !open => {
                self.auto_poll = digit == b'1';
                Some(ok)
            }
            (b'K', &[digit @ b'0'..=b'1']) if !open => {
                self.asked_reports = Some(digit == b'1');
                Some(ok)
            }
            (b'P', []) if open && !self.auto_poll => {
                self.polled = 1;
                self.polling_all = false;
                Some(Done::Silent)
            }
            (b'A', []) if open && !self.auto_poll => {
                self.polled = u32::MAX;
                self.polling_all = true;
                Some(Done::Silent)
            }
            (b'F', []) if open => {
                let mut text = String::new();
                write!(text, "F{:02X}", self.flags).ok()?;
                self.flags = 0;
                Some(Done::Answer(Answer::Text(text)))
            }
            (b'V', []) => {
                let [major, minor, _] = commands.hello().firmware;
                let mut text = String::new();
                write!(text, "V10{}{}", major % 10, minor % 10).ok()?;
                Some(Done::Answer(Answer::Text(text)))
            }
            (b'N', []) => {
                let serial = commands.hello().serial;
                let short = serial.get(serial.len().checked_sub(4)?..)?;
                let mut text = String::new();
                write!(text, "N{short}").ok()?;
                Some(Done::Answer(Answer::Text(text)))
            }
            (b'W', &[digit @ b'0'..=b'1']) if !open => {
                self.single_filter = digit == b'1';
                self.set_filters(commands, board).then_some(ok)
            }
            (b'M', parameters) if !open && parameters.len() == 8 => {
                self.code = hex(parameters)?;
                self.set_filters(commands, board).then_some(ok)
            }
            (b'm', parameters) if !open && parameters.len() == 8 => {
                self.mask = hex(parameters)?;
                self.set_filters(commands, board).then_some(ok)
            }
            (b'Q', [b'0']) if !open => run(Command::ClearDefaults, commands, board),
            (b'Q', [b'1' | b'2']) if !open => self.save(commands, board),
            (b'I' | b'Y', []) => {
                let registers = board.with_capture(|capture, traffic, _| {
                    capture.registers(CHANNEL, &traffic[CHANNEL.index()])
                });
                let set = if letter == b'I' { registers.now } else { registers.at_last_error? };
                Some(Done::Answer(Answer::Text(registers_text(letter, &set)?)))
            }
            _ => None,
        }
    }

    fn open<'q, const N: usize>(
        &mut self,
        mode: Mode,
        commands: &mut Commands,
        board: &mut impl Board<'q, N>,
    ) -> Option<Done> {
        let timing = match self.rate {
            Rate::Set(timing) => timing,
            Rate::Refused => return None,
            Rate::Unset => commands.config_or_saved(CHANNEL, board)?.timing,
        };
        let config = ChannelConfig { mode, ..ChannelConfig::listen_only(timing) };
        self.flags = 0;
        self.polled = 0;
        self.reports = self.asked_reports.unwrap_or_else(|| commands.saved_reports(board));
        run(Command::Open { channel: CHANNEL, config: Some(config) }, commands, board)
    }

    /// Saves the bit rate and what `K` set, if one of them was sent.
    fn save<'q, const N: usize>(
        &self,
        commands: &mut Commands,
        board: &mut impl Board<'q, N>,
    ) -> Option<Done> {
        if let Rate::Set(timing) = self.rate {
            let before = commands.config(CHANNEL).unwrap_or_else(|| ChannelConfig::listen_only(timing));
            let config = ChannelConfig { timing, ..before };
            commands.execute(Command::Configure { channel: CHANNEL, config }, board).ok()?;
        }
        let saved = self.rate != Rate::Refused && commands.save(self.asked_reports, board).is_ok();
        saved.then_some(Done::Answer(Answer::Ok))
    }

    fn transmit<'q, const N: usize>(
        &mut self,
        frame: Frame,
        letter: u8,
        board: &mut impl Board<'q, N>,
    ) -> Option<Done> {
        self.tag = (self.tag + 1) & 0xFFFF;
        let frames = Vec::from_array([TxFrame { tag: self.tag, frame, at_ticks: None }]);
        match send(CHANNEL, &frames, board) {
            Ok(_) if self.auto_poll => {
                let mut text = String::new();
                text.push(if letter.is_ascii_lowercase() { 'z' } else { 'Z' }).ok()?;
                Some(Done::Answer(Answer::Text(text)))
            }
            Ok(_) => Some(Done::Answer(Answer::Ok)),
            Err(Refusal::QueueFull { .. }) => {
                self.flags |= flag::TX_FULL;
                self.refused_frame = true;
                None
            }
            Err(_) => None,
        }
    }

    /// Applies `M`, `m` and `W`: an SJA1000's acceptance code and mask (a mask bit of 1 means "don't
    /// care"). Its filtering by data bytes is not supported.
    fn set_filters<'q, const N: usize>(
        &self,
        commands: &mut Commands,
        board: &mut impl Board<'q, N>,
    ) -> bool {
        let (code, care) = (self.code, !self.mask);
        let filter = |extended, id, mask| Filter { extended, kind: FrameKind::Any, id: id & mask, mask };
        let mut filters = Vec::new();
        let standard =
            |half: u32, care: u32| filter(false, half >> 5 & Id::MAX_STANDARD, care >> 5 & Id::MAX_STANDARD);
        let added = if self.single_filter {
            filters.push(standard(code >> 16, care >> 16)).is_ok()
                && filters.push(filter(true, code >> 3, care >> 3)).is_ok()
        } else {
            [16, 0].iter().all(|shift| {
                let (half, care) = (code >> shift & 0xFFFF, care >> shift & 0xFFFF);
                // Sixteen bits are the upper bits of a 29-bit identifier.
                filters.push(standard(half, care)).is_ok()
                    && filters.push(filter(true, half << 13, care << 13)).is_ok()
            })
        };
        let everything = self.mask == u32::MAX;
        if everything {
            filters.clear();
        }
        added && commands.execute(Command::SetFilters { channel: CHANNEL, filters }, board).is_ok()
    }

    /// Writes the answer and lines of captured frames to `out` and returns their length.
    pub fn next_lines<const N: usize>(&mut self, queue: &mut Consumer<'_, N>, out: &mut [u8]) -> usize {
        let mut lines = Vec::<u8, MAX_LINES_BYTES>::new();
        // None of these can fail: there is room for the longest answer, and for a line before each.
        let _ = match self.answer.take() {
            Some(Answer::Ok) => lines.push(b'\r').is_ok(),
            Some(Answer::Refused) => lines.push(7).is_ok(),
            Some(Answer::Text(text)) => {
                lines.extend_from_slice(text.as_bytes()).is_ok() && lines.push(b'\r').is_ok()
            }
            None => true,
        };
        if core::mem::take(&mut self.refused_frame) && self.reports {
            let _ = lines.extend_from_slice(report::transmit_overrun().as_bytes());
        }
        while queue.read(|bytes| self.take(bytes, &mut lines)) > 0 {}
        if self.polled > 0 {
            // The queue is empty: `A` ends, and a `P` that found nothing is answered.
            let ended: &[u8] = if self.polling_all { b"A\r" } else { b"\r" };
            if lines.extend_from_slice(ended).is_ok() {
                self.polled = 0;
            }
        }
        out[..lines.len()].copy_from_slice(&lines);
        lines.len()
    }

    /// Turns records into lines while there is room and lines are wanted; returns how many bytes it took.
    fn take(&mut self, bytes: &[u8], lines: &mut Vec<u8, MAX_LINES_BYTES>) -> usize {
        let mut rest = bytes;
        while lines.capacity() - lines.len() > MAX_FRAME_LINE {
            let Ok((record, difference, after)) = record::decode(rest) else { break };
            let at = self.running_ticks.wrapping_add_signed(difference);
            match record {
                Record::Received(received) => {
                    if !self.auto_poll {
                        if self.polled == 0 {
                            break;
                        }
                        self.polled = if self.polling_all { self.polled } else { 0 };
                    }
                    self.frame_line(&received.frame, at, lines);
                }
                // The language has no CAN FD, and no controller here receives any.
                Record::ReceivedFd(_) | Record::TransmittedFd(_) => {}
                Record::Event(event) => {
                    self.note(&event);
                    // A host that polls expects nothing between its requests.
                    if let Some(line) = report::line(&event).filter(|_| self.reports && self.auto_poll) {
                        // Fits: it is shorter than a frame's line.
                        let _ = lines.extend_from_slice(line.as_bytes());
                    }
                }
            }
            self.running_ticks = at;
            rest = after;
        }
        bytes.len() - rest.len()
    }

    fn frame_line(&self, frame: &Frame, at: u64, lines: &mut Vec<u8, MAX_LINES_BYTES>) {
        let letter = match (frame.id().is_extended(), frame.is_remote()) {
            (false, false) => 't',
            (true, false) => 'T',
            (false, true) => 'r',
            (true, true) => 'R',
        };
        // Writing cannot fail: the caller keeps room for the longest line.
        let _ = write!(lines, "{letter}{}{}", frame.id(), frame.dlc().min(8));
        for byte in frame.data() {
            let _ = write!(lines, "{byte:02X}");
        }
        let _ = match self.stamps {
            Stamps::Off => Ok(()),
            Stamps::Milliseconds => write!(lines, "{:04X}", at / u64::from(TICKS_PER_MS) % STAMP_WRAP_MS),
            Stamps::Microseconds => write!(lines, "{:08X}", (at / u64::from(TICKS_PER_US)) as u32),
        };
        let _ = lines.push(b'\r');
    }

    /// Notes what `F` reports.
    fn note(&mut self, event: &Event) {
        self.flags |= match event {
            Event::Lost { stage: LossStage::Controller, .. } => flag::OVERRUN,
            Event::Lost { .. } => flag::RX_FULL,
            Event::BusError { .. } | Event::ErrorsSuppressed { .. } => flag::BUS_ERROR,
            Event::State { state: ErrorState::Warning, .. } => flag::WARNING,
            Event::State { state: ErrorState::Passive | ErrorState::BusOff, .. } => {
                flag::WARNING | flag::PASSIVE
            }
            Event::TransmitFailed { reason: TransmitFailure::ArbitrationLost, .. } => flag::ARBITRATION_LOST,
            _ => 0,
        };
    }
}

/// The result of a line.
enum Done {
    Answer(Answer),
    Begun(Work),
    /// The answer consists of frames.
    Silent,
}

fn run<'q, const N: usize>(
    command: Command,
    commands: &mut Commands,
    board: &mut impl Board<'q, N>,
) -> Option<Done> {
    match commands.execute(command, board).ok()? {
        Step::Done(_) => Some(Done::Answer(Answer::Ok)),
        Step::Begun(work) => Some(Done::Begun(work)),
    }
}

/// Hexadecimal digits, at most eight.
fn hex(digits: &[u8]) -> Option<u32> {
    digits.iter().try_fold(0, |value, digit| Some(value << 4 | (*digit as char).to_digit(16)?))
}

fn parse_frame(letter: u8, parameters: &[u8]) -> Option<Frame> {
    let extended = letter.is_ascii_uppercase();
    let (id, rest) = parameters.split_at_checked(if extended { 8 } else { 3 })?;
    let id = hex(id)?;
    let id = if extended { Id::extended(id) } else { Id::standard(id) }?;
    let (&dlc, rest) = rest.split_first()?;
    let dlc = hex(&[dlc]).filter(|dlc| *dlc <= 8)? as u8;
    if letter.eq_ignore_ascii_case(&b'r') {
        return Frame::remote_frame(id, dlc).filter(|_| rest.is_empty());
    }
    let mut data = [0; 8];
    let data = &mut data[..usize::from(dlc)];
    if rest.len() != 2 * data.len() {
        return None;
    }
    for (byte, digits) in data.iter_mut().zip(rest.chunks(2)) {
        *byte = hex(digits)? as u8;
    }
    Frame::data_frame(id, data)
}

/// The timing of an SJA1000's BTR0 (upper byte) and BTR1 (lower byte), with the same bit rate and the nearest
/// sample point. Triple sampling (SAM) does not exist here and is refused.
fn timing_of_sja1000(registers: u16) -> Option<BitTiming> {
    let (btr0, btr1) = (u32::from(registers >> 8), u32::from(registers & 0xFF));
    if btr1 & 0x80 != 0 {
        return None;
    }
    let prescaler = (btr0 & 0x3F) + 1;
    let (segment1, segment2) = ((btr1 & 0xF) + 1, (btr1 >> 4 & 7) + 1);
    let quanta = 1 + segment1 + segment2;
    let clocks = prescaler * quanta;
    let rate = (SJA1000_HZ + clocks / 2) / clocks;
    let timing = BitTiming::choose(CAN_CLOCK_HZ, rate, Some((1 + segment1) * 1000 / quanta)).ok()?;
    let jump_width = ((btr0 >> 6) + 1).min(u32::from(timing.segment2)) as u8;
    Some(BitTiming { jump_width, ..timing })
}

fn registers_text(letter: u8, set: &RegisterSet) -> Option<String<64>> {
    let mut text = String::new();
    text.push(letter as char).ok()?;
    for register in [set.mcr, set.msr, set.tsr, set.rf0r, set.ier, set.esr, set.btr] {
        write!(text, "{register:08X}").ok()?;
    }
    Some(text)
}

impl Default for Slcan {
    fn default() -> Self {
        Self::new()
    }
}
