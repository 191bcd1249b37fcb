//! What came from the port of an slcan adapter, as a terminal saves it: `t12380102030405060708`, with or without the adapter's stamp behind the
//! bytes. Lawicel's lines, those of CAN FD as CANable's firmware has them (`d`, `D`, `b`, `B`), and Linux's reports of errors and states.

#[cfg(test)]
mod tests;

use super::frame_fields::{FdFields, FrameFields, Payload, fd_len, identifier};
use super::issue::Fault;
use super::line_clock::{LineClock, without_time};
use super::row_format::{Line, RowFormat};
use super::text;
use super::zone::Zone;
use cantap_can::{BusErrorKind, ErrorState};
use cantap_trace::{Direction, TraceEvent, TraceRecord};

const NS_PER_MS: i64 = 1_000_000;
const NS_PER_US: i64 = 1000;

const OTHERS: &str = "commands and answers of the adapter";
const REFUSED: &str = "frames that the adapter refused to send";
const NO_TIMES: &str = "nothing shows when the frames arrived: they stand at the last time that was, or at 0";
const OF_A_MINUTE: &str =
    "stamps of four digits begin again after a minute: of a longer pause only the rest is known";
const LONG_MS: &str =
    "stamps of eight digits were read as milliseconds: frames are too close for microseconds";
const LONG_US: &str =
    "stamps of eight digits were read as microseconds: nothing shows that they are milliseconds";

/// Reads what was saved.
#[derive(Default)]
pub(crate) struct Decoder {
    clock: LineClock,
    /// The adapter's last stamp, as it was written.
    last: Option<Stamp>,
    /// Since its first stamp began to count.
    stamped_ns: i64,
    /// Stamps of four digits count to 65535 and not to 59999.
    is_binary: bool,
    /// Stamps of eight digits are in milliseconds.
    is_long_ms: bool,
    is_cut_stamp: bool,
    /// What to report, and what was reported.
    notes: Vec<&'static str>,
    noted: Vec<&'static str>,
}

/// Behind a frame's bytes.
#[derive(Clone, Copy)]
enum Stamp {
    Short(u32),
    Long(u32),
}

/// A frame's line in parts.
struct Parts {
    fields: FrameFields,
    data: Payload,
    stamp: Option<Stamp>,
}

impl Parts {
    /// Those of a line that begins as a frame does; `None` if it does not.
    fn of(line: &[u8]) -> Option<Result<Self, Fault>> {
        let (first, rest) = line.split_first()?;
        let (extended, remote, fd) = match first {
            b't' => (false, false, None),
            b'T' => (true, false, None),
            b'r' => (false, true, None),
            b'R' => (true, true, None),
            b'd' => (false, false, Some(false)),
            b'D' => (true, false, Some(false)),
            b'b' => (false, false, Some(true)),
            b'B' => (true, false, Some(true)),
            _ => return None,
        };
        let fd = fd.map(|brs| FdFields { brs, esi: false });
        // A word that only begins with the letter is no frame.
        rest.first()
            .is_some_and(u8::is_ascii_hexdigit)
            .then(|| Self::behind(line, rest, extended, remote, fd))
    }

    fn behind(
        line: &[u8],
        rest: &[u8],
        extended: bool,
        remote: bool,
        fd: Option<FdFields>,
    ) -> Result<Self, Fault> {
        let fault = || Fault::malformed("a frame such as t12381122334455667788", line);
        let digits = if extended { 8 } else { 3 };
        let (shown, rest) = rest.split_at_checked(digits).ok_or_else(fault)?;
        let id = identifier(text::hex(shown).ok_or_else(fault)?, extended, shown)?;
        let (code, rest) = rest.split_first().ok_or_else(fault)?;
        let code = text::hex_digit(*code).ok_or_else(fault)?;
        let len = if fd.is_some() { fd_len(code) } else { code };
        let fields = FrameFields { id, remote, direction: Direction::Rx, len, fd };
        let expected =
            || Fault::malformed(format!("{} data bytes in hexadecimal digits", fields.data_len()), line);
        let (bytes, rest) = rest.split_at_checked(2 * fields.data_len()).ok_or_else(expected)?;
        let pairs = bytes.chunks_exact(2).map(|pair| text::hex_pair(pair[0], pair[1]));
        let bytes = pairs.collect::<Option<Vec<_>>>().ok_or_else(expected)?;
        let data = Payload::of(&bytes).ok_or_else(expected)?;
        let stamp = match (rest.len(), text::hex(rest)) {
            (0, _) => None,
            (4, Some(stamp)) => Some(Stamp::Short(stamp)),
            (8, Some(stamp)) => Some(Stamp::Long(stamp)),
            _ => return Err(Fault::malformed("nothing behind the bytes, or a stamp of 4 or 8 digits", rest)),
        };
        Ok(Self { fields, data, stamp })
    }
}

