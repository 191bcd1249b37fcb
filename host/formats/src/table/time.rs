//! The times in tables: numbers, dates, and the stamps of CSS Electronics' older loggers.

use std::collections::HashMap;

use jiff::Timestamp;
use jiff::civil::DateTime;
use jiff::tz::Offset;

use super::super::calendar::{Date, NS_PER_DAY};
use super::super::text::{self, NS_PER_S};
use super::super::zone::Zone;

/// The unit of a time that has none: seconds if there is a fraction, and otherwise what makes a date of our days of a large number.
pub(super) fn unit_of(cell: &[u8]) -> i64 {
    match text::decimal(cell) {
        Some(100_000_000_000_000_000..) => 1,
        Some(100_000_000_000_000..) => 1_000,
        Some(100_000_000_000..) => 1_000_000,
        _ => NS_PER_S,
    }
}

/// What the rows say about the unit of times that have none and no fraction, if anything, by how often an identifier comes: a message's period is
/// mostly some tens to some hundreds of milliseconds. Each row is its time and its identifier. The second value says it in words.
pub(super) fn unit_of_rows(rows: &[(&[u8], &[u8])]) -> Option<(i64, &'static str)> {
    /// As many times of an identifier as make a period.
    const ENOUGH: u64 = 3;
    // A part of one is none of a number without a fraction.
    let whole = |cell: &[u8]| text::decimal(cell).or_else(|| text::decimal(cell.strip_suffix(b".0")?));
    let mut of_ids: HashMap<&[u8], (u64, u64, u64)> = HashMap::new();
    for (time, id) in rows {
        let time = whole(time)?;
        let (first, last, count) = of_ids.entry(id).or_insert((time, time, 0));
        (*first, *last, *count) = ((*first).min(time), (*last).max(time), *count + 1);
    }
    let periods = of_ids.values().filter(|(_, _, count)| *count >= ENOUGH);
    let mut periods: Vec<f64> =
        periods.map(|(first, last, count)| (last - first) as f64 / (count - 1) as f64).collect();
    periods.sort_by(f64::total_cmp);
    // In seconds it would be some hundredths to a few, and so on in thousandths.
    Some(match *periods.get(periods.len() / 2)? {
        ..3.0 => {
            (NS_PER_S, "times without a unit were read as seconds, which fits how often identifiers come")
        }
        3.0..3e3 => (
            1_000_000,
            "times without a unit were read as milliseconds, which fits how often identifiers come",
        ),
        3e3..3e6 => {
            (1_000, "times without a unit were read as microseconds, which fits how often identifiers come")
        }
        _ => (1, "times without a unit were read as nanoseconds, which fits how often identifiers come"),
    })
}

/// A number in this unit, also with an exponent.
pub(super) fn number(cell: &[u8], unit_ns: i64) -> Option<i64> {
    if let Some(time_ns) = text::time_of_any_mark(cell, unit_ns) {
        return Some(time_ns);
    }
    if let Some(time_ns) = in_groups(cell) {
        return Some(time_ns);
    }
    let value: f64 = std::str::from_utf8(cell).ok()?.parse().ok()?;
    let time_ns = (value * unit_ns as f64).round();
    (time_ns.abs() < 9e18).then_some(time_ns as i64)
}

/// Seconds, milliseconds, microseconds and nanoseconds, as HMS's loggers write them: `12.345.678.000`.
fn in_groups(cell: &[u8]) -> Option<i64> {
    let mut groups = cell.split(|byte| *byte == b'.');
    let seconds = i64::try_from(text::decimal(groups.next()?)?).ok()?;
    let mut rest = [0; 3];
    for group in &mut rest {
        let digits = groups.next().filter(|digits| digits.len() == 3)?;
        *group = text::decimal(digits)? as i64;
    }
    let [ms, us, ns] = rest;
    let time_ns = seconds.checked_mul(NS_PER_S)?.checked_add(ms * 1_000_000 + us * 1_000 + ns)?;
    groups.next().is_none().then_some(time_ns)
}

