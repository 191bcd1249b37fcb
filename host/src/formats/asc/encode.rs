//! Writing ASC.

use super::super::calendar::{DAYS, Date, MONTHS, start_of_trace};
use super::super::event_text;
use super::super::sja1000;
use super::super::text::{self, NS_PER_S};
use super::super::writer::{Encode, LeftOut};
use super::STATES;
use crate::{Direction, TraceEvent, TraceRecord};

/// Writes ASC.
#[derive(Default)]
pub(crate) struct Encoder {
    /// The time that the file's times count from; known with the first record.
    start_ns: Option<i64>,
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

/// Spaces for the widths of the columns.
const SPACES: &[u8] = b"                ";
const TIME_WIDTH: usize = 11;
const ID_WIDTH: usize = 16;

impl Encoder {
    fn head(&mut self, first_ns: i64, out: &mut Vec<u8>) -> i64 {
        let start_ns = start_of_trace(first_ns);
        self.start_ns = Some(start_ns);
        out.extend_from_slice(b"date ");
        push_date(out, start_ns);
        out.extend_from_slice(b"base hex  timestamps absolute\ninternal events logged\nBegin Triggerblock ");
        push_date(out, start_ns);
        out.extend_from_slice(b"   0.000000 Start of measurement\n");
        start_ns
    }
}

impl Encode for Encoder {
    #[inline]
    fn record(&mut self, record: &TraceRecord, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        let start_ns = match self.start_ns {
            Some(start_ns) => start_ns,
            None => self.head(record.time_ns, out),
        };
        push_offset(out, record.time_ns.saturating_sub(start_ns));
        match &record.event {
            TraceEvent::Frame { frame, direction, .. } => {
                text::push_decimal(out, u64::from(record.channel));
                out.extend_from_slice(b"  ");
                let id = frame.id();
                let digits = text::hex_len(id.raw());
                text::push_hex(out, id.raw(), digits);
                let mut width = digits;
                if id.is_extended() {
                    out.push(b'x');
                    width += 1;
                }
                out.extend_from_slice(&SPACES[..ID_WIDTH - width]);
                out.extend_from_slice(if *direction == Direction::Tx { b"Tx   " } else { b"Rx   " });
                out.extend_from_slice(if frame.is_remote() { b"r " } else { b"d " });
                text::push_hex(out, u32::from(frame.dlc()), 1);
                // One append for all bytes.
                let mut columns = [b' '; 3 * 8];
                let data = frame.data();
                for (column, byte) in columns.chunks_exact_mut(3).zip(data) {
                    column[1..].copy_from_slice(&text::hex_pair_of(*byte));
                }
                out.extend_from_slice(&columns[..3 * data.len()]);
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
        out.extend_from_slice(b"End TriggerBlock\n");
    }
}

/// A time since the start in seconds, right-aligned, and a space.
#[inline]
fn push_offset(out: &mut Vec<u8>, offset_ns: i64) {
    const US_PER_S: u64 = 1_000_000;
    let us = offset_ns as u64 / 1000;
    // Up to four digits of seconds the column is filled in place, without moving text.
    if offset_ns < 0 || us >= 10_000 * US_PER_S {
        let at = out.len();
        text::push_time(out, offset_ns, NS_PER_S, 6, b'.');
        text::pad_left(out, at, TIME_WIDTH);
        out.push(b' ');
        return;
    }
    let mut column = [b' '; TIME_WIDTH + 1];
    let (mut seconds, mut fraction) = ((us / US_PER_S) as u32, (us % US_PER_S) as u32);
    for digit in column[5..TIME_WIDTH].iter_mut().rev() {
        *digit = b'0' + (fraction % 10) as u8;
        fraction /= 10;
    }
    column[4] = b'.';
    for digit in column[..4].iter_mut().rev() {
        *digit = b'0' + (seconds % 10) as u8;
        seconds /= 10;
        if seconds == 0 {
            break;
        }
    }
    out.extend_from_slice(&column);
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
