//! Writing ASC.

use cantap_can::Frame;

use super::super::bit_rates;
use super::super::calendar::{DAYS, Date, MONTHS, start_of_trace};
use super::super::codec::Encode;
use super::super::event_text;
use super::super::left_out::LeftOut;
use super::super::line::{Line, Seconds};
use super::super::sja1000;
use super::super::text::{self, NS_PER_S};
use super::super::writer::WriteOptions;
use super::super::zone::Zone;
use super::{FD_FORMAT, PASSIVE_SENDER, STATES, SWITCHED_BIT_RATE, lin};
use cantap_trace::{Direction, FdFrame, TraceEvent, TraceFrame, TraceRecord};

/// Writes ASC.
pub(crate) struct Encoder {
    /// The time that the file's times count from; known from the first record on.
    start_ns: Option<i64>,
    seconds: Seconds<SECONDS_WIDTH>,
    /// The zone of the dates.
    zone: Zone,
    /// What is known of the channels' bit rates.
    note: Option<String>,
}

impl Encoder {
    pub(crate) fn new(options: &WriteOptions) -> Self {
        let note = bit_rates::note(&options.channels);
        Self { start_ns: None, seconds: Seconds::new(), zone: options.zone.clone(), note }
    }
}

/// `Sat Sep 30 15:06:13.191 2017`.
fn push_date(out: &mut Vec<u8>, time_ns: i64) {
    let date = Date::of(time_ns);
    let (hour, minute, second, ns) = date.clock();
    let (day, month) = (DAYS[Date::weekday(time_ns)], MONTHS[usize::from(date.month) - 1]);
    let text = format!(
        "{day} {month} {:02} {hour:02}:{minute:02}:{second:02}.{:03} {:04}\n",
        date.day,
        ns / 1_000_000,
        date.year
    );
    out.extend_from_slice(text.as_bytes());
}

/// A file's last line.
const END: &[u8] = b"End TriggerBlock\n";

// Widths of the columns: a time, its whole seconds, and an identifier.
const TIME_WIDTH: usize = 11;
const SECONDS_WIDTH: usize = TIME_WIDTH - 7;
const ID_WIDTH: usize = 16;

impl Encoder {
    fn head(&mut self, first_ns: i64, out: &mut Vec<u8>) -> i64 {
        let start_ns = start_of_trace(first_ns);
        self.start_ns = Some(start_ns);
        out.extend_from_slice(b"date ");
        let clock_ns = self.zone.clock_ns(start_ns);
        push_date(out, clock_ns);
        out.extend_from_slice(b"base hex  timestamps absolute\n");
        if let Some(note) = &self.note {
            out.extend_from_slice(format!("// {note}\n").as_bytes());
        }
        out.extend_from_slice(b"internal events logged\nBegin Triggerblock ");
        push_date(out, clock_ns);
        out.extend_from_slice(b"   0.000000 Start of measurement\n");
        start_ns
    }
}

impl Encode for Encoder {
    fn carries_lin(&self) -> bool {
        true
    }