/// An error or state as Linux's driver has understood them since version 6.0.
fn report(line: &[u8]) -> Option<Line> {
    let event = match line {
        [b'e', count @ b'1'..=b'3', kinds @ ..] if kinds.len() == usize::from(count - b'0') => {
            let kind = kinds[0];
            if kinds.iter().any(|other| *other != kind) {
                return None;
            }
            match kind {
                b'o' => return Some(lost()),
                b'O' => return Some(Line::LeftOut(REFUSED)),
                _ => TraceEvent::BusError {
                    kind: Some(BusErrorKind::from_slcan_letter(kind)?),
                    counters: None,
                },
            }
        }
        [b's', state, counters @ ..] if counters.len() == 6 => {
            let state = ErrorState::from_slcan_letter(*state)?;
            let [receive, transmit] = [&counters[..3], &counters[3..]].map(text::decimal);
            let counter = |count: u64| u8::try_from(count.min(255)).ok();
            TraceEvent::State { state, counters: Some((counter(transmit?)?, counter(receive?)?)) }
        }
        _ => return None,
    };
    Some(Line::Record(TraceRecord { time_ns: 0, device_ns: None, channel: 1, event }))
}

fn lost() -> Line {
    let event = TraceEvent::Lost { stage: None, count: 1, at_least: true };
    Line::Record(TraceRecord { time_ns: 0, device_ns: None, channel: 1, event })
}

/// Whether a line is what an adapter answers, or what it is sent.
fn is_other(line: &[u8]) -> bool {
    let is_hex = |rest: &[u8]| rest.iter().all(u8::is_ascii_hexdigit);
    match line {
        [b'z' | b'Z' | b'A' | b'O' | b'L' | b'C' | b'P' | b'V' | b'v' | b'N' | b'F'] => true,
        [b'S' | b'X' | b'Z' | b'A' | b'W' | b'Q' | b'K' | b'U' | b'Y', digit] => digit.is_ascii_digit(),
        [b'F', rest @ ..] => rest.len() == 2 && is_hex(rest),
        [b's' | b'V' | b'v' | b'M' | b'm', rest @ ..] => matches!(rest.len(), 4 | 6 | 8) && is_hex(rest),
        [b'N', rest @ ..] => rest.len() == 4 && rest.iter().all(u8::is_ascii_alphanumeric),
        [b'I' | b'Y', rest @ ..] => rest.len() == 56 && is_hex(rest),
        _ => false,
    }
}

/// Lines as an adapter ends them; BEL, which refuses a command, stands without an end.
fn lines(text: &[u8]) -> impl Iterator<Item = &[u8]> {
    let lines = text.split(|byte| matches!(byte, b'\n' | b'\r'));
    lines.map(|line| without_bell(without_time(line.trim_ascii()))).filter(|line| !line.is_empty())
}

fn without_bell(line: &[u8]) -> &[u8] {
    let bells = line.iter().take_while(|byte| **byte == 7).count();
    &line[bells..]
}

/// Whether a file begins with such lines, and with few that are none.
pub(crate) fn is_head(head: &[u8]) -> bool {
    const HEAD_BYTES: usize = 4 << 10;
    let head = &head[..head.len().min(HEAD_BYTES)];
    // The last line may be half there.
    let end = head.iter().rposition(|byte| matches!(byte, b'\n' | b'\r')).unwrap_or(head.len());
    let (mut frames, mut others) = (0, 0);
    for line in lines(&head[..end]) {
        match Parts::of(line) {
            Some(Ok(_)) => frames += 1,
            None if is_other(line) || report(line).is_some() => {}
            _ => others += 1,
        }
    }
    frames > others
}

