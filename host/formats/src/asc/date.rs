//! Dates in ASC files. Programs write them in their computer's language and in its encoding, so only what letters, digits and marks of ASCII
//! say is looked at, and a few signs of Japanese.

use super::super::calendar::Date;
use super::super::issue::Fault;
use super::super::text::{self, NS_PER_S};
use super::super::zone::Zone;

/// How months begin in English, German, French, Italian, Spanish and Portuguese, without the letters that are not ASCII: as many letters as tell
/// them from others.
const MONTHS: [&[&str]; 12] = [
    &["jan", "gen", "ene"],
    &["feb", "fv", "fev"],
    &["mar", "mr"],
    &["apr", "avr", "abr"],
    &["may", "mai", "mag"],
    &["jun", "juin", "giu"],
    &["jul", "juil", "lug"],
    &["aug", "aot", "aout", "ago"],
    &["sep", "set"],
    &["oct", "okt", "ott", "out"],
    &["nov"],
    &["dec", "dez", "dc", "dic"],
];

/// English days of the week, from that of the epoch.
const WEEKDAYS: [&str; 7] = ["thu", "fri", "sat", "sun", "mon", "tue", "wed"];

// Signs of Japanese, in UTF-8 and in Shift-JIS.
const MONTH: [&[u8]; 2] = [&[0xE6, 0x9C, 0x88], &[0x8C, 0x8E]];
const MORNING: [&[u8]; 2] = [&[0xE5, 0x8D, 0x88, 0xE5, 0x89, 0x8D], &[0x8C, 0xDF, 0x91, 0x4F]];
const AFTERNOON: [&[u8]; 2] = [&[0xE5, 0x8D, 0x88, 0xE5, 0xBE, 0x8C], &[0x8C, 0xDF, 0x8C, 0xE3]];

/// What a date consists of, as far as its words have said.
#[derive(Default)]
struct Parts {
    /// A month by its name or sign.
    month: Option<u64>,
    year: Option<u64>,
    /// In days after the epoch's.
    weekday: Option<i64>,
    /// Month and day, or the day alone.
    small: Vec<u64>,
    /// Hour, minute, and nanoseconds of the minute.
    clock: Option<(u64, u64, i64)>,
    /// Whether the clock's hours begin anew in the afternoon, and this is it.
    afternoon: Option<bool>,
    /// Seconds east of UTC, if the date says its zone.
    offset_s: Option<i64>,
}

/// The time since the epoch of a date such as `Sat Sep 30 15:06:13.191 2017`: by the clock of a zone unless it says another, with `am` or `pm`
/// anywhere, in several languages.
pub(super) fn date(text: &[u8], zone: &Zone) -> Result<i64, Fault> {
    let time_ns = Parts::of(text).and_then(|parts| parts.time_ns(zone));
    time_ns.ok_or_else(|| Fault::malformed("a date such as Sat Sep 30 15:06:13.191 2017", text))
}

/// Whether a date's English day of the week is another's than its day: then one of them is wrong.
pub(super) fn has_wrong_weekday(text: &[u8]) -> bool {
    let days = |parts: &Parts| Some(parts.clock_ns()?.div_euclid(86_400 * NS_PER_S));
    let differ = |parts: Parts| Some(days(&parts)?.rem_euclid(7) != parts.weekday?);
    Parts::of(text).and_then(differ).unwrap_or(false)
}

fn has(word: &[u8], signs: [&[u8]; 2]) -> bool {
    signs.iter().any(|sign| memchr::memmem::find(word, sign).is_some())
}

/// The numbers in a word.
fn numbers(word: &[u8]) -> Option<Vec<u64>> {
    let digits = word.split(|byte| !byte.is_ascii_digit()).filter(|digits| !digits.is_empty());
    digits.map(text::decimal).collect()
}