    #[inline]
    fn record(&mut self, record: &TraceRecord, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        let start_ns = match self.start_ns {
            Some(start_ns) => start_ns,
            None => self.head(record.time_ns, out),
        };
        let offset_ns = record.time_ns.saturating_sub(start_ns);
        if let TraceEvent::Frame { frame: TraceFrame::Classic(frame), direction, .. } = &record.event
            && offset_ns >= 0
        {
            let mut line = Line::new();
            self.seconds.put(&mut line, offset_ns as u64 / 1000);
            line.space(1);
            put_frame(&mut line, record.channel, frame, *direction);
            line.end(out);
            return;
        }
        let at = out.len();
        text::push_time(out, offset_ns, NS_PER_S, 6, b'.');
        text::pad_left(out, at, TIME_WIDTH);
        out.push(b' ');
        match &record.event {
            TraceEvent::Frame { frame: TraceFrame::Fd(frame), direction, .. } => {
                push_fd(out, record.channel, frame, *direction);
            }
            TraceEvent::Frame { frame: TraceFrame::Classic(frame), direction, .. } => {
                let mut line = Line::new();
                put_frame(&mut line, record.channel, frame, *direction);
                line.end(out);
                return;
            }
            TraceEvent::BusError { kind, .. } => {
                text::push_decimal(out, u64::from(record.channel));
                out.extend_from_slice(b"  ErrorFrame  ");
                if let Some(kind) = kind {
                    out.extend_from_slice(format!("ECC: {:08b}  ", sja1000::code(*kind)).as_bytes());
                }
                push_comment(out, &record.event);
            }
            TraceEvent::State { state, counters } => {
                push_status(out, record.channel);
                let text = STATES.iter().find(|(known, _)| known == state).map_or("", |(_, text)| text);
                out.extend_from_slice(text.as_bytes());
                if let Some((tec, rec)) = counters {
                    out.extend_from_slice(format!(" - TxErr: {tec} RxErr: {rec}").as_bytes());
                }
            }
            TraceEvent::Lin { frame, direction } => lin::push(out, record.channel, frame, *direction),
            event => {
                push_status(out, record.channel);
                let status = match event {
                    TraceEvent::Lost { .. } => "Rx queue overrun  ",
                    TraceEvent::TransmitFailed { .. } => "Tx failed  ",
                    _ => "error frames suppressed  ",
                };
                out.extend_from_slice(status.as_bytes());
                push_comment(out, event);
            }
        }
        out.push(b'\n');
    }

    fn finish(&mut self, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        if self.start_ns.is_none() {
            self.head(0, out);
        }
        out.extend_from_slice(END);
    }
}

/// Writes what follows the time of a frame.
#[inline]
fn put_frame(line: &mut Line, channel: u8, frame: &Frame, direction: Direction) {
    line.put_small(channel);
    line.space(2);
    let id = frame.id();
    let mut width = line.put_hex(id.raw());
    if id.is_extended() {
        line.put(b"x");
        width += 1;
    }
    line.space(ID_WIDTH - width);
    line.put(if direction == Direction::Tx { b"Tx   " } else { b"Rx   " });
    line.put(if frame.is_remote() { b"r " } else { b"d " });
    line.put_hex(u32::from(frame.dlc()));
    let mut columns = [b' '; 3 * 8];
    for (column, byte) in columns.chunks_exact_mut(3).zip(frame.padded_data()) {
        column[1..].copy_from_slice(&text::hex_pair_of(byte));
    }
    line.put_start(&columns, 3 * frame.data_len());
    line.put(b"\n");
}

/// Writes what follows the time of a CAN FD frame: Vector's columns, with 0 in those that only an interface
/// knows.
fn push_fd(out: &mut Vec<u8>, channel: u8, frame: &FdFrame, direction: Direction) {
    let id = frame.id();
    let direction = if direction == Direction::Tx { "Tx" } else { "Rx" };
    let digits = format!("{:x}{}", id.raw(), if id.is_extended() { "x" } else { "" });
    let (brs, esi, dlc, len) = (u8::from(frame.brs()), u8::from(frame.esi()), frame.dlc(), frame.data_len());
    let head =
        format!("CANFD {channel:>3} {direction:<4} {digits:>8}  {:32} {brs} {esi} {dlc:x} {len:>2}", "");
    out.extend_from_slice(head.as_bytes());
    for byte in frame.data() {
        out.push(b' ');
        text::push_hex_byte(out, *byte);
    }
    let switched = if frame.brs() { SWITCHED_BIT_RATE } else { 0 };
    let flags = FD_FORMAT | switched | if frame.esi() { PASSIVE_SENDER } else { 0 };
    // Duration, bits, flags, CRC, and the bit timing twice.
    let tail = format!(" {:>8} {:>4} {flags:>8X} {:>8} {:>8} {:>8} {:>8} {:>8}", 0, 0, 0, 0, 0, 0, 0);
    out.extend_from_slice(tail.as_bytes());
}

fn push_status(out: &mut Vec<u8>, channel: u8) {
    out.extend_from_slice(b"CAN ");
    text::push_decimal(out, u64::from(channel));
    out.extend_from_slice(b" Status:");
}

fn push_comment(out: &mut Vec<u8>, event: &TraceEvent) {
    out.extend_from_slice(b"// ");
    event_text::push_marked(out, event);
}