impl Decoder {
    fn report_once(&mut self, note: &'static str) {
        if !self.noted.contains(&note) {
            self.noted.push(note);
            self.notes.push(note);
        }
    }

    /// The time of a frame with this stamp. A clock before the lines counts the minutes that a stamp does not.
    fn time_ns(&mut self, stamp: Option<Stamp>) -> i64 {
        if self.clock.has_time {
            return self.clock.time_ns;
        }
        let passed_ns = match (stamp, self.last) {
            (None, _) => {
                self.report_once(NO_TIMES);
                0
            }
            (Some(Stamp::Short(now)), last) => {
                self.report_once(OF_A_MINUTE);
                let around = if self.is_binary { 1 << 16 } else { 60_000 };
                let before = match last {
                    Some(Stamp::Short(last)) => last,
                    _ => 0,
                };
                (i64::from(now) - i64::from(before)).rem_euclid(around) * NS_PER_MS
            }
            (Some(Stamp::Long(now)), last) => {
                self.report_once(if self.is_long_ms { LONG_MS } else { LONG_US });
                let before = match last {
                    Some(Stamp::Long(last)) => last,
                    _ => 0,
                };
                let unit_ns = if self.is_long_ms { NS_PER_MS } else { NS_PER_US };
                i64::from(now.wrapping_sub(before)) * unit_ns
            }
        };
        self.last = stamp.or(self.last);
        self.stamped_ns = self.stamped_ns.saturating_add(passed_ns);
        self.stamped_ns
    }
}

impl RowFormat for Decoder {
    fn begin(&mut self, buffered: &[u8]) {
        /// The shortest frame is on a bus of 1 Mbit/s for 44 µs; adapters' stamps are a little off.
        const CLOSEST: u32 = 30;
        let mut last = None;
        for parts in lines(buffered).filter_map(|line| Parts::of(line)?.ok()) {
            match parts.stamp {
                Some(Stamp::Short(now)) => self.is_binary |= now >= 60_000,
                // CAN FD frames may be closer.
                Some(Stamp::Long(now)) if parts.fields.fd.is_none() => {
                    self.is_long_ms |= last.is_some_and(|last: u32| now.wrapping_sub(last) < CLOSEST);
                    last = Some(now);
                }
                _ => {}
            }
        }
    }

    fn line(&mut self, line: &[u8], zone: &Zone) -> Result<Line, Fault> {
        self.is_cut_stamp = false;
        let line = without_bell(without_bell(self.clock.take(line, zone)).trim_ascii());
        if line.is_empty() || line.starts_with(b"#") {
            return Ok(Line::Nothing);
        }
        if let Some(parts) = Parts::of(line) {
            let parts = parts?;
            self.is_cut_stamp = parts.stamp.is_none();
            let event = parts.fields.event(&parts.data)?;
            return Ok(Line::Record(TraceRecord {
                time_ns: self.time_ns(parts.stamp),
                device_ns: None,
                channel: 1,
                event,
            }));
        }
        if let Some(report) = report(line) {
            let time_ns = if self.clock.has_time { self.clock.time_ns } else { self.stamped_ns };
            return Ok(match report {
                Line::Record(record) => Line::Record(TraceRecord { time_ns, ..record }),
                other => other,
            });
        }
        if is_other(line) {
            return Ok(Line::LeftOut(OTHERS));
        }
        Err(Fault::malformed("a line of slcan, such as t12381122334455667788", line))
    }

    fn may_be_cut(&self, _line: &[u8], _record: &TraceRecord) -> bool {
        // All of its bytes are there; what may be missing is a stamp, if the others have one.
        self.is_cut_stamp && self.last.is_some()
    }

    fn note(&mut self) -> Option<&'static str> {
        self.notes.pop()
    }
}
