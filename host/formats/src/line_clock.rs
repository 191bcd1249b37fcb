//! The times that a serial monitor, a terminal or a board's own log put before a line.

use super::table;
use super::text::{self, NS_PER_S};
use super::zone::Zone;

/// The clock that stands before the lines of a text.
#[derive(Default)]
pub(crate) struct LineClock {
    /// The last time, in nanoseconds; 0 before the first.
    pub(crate) time_ns: i64,
    /// Whether there was one.
    pub(crate) has_time: bool,
}

impl LineClock {
    /// Takes the time before a line, if there is one, and gives the rest of the line.
    pub(crate) fn take<'a>(&mut self, line: &'a [u8], zone: &Zone) -> &'a [u8] {
        let (time, rest) = stamp(line);
        if let Some(time_ns) = time.and_then(|time| time.ns(zone)) {
            self.set(time_ns);
        }
        rest
    }

    fn set(&mut self, time_ns: i64) {
        self.time_ns = table::going_on(time_ns, self.has_time.then_some(self.time_ns));
        self.has_time = true;
    }
}

/// A line without the time before it.
pub(crate) fn without_time(line: &[u8]) -> &[u8] {
    stamp(line).1
}

/// A time as it stands before a line.
enum Stamp<'a> {
    Date(&'a [u8]),
    Ns(i64),
}

impl Stamp<'_> {
    /// In nanoseconds; a clock without a date counts from midnight.
    fn ns(&self, zone: &Zone) -> Option<i64> {
        match self {
            Self::Date(date) => table::date(date, zone),
            Self::Ns(ns) => Some(*ns),
        }
    }
}

/// The time before a line, and the rest of it: `12:34:56.789 -> …` (Arduino), `… > …` (PlatformIO), `[12:34:56.789] …`, with a date or without, and
/// `I (1234) twai: …` (ESP-IDF, milliseconds since the start).
fn stamp(line: &[u8]) -> (Option<Stamp<'_>>, &[u8]) {
    if let [b'E' | b'W' | b'I' | b'D' | b'V', b' ', b'(', rest @ ..] = line
        && let Some(end) = memchr::memchr(b')', rest)
    {
        let (inside, after) = (&rest[..end], rest[end + 1..].trim_ascii());
        let ms = text::decimal(inside).and_then(|ms| i64::try_from(ms).ok()?.checked_mul(NS_PER_S / 1000));
        return (Some(ms.map_or(Stamp::Date(inside), Stamp::Ns)), after);
    }
    if let Some(rest) = line.strip_prefix(b"[")
        && let Some(end) = memchr::memchr(b']', rest)
    {
        let inside = rest[..end].trim_ascii();
        let after = rest[end + 1..].trim_ascii();
        if is_date(inside) {
            return (Some(Stamp::Date(inside)), after);
        }
        return match text::time(inside, NS_PER_S, b'.').filter(|_| inside.contains(&b'.')) {
            Some(ns) => (Some(Stamp::Ns(ns)), after),
            None => (None, line),
        };
    }
    let (first, rest) = text::word(line);
    let (_, after) = text::word(rest);
    let both = &line[..line.len() - after.len()];
    let both = both.trim_ascii_end();
    let (date, rest) = match (is_date(both), is_date(first)) {
        (true, _) => (both, after),
        (false, true) => (first, rest),
        (false, false) => return (None, line),
    };
    let rest = rest.trim_ascii();
    let rest = rest.strip_prefix(b"->").or_else(|| rest.strip_prefix(b">")).unwrap_or(rest);
    (Some(Stamp::Date(date)), rest.trim_ascii())
}

fn is_date(text: &[u8]) -> bool {
    let has_clock = memchr::memchr_iter(b':', text).count() == 2;
    has_clock && text[0].is_ascii_digit() && table::date(text, &Zone::default()).is_some()
}