impl Parts {
    fn of(text: &[u8]) -> Option<Self> {
        let mut parts = Self::default();
        for word in text.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty()) {
            parts.word(word)?;
        }
        Some(parts)
    }

    /// `None` if a word contradicts what a date can have.
    fn word(&mut self, word: &[u8]) -> Option<()> {
        let letters: String = word
            .iter()
            .filter(|byte| byte.is_ascii_alphabetic())
            .map(|byte| char::from(byte.to_ascii_lowercase()))
            .collect();
        if has(word, MORNING) || has(word, AFTERNOON) {
            self.afternoon = Some(has(word, AFTERNOON));
        } else if letters.starts_with("gmt") || letters.starts_with("utc") {
            self.offset_s = Some(offset_s(word)?);
        } else if word.contains(&b':') && word.first().is_some_and(u8::is_ascii_digit) {
            return self.clock(word);
        } else if has(word, MONTH) {
            // Also as in 2017年9月30日; a weekday that is the same sign has no number.
            return match numbers(word)?[..] {
                [] => Some(()),
                [month] => self.numbers(None, Some(month), None),
                [year, month, day] => self.numbers(Some(year), Some(month), Some(day)),
                _ => None,
            };
        } else if word.first().is_some_and(u8::is_ascii_digit) {
            return match numbers(word)?[..] {
                [year] if year > 31 => self.numbers(Some(year), None, None),
                [small] => self.numbers(None, None, Some(small)),
                [year, month, day] if year > 31 && word.contains(&b'-') => {
                    self.numbers(Some(year), Some(month), Some(day))
                }
                [day, month, year] if word.contains(&b'.') => {
                    self.numbers(Some(year), Some(month), Some(day))
                }
                // What is the month in 9/10/2017 depends on the country.
                _ => None,
            };
        } else if letters == "am" || letters == "pm" {
            self.afternoon = Some(letters == "pm");
        } else if let Some(weekday) = WEEKDAYS.iter().position(|name| letters == *name) {
            self.weekday = Some(weekday as i64);
        } else {
            // The names of days come before those of months, and some are the same.
            let begins = |names: &&[&str]| names.iter().any(|name| letters.starts_with(name));
            if let Some(month) = MONTHS.iter().position(begins) {
                self.month = Some(month as u64 + 1);
            }
        }
        Some(())
    }

    fn numbers(&mut self, year: Option<u64>, month: Option<u64>, small: Option<u64>) -> Option<()> {
        if year.is_some() && self.year.is_some() {
            return None;
        }
        self.year = year.or(self.year);
        self.month = month.or(self.month);
        self.small.extend(small);
        Some(())
    }

    fn clock(&mut self, word: &[u8]) -> Option<()> {
        // As in 3:06:13PM.
        let lower = word.to_ascii_lowercase();
        let (word, half) = match lower.strip_suffix(b"am").map(|word| (word, false)) {
            Some((word, half)) => (word, Some(half)),
            None => lower.strip_suffix(b"pm").map_or((&lower[..], None), |word| (word, Some(true))),
        };
        self.afternoon = half.or(self.afternoon);
        let mut parts = word.splitn(3, |byte| *byte == b':');
        let (hour, minute) = (text::decimal(parts.next()?)?, text::decimal(parts.next()?)?);
        let second_ns = text::time_of_any_mark(parts.next()?, NS_PER_S).filter(|ns| *ns >= 0)?;
        self.clock.replace((hour, minute, second_ns)).is_none().then_some(())
    }

    /// By the clock of the date's own zone.
    fn clock_ns(&self) -> Option<i64> {
        let (hour, minute, second_ns) = self.clock?;
        let hour = match self.afternoon {
            // Twelve comes first on a 12-hour clock. Some files combine hours above twelve with pm.
            Some(false) => hour % 12,
            Some(true) if hour < 12 => hour + 12,
            _ => hour,
        };
        let (month, day) = match (self.month.as_ref(), &self.small[..]) {
            (Some(month), [day]) | (None, [month, day]) => (*month, *day),
            _ => return None,
        };
        let second = (second_ns / NS_PER_S) as u64;
        let of_day_ns = Date::of_day(hour, minute, second, second_ns % NS_PER_S)?;
        let (month, day) = (u8::try_from(month).ok()?, u8::try_from(day).ok()?);
        Date { year: i64::try_from(self.year?).ok()?, month, day, of_day_ns }.time_ns()
    }

    fn time_ns(&self, zone: &Zone) -> Option<i64> {
        let clock_ns = self.clock_ns()?;
        Some(match self.offset_s {
            Some(offset_s) => clock_ns.checked_sub(offset_s * NS_PER_S)?,
            None => zone.utc_ns(clock_ns),
        })
    }
}

/// Seconds east of UTC: `GMT`, `GMT+1`, `UTC+01:00`, `GMT-0530`.
fn offset_s(word: &[u8]) -> Option<i64> {
    let Some(at) = word.iter().position(|byte| matches!(byte, b'+' | b'-')) else { return Some(0) };
    let digits = &word[at + 1..];
    let (hours, minutes) = match numbers(digits)?[..] {
        [both] if digits.len() > 2 => (both / 100, both % 100),
        [hours] => (hours, 0),
        [hours, minutes] => (hours, minutes),
        _ => return None,
    };
    let seconds = i64::try_from(hours * 3600 + minutes * 60).ok().filter(|_| hours < 24 && minutes < 60)?;
    Some(if word[at] == b'-' { -seconds } else { seconds })
}