/// A number with its unit, as MATLAB writes a duration: `1.8173 sec`.
pub(super) fn with_unit(cell: &[u8]) -> Option<i64> {
    let at = cell.iter().position(u8::is_ascii_alphabetic)?;
    let (number, unit) = cell.split_at(at);
    let unit_ns = match unit {
        b"s" | b"sec" => NS_PER_S,
        b"ms" => 1_000_000,
        b"us" => 1_000,
        _ => return None,
    };
    text::time_of_any_mark(number.trim_ascii_end(), unit_ns)
}

/// A date, or a time of a day without one.
pub(crate) fn date(cell: &[u8], zone: &Zone) -> Option<i64> {
    let cell = std::str::from_utf8(cell).ok()?.replace('/', "-");
    if let Ok(time) = cell.parse::<Timestamp>() {
        return i64::try_from(time.as_nanosecond()).ok();
    }
    if let Ok(date) = cell.replace(',', ".").parse::<DateTime>() {
        let clock = Offset::UTC.to_timestamp(date).ok()?;
        return Some(zone.utc_ns(i64::try_from(clock.as_nanosecond()).ok()?));
    }
    let mut parts = cell.split(':').map(str::as_bytes);
    let [hour, minute] = [(); 2].map(|()| parts.next().and_then(text::decimal));
    let second_ns = text::time_of_any_mark(parts.next()?, NS_PER_S)?;
    let (hour, minute) = (hour?, minute?);
    let valid = hour < 24 && minute < 60 && (0..61 * NS_PER_S).contains(&second_ns) && parts.next().is_none();
    valid.then(|| (hour * 3600 + minute * 60) as i64 * NS_PER_S + second_ns)
}

/// A time, behind the last one: a clock without a date begins again at midnight, and its days go on.
pub(crate) fn going_on(time_ns: i64, last_ns: Option<i64>) -> i64 {
    const HALF_NS: i64 = NS_PER_DAY / 2;
    let last = last_ns.unwrap_or(0);
    let of_day = (0..NS_PER_DAY).contains(&time_ns);
    let day_ns = if of_day { last - last.rem_euclid(NS_PER_DAY) } else { 0 };
    let day_ns = if day_ns < 3650 * NS_PER_DAY { day_ns } else { 0 };
    let is_next = of_day && last_ns.is_some_and(|last_ns| time_ns + day_ns + HALF_NS < last_ns);
    time_ns + day_ns + if is_next { NS_PER_DAY } else { 0 }
}

/// The year, the month and the day of a file: what its stamps leave out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct FileDate {
    year: i64,
    month: u8,
    day: u8,
}

impl FileDate {
    /// From a comment such as `# Time: 20231005T071031`.
    pub(super) fn of_comment(line: &[u8]) -> Option<Self> {
        let stamp = line.strip_prefix(b"#")?.trim_ascii_start().strip_prefix(b"Time:")?.trim_ascii();
        let digits = stamp.split(|byte| *byte == b'T').next().filter(|digits| digits.len() == 8)?;
        let number = |digits: &[u8]| text::decimal(digits);
        let [year, month, day] = [number(&digits[..4])?, number(&digits[4..6])?, number(&digits[6..])?];
        let valid = (1..=12).contains(&month) && (1..=31).contains(&day);
        valid.then_some(Self { year: year as i64, month: month as u8, day: day as u8 })
    }
}

