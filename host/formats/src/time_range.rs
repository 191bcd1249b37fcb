//! A part of a trace by time: between two points, absolute or counted from the trace's first record.

use std::str::FromStr;

use crate::{calendar, date_time_ns, decimal_seconds_ns};
use cantap_trace::{TraceRecord, grammar};

/// A point in a trace.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TimePoint {
    /// Nanoseconds since the Unix epoch.
    At(i64),
    /// Nanoseconds after the trace's first record.
    AfterFirst(i64),
}

impl TimePoint {
    fn time_ns(self, first_ns: i64) -> i64 {
        match self {
            Self::At(time_ns) => time_ns,
            Self::AfterFirst(offset_ns) => first_ns.saturating_add(offset_ns),
        }
    }
}

/// Not a point in time.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "'{0}' is not a time; write seconds from the first record (12.5, or 90s, 10m, 2h), seconds since 1970 \
     (1410714882.5), or a date in UTC (2014-09-14 or 2014-09-14T17:14:42)"
)]
pub struct BadTime(String);

/// Numbers from here on are seconds since 1970: they mean 1990 or later, and no trace is twenty years long.
const FIRST_EPOCH_NS: i64 = 631_152_000_000_000_000;

impl FromStr for TimePoint {
    type Err = BadTime;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let bad = || BadTime(text.to_owned());
        let day_only = || date_time_ns(&format!("{text}T00:00:00"));
        if let Some(time_ns) = date_time_ns(text.trim_end_matches('Z')).or_else(day_only) {
            return Ok(Self::At(time_ns));
        }
        // A plain number to the nanosecond: seconds since 1970 have more digits than a float.
        if let Some(value_ns) = decimal_seconds_ns(text) {
            return Ok(if value_ns >= FIRST_EPOCH_NS {
                Self::At(value_ns)
            } else {
                Self::AfterFirst(value_ns)
            });
        }
        let (text, sign) = text.strip_prefix('-').map_or((text, 1), |text| (text, -1));
        let time = grammar::duration(text).map_err(|_| bad())?;
        Ok(Self::AfterFirst(sign * i64::try_from(time.as_nanos()).map_err(|_| bad())?))
    }
}

/// The date of a time in nanoseconds since the Unix epoch, with microseconds; `None` if a trace's times count from its own
/// start.
pub fn date_text(time_ns: i64) -> Option<String> {
    if time_ns < calendar::FIRST_DATE_NS {
        return None;
    }
    let date = calendar::Date::of(time_ns);
    let (hour, minute, second, ns) = date.clock();
    let (year, month, day, us) = (date.year, date.month, date.day, ns / 1000);
    Some(format!("{year:04}-{month:02}-{day:02} {hour:02}:{minute:02}:{second:02}.{us:06} UTC"))
}

/// A part of a trace. It includes the start but not the end.
#[derive(Clone, Copy, Debug, Default)]
pub struct TimeRange {
    start: Option<TimePoint>,
    end: Option<TimePoint>,
    first_ns: Option<i64>,
}

impl TimeRange {
    /// From one point to another; open if one is missing.
    pub fn new(start: Option<TimePoint>, end: Option<TimePoint>) -> Self {
        Self { start, end, first_ns: None }
    }

    /// Whether it is the whole trace.
    pub fn is_all(&self) -> bool {
        self.start.is_none() && self.end.is_none()
    }

    /// The time of the trace's first record in nanoseconds, as far as it is known.
    pub const fn first_ns(&self) -> Option<i64> {
        self.first_ns
    }

    /// Whether a record is in it. The first record passed is taken as the trace's first.
    pub fn contains(&mut self, record: &TraceRecord) -> bool {
        let first_ns = *self.first_ns.get_or_insert(record.time_ns);
        self.start.is_none_or(|start| record.time_ns >= start.time_ns(first_ns))
            && self.end.is_none_or(|end| record.time_ns < end.time_ns(first_ns))
    }

    /// Learns the time of the trace's first record, which may not be passed. From when and up to before when that is; `None` if it is the whole
    /// trace.
    pub(crate) fn beginning_at(&mut self, first_ns: i64) -> Option<(i64, i64)> {
        let first_ns = *self.first_ns.get_or_insert(first_ns);
        let time_ns = |point: Option<TimePoint>, open| point.map_or(open, |point| point.time_ns(first_ns));
        (!self.is_all()).then(|| (time_ns(self.start, i64::MIN), time_ns(self.end, i64::MAX)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_trace::testing::data_record;

    #[test]
    fn a_time_of_the_clock_has_a_date() {
        assert_eq!(date_text(1_410_714_882_622_188_000).unwrap(), "2014-09-14 17:14:42.622188 UTC");
        assert_eq!(date_text(12_500_000_000), None);
    }

    #[test]
    fn points_are_seconds_from_the_first_record_or_dates() {
        for (text, point) in [
            ("12.5", TimePoint::AfterFirst(12_500_000_000)),
            ("2m", TimePoint::AfterFirst(120_000_000_000)),
            ("5d", TimePoint::AfterFirst(432_000_000_000_000)),
            ("1410714882.5", TimePoint::At(1_410_714_882_500_000_000)),
            ("2014-09-14T17:14:42.5Z", TimePoint::At(1_410_714_882_500_000_000)),
            ("2014-09-14 17:14:42", TimePoint::At(1_410_714_882_000_000_000)),
            ("2014-09-14", TimePoint::At(1_410_652_800_000_000_000)),
        ] {
            assert_eq!(text.parse(), Ok(point), "{text}");
        }
        for bad in ["", "s", "noon", "1e5", "2014-13-01T00:00:00", "2014-13-01", "2014-09", "5y"] {
            assert!(bad.parse::<TimePoint>().is_err(), "{bad}");
        }
    }

    #[test]
    fn a_window_has_its_start_and_not_its_end() {
        let mut window = TimeRange::new(Some(TimePoint::AfterFirst(10)), Some(TimePoint::At(130)));
        let times = [100, 109, 110, 129, 130];
        let found = times.map(|time_ns| window.contains(&data_record(time_ns)));
        assert_eq!(found, [false, false, true, true, false]);
    }
}