#[cfg(test)]
mod tests {
    use super::{Zone, date, has_wrong_weekday};

    #[test]
    fn dates_of_several_languages_and_encodings_are_read() {
        const NS: i64 = 1_506_783_973_191_000_000;
        let berlin: Zone = "Europe/Berlin".parse().unwrap();
        let latin = |text: &str| text.chars().map(|character| character as u8).collect::<Vec<_>>();
        let afternoon_in_shift_jis = [&b"\x93\x79 9 30 03:06:13.191 \x8C\xDF\x8C\xE3 2017"[..]].concat();
        for text in [
            &b"Sat Sep 30 15:06:13.191 2017"[..],
            b"Sat Sep 30 03:06:13.191 pm 2017",
            b"Sat Sep 30 03:06:13.191 2017 PM",
            b"Sam Sep 30 15:06:13,191 2017",
            "sam. sept. 30 15:06:13.191 2017".as_bytes(),
            "土 9月 30 15:06:13.191 2017".as_bytes(),
            "土 9 30 03:06:13.191 午後 2017".as_bytes(),
            "2017年9月30日 15:06:13.191".as_bytes(),
            &afternoon_in_shift_jis[..],
            b"2017-09-30 15:06:13.191",
            b"30.09.2017 15:06:13.191",
            b"sab. set. 30 15:06:13.191 2017",
        ] {
            assert_eq!(date(text, &Zone::default()).unwrap(), NS, "{}", String::from_utf8_lossy(text));
            // By the clock there.
            assert_eq!(
                date(text, &berlin).unwrap(),
                NS - 7_200_000_000_000,
                "{}",
                String::from_utf8_lossy(text)
            );
        }
        // What says its zone is the same everywhere.
        for text in [
            "Sat Sep 30 15:06:13.191 GMT 2017",
            "Sat, 30 Sep 2017 17:06:13.191 GMT+0200",
            "Sat Sep 30 10:06:13.191 UTC-05:00 2017",
        ] {
            assert_eq!(date(text.as_bytes(), &berlin).unwrap(), NS, "{text}");
        }
        let first = |text: &[u8]| date(text, &Zone::default()).unwrap() / 86_400_000_000_000;
        assert_eq!(first("mar. mars 7 00:00:00 2017".as_bytes()), 17_232);
        assert_eq!(first(&latin("mar. d\u{e9}c. 5 00:00:00 2017")), 17_505);
        assert_eq!(first("ven. févr. 3 00:00:00 2017".as_bytes()), 17_200);
        assert_eq!(first(&latin("mar. ao\u{fb}t 1 00:00:00 2017")), 17_379);
        assert_eq!(first("Di Mär 7 00:00:00 2017".as_bytes()), 17_232);
        assert_eq!(first(&latin("Di M\u{e4}r 7 00:00:00 2017")), 17_232);
    }

    #[test]
    fn a_day_of_the_week_that_is_another_date_s_is_noticed() {
        for text in
            ["Tue Nov 11 10:13:20.257 PM 2023", "Sun Sep 30 15:06:13.191 2017", "Fri Jan 1 00:00:00 1960 "]
        {
            let wrong = !text.contains("1960");
            assert_eq!(has_wrong_weekday(text.as_bytes()), wrong, "{text}");
        }
        for text in
            ["Sat Sep 30 15:06:13.191 2017", "Son Sep 30 15:06:13.191 2017", "2017-09-30 15:06:13.191", "Sat"]
        {
            assert!(!has_wrong_weekday(text.as_bytes()), "{text}");
        }
    }

    #[test]
    fn what_is_no_date_or_could_be_two_is_refused() {
        for text in [
            "",
            "Sat",
            "Sat Sep 30 2017",
            "Sat Sep 30 15:06:13",
            "Sat Sep 31x 15:06 2017",
            "9/10/2017 15:06:13",
            "Sat Foo 30 15:06:13 2017",
            "Sat Sep 30 25:06:13 2017",
            "Sat Sep 30 15:06:13 2017 2018",
            "Sat Sep 30 15:06:13 15:06:13 2017",
            "Sat Sep 32 15:06:13 2017",
            "Sat Sep 30 15:06:13 GMT+99 2017",
        ] {
            assert!(date(text.as_bytes(), &Zone::default()).is_err(), "{text}");
        }
    }
}
