//! Dates in the headers of trace files. All are taken as UTC: the formats do not name a time zone, and a file
//! must mean the same on every machine.

use jiff::{ToSpan, civil};

use super::text::NS_PER_S;

const EPOCH: civil::Date = civil::date(1970, 1, 1);

const S_PER_DAY: i64 = 86_400;

/// Nanoseconds per day.
pub(crate) const NS_PER_DAY: i64 = S_PER_DAY * NS_PER_S;

/// A trace whose first time is before 1990 has times from its own start: no analyser is that old. python-can
/// uses the same limit.
pub(crate) const FIRST_DATE_NS: i64 = 631_152_000 * NS_PER_S;

/// English month names, as ASC files have them.
pub(crate) const MONTHS: [&str; 12] =
    ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"];

/// English day names, from Sunday.
pub(crate) const DAYS: [&str; 7] = ["Sun", "Mon", "Tue", "Wed", "Thu", "Fri", "Sat"];

/// A date and time of day in UTC.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Date {
    /// Year.
    pub year: i64,
    /// 1 to 12.
    pub month: u8,
    /// 1 to 31.
    pub day: u8,
    /// Nanoseconds since midnight.
    pub of_day_ns: i64,
}

impl Date {
    /// The date of a time since the Unix epoch.
    pub(crate) fn of(time_ns: i64) -> Self {
        let date = day_of(time_ns);
        let (year, month, day) = (date.year().into(), date.month() as u8, date.day() as u8);
        Self { year, month, day, of_day_ns: time_ns.rem_euclid(NS_PER_DAY) }
    }

    /// Nanoseconds since the Unix epoch; `None` if there is no such date or it is out of range.
    pub(crate) fn time_ns(&self) -> Option<i64> {
        let (year, month, day) = (self.year.try_into().ok()?, self.month as i8, self.day as i8);
        let date = civil::Date::new(year, month, day).ok()?;
        let days = EPOCH.until(date).ok()?.get_days();
        i64::from(days).checked_mul(NS_PER_DAY)?.checked_add(self.of_day_ns)
    }

    /// Hour, minute, second and remaining nanoseconds.
    pub(crate) fn clock(&self) -> (u8, u8, u8, u32) {
        let seconds = self.of_day_ns / NS_PER_S;
        let ns = (self.of_day_ns % NS_PER_S) as u32;
        ((seconds / 3600) as u8, (seconds / 60 % 60) as u8, (seconds % 60) as u8, ns)
    }

    /// Nanoseconds since midnight; `None` if there is no such time.
    pub(crate) fn of_day(hour: u64, minute: u64, second: u64, ns: i64) -> Option<i64> {
        let valid = hour < 24 && minute < 60 && second < 60 && (0..NS_PER_S).contains(&ns);
        valid.then(|| ((hour * 3600 + minute * 60 + second) as i64) * NS_PER_S + ns)
    }

    /// 0 is Sunday.
    pub(crate) fn weekday(time_ns: i64) -> usize {
        day_of(time_ns).weekday().to_sunday_zero_offset() as usize
    }
}

/// The day of a time since the Unix epoch. All that fit into 64 bits are between the years 1677 and 2262.
fn day_of(time_ns: i64) -> civil::Date {
    EPOCH.saturating_add(time_ns.div_euclid(NS_PER_DAY).days())
}

/// The start in a file's header for a trace beginning at `first_ns`: in whole milliseconds, the formats'
/// resolution; 0 for a trace without a date.
pub(crate) fn start_of_trace(first_ns: i64) -> i64 {
    const NS_PER_MS: i64 = 1_000_000;
    if (0..FIRST_DATE_NS).contains(&first_ns) { 0 } else { first_ns.div_euclid(NS_PER_MS) * NS_PER_MS }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn known_dates_are_right() {
        let date = Date::of(1_410_714_882_622_188_000);
        assert_eq!((date.year, date.month, date.day), (2014, 9, 14));
        assert_eq!(date.clock(), (17, 14, 42, 622_188_000));
        assert_eq!(DAYS[Date::weekday(1_410_714_882_622_188_000)], "Sun");
        assert_eq!(Date::of(-1).clock(), (23, 59, 59, 999_999_999));
        assert_eq!(DAYS[Date::weekday(-1)], "Wed");
        assert_eq!(
            Date { year: 1899, month: 12, day: 30, of_day_ns: 0 }.time_ns(),
            Some(-25_569 * NS_PER_DAY)
        );
        for (month, day) in [(13, 1), (0, 1), (2, 30), (4, 31), (1, 0)] {
            assert_eq!(Date { year: 2024, month, day, of_day_ns: 0 }.time_ns(), None, "{month}-{day}");
        }
        assert_eq!(Date { year: 1 << 40, month: 1, day: 1, of_day_ns: 0 }.time_ns(), None);
    }

    proptest! {
        #[test]
        fn any_time_round_trips(time_ns: i64) {
            let time_ns = time_ns.max(i64::MIN + NS_PER_DAY);
            prop_assert_eq!(Date::of(time_ns).time_ns(), Some(time_ns));
        }
    }
}
