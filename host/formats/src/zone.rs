//! Time zones, for the formats whose dates are the clock of the computer that wrote them.

use std::fmt;
use std::str::FromStr;

use jiff::Timestamp;
use jiff::tz::{Offset, TimeZone};

use super::calendar::FIRST_DATE_NS;
use super::text::NS_PER_S;

/// The time zone of dates in files that do not name one. The default is UTC, so that a file means the same on
/// every machine.
///
/// The rules of all zones are built in: the same text gives the same times everywhere.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Zone(Option<TimeZone>);

/// This is not a time zone.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{0}' is not a time zone; write a name such as Europe/Berlin, an offset such as +02:00, or UTC")]
pub struct UnknownZone(String);

impl Zone {
    /// Converts the time shown by a clock in this zone, written as if it were UTC, to nanoseconds since the Unix epoch. In an hour
    /// that occurs twice, it is the first; in one that is skipped, it is as if the clock had not been changed. Times of a trace
    /// without a date are not converted.
    pub(crate) fn utc_ns(&self, clock_ns: i64) -> i64 {
        let Some(zone) = self.zone_of(clock_ns) else { return clock_ns };
        let shown = Offset::UTC.to_datetime(timestamp(clock_ns));
        match zone.to_ambiguous_timestamp(shown).compatible() {
            Ok(time) => i64::try_from(time.as_nanosecond()).unwrap_or(clock_ns),
            Err(_) => clock_ns,
        }
    }

    /// The time shown by a clock in this zone at a time since the Unix epoch, in nanoseconds, as if it were
    /// UTC.
    pub(crate) fn clock_ns(&self, utc_ns: i64) -> i64 {
        let Some(zone) = self.zone_of(utc_ns) else { return utc_ns };
        let offset_s = i64::from(zone.to_offset(timestamp(utc_ns)).seconds());
        utc_ns.saturating_add(offset_s * NS_PER_S)
    }

    fn zone_of(&self, time_ns: i64) -> Option<&TimeZone> {
        self.0.as_ref().filter(|_| !(0..FIRST_DATE_NS).contains(&time_ns))
    }
}

fn timestamp(time_ns: i64) -> Timestamp {
    // Every 64-bit number is a time between 1677 and 2262, which is in range.
    Timestamp::from_nanosecond(i128::from(time_ns)).unwrap_or(Timestamp::UNIX_EPOCH)
}

/// `+02:00`, `-0530`, `+1`.
fn offset(text: &str) -> Option<Offset> {
    let (sign, digits) = match text.split_at_checked(1)? {
        ("+", digits) => (1, digits),
        ("-", digits) => (-1, digits),
        _ => return None,
    };
    let (hours, minutes) = match digits.split_once(':') {
        Some((hours, minutes)) if minutes.len() == 2 => (hours, minutes),
        Some(_) => return None,
        None if digits.len() == 4 => digits.split_at(2),
        None => (digits, "0"),
    };
    let number = |text: &str| {
        let plain = (1..=2).contains(&text.len()) && text.bytes().all(|digit| digit.is_ascii_digit());
        plain.then(|| text.parse::<i32>().ok()).flatten()
    };
    let (hours, minutes) = (number(hours)?, number(minutes)?);
    let valid = hours <= 14 && minutes < 60;
    valid.then(|| Offset::from_seconds(sign * (3600 * hours + 60 * minutes)).ok()).flatten()
}

impl FromStr for Zone {
    type Err = UnknownZone;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if ["utc", "z", "gmt"].iter().any(|name| text.eq_ignore_ascii_case(name)) {
            return Ok(Self(None));
        }
        let zone = offset(text).map(TimeZone::fixed).or_else(|| TimeZone::get(text).ok());
        zone.map(|zone| Self(Some(zone))).ok_or_else(|| UnknownZone(text.to_owned()))
    }
}