/// A stamp such as `31T135012345`, day of the month, time and milliseconds, or `20231031T135012345`. Without a day of the file, the days count
/// from the first of no month.
pub(super) fn stamp(cell: &[u8], file: Option<FileDate>, zone: &Zone) -> Option<i64> {
    let at = memchr::memchr(b'T', cell)?;
    let (date, clock) = (&cell[..at], &cell[at + 1..]);
    if clock.len() != 9 && clock.len() != 6 {
        return None;
    }
    let [hour, minute, second] = [0, 2, 4].map(|at| text::decimal(&clock[at..at + 2]));
    let ms = if clock.len() == 9 { text::decimal(&clock[6..])? } else { 0 };
    let of_day_ns = Date::of_day(hour?, minute?, second?, ms as i64 * 1_000_000)?;
    let [year, month, day] = match (date.len(), file) {
        (8, _) => [&date[..4], &date[4..6], &date[6..]].map(text::decimal),
        (2, Some(file)) => {
            let day = text::decimal(date)?;
            // A day before the file's is one of the next month.
            let months = 12 * file.year as u64 + u64::from(file.month) - 1 + u64::from(day < file.day.into());
            [Some(months / 12), Some(months % 12 + 1), Some(day)]
        }
        (2, None) => {
            let day = text::decimal(date).filter(|day| (1..=31).contains(day))?;
            return Some((day as i64 - 1) * NS_PER_DAY + of_day_ns);
        }
        _ => return None,
    };
    let [month, day] = [month?, day?].map(|number| u8::try_from(number).unwrap_or(0));
    let clock_ns = Date { year: year? as i64, month, day, of_day_ns }.time_ns()?;
    Some(zone.utc_ns(clock_ns))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_stamps_and_numbers_are_times() {
        let zone = Zone::default();
        let noon = 1_577_880_000 * NS_PER_S;
        for text in ["2020-01-01 12:00:00", "2020/01/01 12:00:00,000", "2020-01-01T13:00:00+01:00"] {
            assert_eq!(date(text.as_bytes(), &zone), Some(noon), "{text}");
        }
        assert_eq!(date(b"01:00:00.5", &zone), Some(3600 * NS_PER_S + NS_PER_S / 2));
        for bad in ["", "x", "25:00:00", "1:2", "1:2:3:4", "2020-13-01 12:00:00"] {
            assert_eq!(date(bad.as_bytes(), &zone), None, "{bad}");
        }
        assert_eq!(stamp(b"20200101T120000000", None, &zone), Some(noon));
        let day = FileDate::of_comment(b"# Time: 20191231T235959");
        assert_eq!(stamp(b"01T120000000", day, &zone), Some(noon));
        assert_eq!(stamp(b"02T000000011", None, &zone), Some(NS_PER_DAY + 11_000_000));
        for bad in ["", "T", "32T000000000", "1T", "01T250000000", "01T12000000\u{e9}"] {
            assert_eq!(stamp(bad.as_bytes(), None, &zone), None, "{bad}");
        }
        assert_eq!(with_unit(b"1.8173 sec"), Some(1_817_300_000));
        assert_eq!(
            (with_unit(b"2ms"), with_unit(b"2 min"), with_unit(b"sec")),
            (Some(2_000_000), None, None)
        );
        assert_eq!(number(b"1.5e-3", NS_PER_S), Some(1_500_000));
        assert_eq!(number(b"12.345.678.009", NS_PER_S), Some(12_345_678_009));
        for bad in ["12.345.678", "1.2.3.4", "1.234.567.890.123", "99999999999.000.000.000"] {
            assert_eq!(number(bad.as_bytes(), NS_PER_S), None, "{bad}");
        }
        assert_eq!((unit_of(b"1614875400123456"), unit_of(b"12")), (1000, NS_PER_S));
    }

    /// Two messages, every 10 and every 100 ms, as loggers write them in each unit.
    #[test]
    fn how_often_identifiers_come_shows_a_unit() {
        for (per_ms, unit_ns) in [(1_000_000, 1), (1_000, 1_000), (1, 1_000_000)] {
            let times: Vec<String> = (0..60).map(|n| (10 * n * per_ms).to_string()).collect();
            let rows = times
                .iter()
                .enumerate()
                .map(|(n, time)| (time.as_bytes(), if n % 10 == 9 { &b"456"[..] } else { b"123" }));
            let rows: Vec<_> = rows.collect();
            assert_eq!(unit_of_rows(&rows).map(|(unit_ns, _)| unit_ns), Some(unit_ns), "{per_ms}");
            assert_eq!(unit_of_rows(&rows[..2]), None);
        }
        // In whole seconds many have the same.
        let times: Vec<String> = (0..60).map(|n| (n / 20).to_string()).collect();
        let mut rows: Vec<_> = times.iter().map(|time| (time.as_bytes(), &b"123"[..])).collect();
        assert_eq!(unit_of_rows(&rows).map(|(unit_ns, _)| unit_ns), Some(NS_PER_S));
        rows.push((b"3.5", b"123"));
        assert_eq!(unit_of_rows(&rows), None);
    }
}
