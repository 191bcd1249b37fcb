//! Dates in the headers of trace files. All are taken as UTC: the formats do not name a time zone, and a file
//! must mean the same on every machine.

use super::text::NS_PER_S;

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
        let (days, of_day_ns) = (time_ns.div_euclid(NS_PER_DAY), time_ns.rem_euclid(NS_PER_DAY));
        // Days since 1 March of year 0: leap days come last. An era has 400 years.
        let days = days + 719_468;
        let (era, of_era) = (days.div_euclid(146_097), days.rem_euclid(146_097));
        let year = (of_era - of_era / 1460 + of_era / 36_524 - of_era / 146_096) / 365;
        let of_year = of_era - (365 * year + year / 4 - year / 100);
        let month_from_march = (5 * of_year + 2) / 153;
        let day = of_year - (153 * month_from_march + 2) / 5 + 1;
        let month = if month_from_march < 10 { month_from_march + 3 } else { month_from_march - 9 };
        let year = year + era * 400 + i64::from(month <= 2);
        Self { year, month: month as u8, day: day as u8, of_day_ns }
    }

    /// Nanoseconds since the Unix epoch; `None` if there is no such date or it is out of range.
    pub(crate) fn time_ns(&self) -> Option<i64> {
        if !(1..=12).contains(&self.month) || !(1..=31).contains(&self.day) || self.year.abs() > 9999 {
            return None;
        }
        let (month, day) = (i64::from(self.month), i64::from(self.day));
        let year = self.year - i64::from(month <= 2);
        let (era, of_era) = (year.div_euclid(400), year.rem_euclid(400));
        let of_year = (153 * (month + if month > 2 { -3 } else { 9 }) + 2) / 5 + day - 1;
        let days = era * 146_097 + of_era * 365 + of_era / 4 - of_era / 100 + of_year - 719_468;
        days.checked_mul(NS_PER_DAY)?.checked_add(self.of_day_ns)
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
        // 1 January 1970 was a Thursday.
        (time_ns.div_euclid(NS_PER_DAY) + 4).rem_euclid(7) as usize
    }
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
        assert_eq!(Date { year: 2024, month: 13, day: 1, of_day_ns: 0 }.time_ns(), None);
    }

    proptest! {
        #[test]
        fn any_time_round_trips(time_ns: i64) {
            let time_ns = time_ns.max(i64::MIN + NS_PER_DAY);
            prop_assert_eq!(Date::of(time_ns).time_ns(), Some(time_ns));
        }
    }
}