impl fmt::Display for Zone {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.0 {
            None => f.write_str("UTC"),
            Some(zone) => match zone.iana_name() {
                Some(name) => f.write_str(name),
                None => write!(f, "{}", zone.to_offset(Timestamp::UNIX_EPOCH)),
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calendar::Date;

    /// Nanoseconds of a date and hour, as if it were UTC.
    fn clock(year: i64, month: u8, day: u8, hour: i64) -> i64 {
        Date { year, month, day, of_day_ns: hour * 3600 * NS_PER_S }.time_ns().unwrap()
    }

    #[test]
    fn clocks_are_moved_by_what_the_zone_has_on_that_day() {
        for (zone, summer, winter) in [
            ("Europe/Berlin", 2, 1),
            ("+02:00", 2, 2),
            ("-0330", -3, -3),
            ("UTC", 0, 0),
            ("america/new_york", -4, -5),
        ] {
            let parsed: Zone = zone.parse().unwrap();
            let half = if zone == "-0330" { -1800 * NS_PER_S } else { 0 };
            for (month, offset) in [(7, summer), (1, winter)] {
                let shown = clock(2024, month, 10, 12);
                let utc = clock(2024, month, 10, 12 - offset) - half;
                assert_eq!(parsed.utc_ns(shown), utc, "{zone} {month}");
                assert_eq!(parsed.clock_ns(utc), shown, "{zone} {month}");
            }
        }
    }

    #[test]
    fn a_trace_without_a_date_has_no_zone_and_clocks_that_are_set_have_a_rule() {
        let berlin: Zone = "Europe/Berlin".parse().unwrap();
        assert_eq!((berlin.utc_ns(5), berlin.clock_ns(5)), (5, 5));
        // 27 October 2024: 02:00 to 03:00 occurs twice. 31 March: it does not occur.
        assert_eq!(berlin.utc_ns(clock(2024, 10, 27, 2)), clock(2024, 10, 27, 0));
        assert_eq!(berlin.utc_ns(clock(2024, 3, 31, 2)), clock(2024, 3, 31, 1));
        for extreme in [i64::MIN, i64::MAX] {
            berlin.utc_ns(extreme);
            berlin.clock_ns(extreme);
        }
    }

    /// Dates in files are what a clock on the wall showed.
    #[test]
    fn the_dates_of_every_format_without_a_zone_follow_the_option() {
        use crate::{CsvDialect, Format, ReadOptions, TrcVersion, WriteOptions, tests};
        let zone: Zone = "Europe/Berlin".parse().unwrap();
        let records = [cantap_trace::testing::data_record(1_410_714_882_622_000_000)];
        for format in [
            Format::Asc,
            Format::Blf,
            Format::Trc(TrcVersion::V1_0),
            Format::Trc(TrcVersion::V1_1),
            Format::Trc(TrcVersion::V2_1),
            Format::Csv(CsvDialect::Analyser),
            Format::Dif,
        ] {
            let write = WriteOptions { format: Some(format), zone: zone.clone(), ..WriteOptions::default() };
            let (bytes, _) = tests::write_with(&write, &records);
            let read = ReadOptions { format: Some(format), zone: zone.clone(), ..ReadOptions::default() };
            let time_ns = |read: Vec<cantap_trace::TraceRecord>| read[0].time_ns / NS_PER_S;
            assert_eq!(time_ns(tests::read_with(&read, &bytes).0), 1_410_714_882, "{format}");
            assert_eq!(time_ns(tests::read(format, &bytes).0), 1_410_714_882 + 7200, "{format}");
        }
        let screen = " (2015-07-10 10:17:32.249713)  can0  123   [0]\n";
        let format = Some(Format::CandumpScreen);
        let read = ReadOptions { format, zone: zone.clone(), ..ReadOptions::default() };
        assert_eq!(tests::read_with(&read, screen).0[0].time_ns / NS_PER_S, 1_436_516_252);
    }

    #[test]
    fn what_is_no_zone_is_refused_with_what_is() {
        for text in ["", "Berlin", "+", "+25:00", "+2:5", "+-1", "02:00", "Europe/", "+00:60", "+é1"] {
            let error = text.parse::<Zone>().unwrap_err().to_string();
            assert!(error.contains("Europe/Berlin"), "{error}");
        }
        assert_eq!("+1".parse::<Zone>().unwrap().to_string(), "+01");
    }
}
