//! BUSMASTER's log: `11:49:12:9420 Rx 1 0x023 s 8 40 …` after a header between asterisks. Times are the computer's clock, count
//! from the start, or are differences; numbers are hexadecimal or decimal: the header says which.

use super::calendar::{Date, NS_PER_DAY};
use super::frame_fields::{FrameFields, Payload, decimal_byte, direction, hex_byte, identifier};
use super::issue::Fault;
use super::row_format::{Line, RowFormat};
use super::text::{self, NS_PER_S};
use super::zone::Zone;
use cantap_trace::TraceRecord;

/// Reads a log.
#[derive(Default)]
pub(crate) struct Decoder {
    decimal: bool,
    times: Times,
    /// When the session began, by the computer's clock.
    start_ns: i64,
    /// The last time in a line, as written, and with the days or the sum added to it.
    last_ns: i64,
    base_ns: i64,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Times {
    /// The computer's clock.
    #[default]
    Clock,
    FromStart,
    Differences,
}

/// Whether a text begins like such a file.
///
/// Its first lines may have been cut off.
pub(crate) fn is_head(text: &[u8]) -> bool {
    [&b"***BUSMASTER"[..], b"***HEX***", b"***DEC***", b"***<Time>"].iter().any(|head| text.starts_with(head))
}

/// Whether a line is a row of such a file, from which the head was cut off.
pub(crate) fn is_line(line: &[u8]) -> bool {
    let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
    let mut next = || words.next().unwrap_or_default();
    let [time, way, _, _, kind] = [(); 5].map(|()| next());
    clock(time).is_some() && direction(way).is_ok() && matches!(kind, b"s" | b"x" | b"sr" | b"xr")
}

impl RowFormat for Decoder {
    fn line(&mut self, line: &[u8], zone: &Zone) -> Result<Line, Fault> {
        if line.starts_with(b"***") {
            return self.head(line.trim_ascii_end()).map(|()| Line::Nothing);
        }
        if line.is_empty() {
            return Ok(Line::Nothing);
        }
        let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        let mut next = || words.next().unwrap_or_default();
        let [time, way, channel, id, kind, len] = [(); 6].map(|()| next());
        let of_day_ns = clock(time);
        let fault = || Fault::malformed("a line such as '11:49:12:9420 Rx 1 0x023 s 1 40'", line);
        let time_ns = self.time(of_day_ns.ok_or_else(fault)?, zone);
        let direction = direction(way)?;
        let number = text::decimal(channel).and_then(|channel| u8::try_from(channel).ok());
        let channel = number.ok_or_else(|| Fault::malformed("a channel of 0 to 255", channel))?;
        let raw = text::number(id, self.decimal);
        let raw = raw.ok_or_else(|| Fault::malformed("an identifier such as 0x123", id))?;
        let (extended, remote) = match kind {
            b"s" | b"S" => (false, false),
            b"x" | b"X" => (true, false),
            b"sr" | b"SR" => (false, true),
            b"xr" | b"XR" => (true, true),
            other => return Err(Fault::malformed("a type: s, x, sr or xr", other)),
        };
        let id = identifier(raw, extended, id)?;
        let len = super::frame_fields::length_code(len)?;
        let fields = FrameFields { id, remote, direction, len, fd: None };
        let byte = if self.decimal { decimal_byte } else { hex_byte };
        let data = if remote {
            // A few versions write the requested length as zeros, which nobody sent.
            let written = words.clone().count().min(usize::from(len));
            Payload::words(&mut words, written, byte)?;
            Payload::exactly(words, 0, byte)?
        } else {
            Payload::exactly(words, fields.data_len(), byte)?
        };
        Ok(Line::Record(TraceRecord { time_ns, device_ns: None, channel, event: fields.event(&data)? }))
    }

    fn may_be_cut(&self, _line: &[u8], record: &TraceRecord) -> bool {
        // There are as many bytes as the length says; a decimal one may lack a digit.
        self.decimal || record.frame().is_none_or(|frame| frame.is_remote() || frame.data().is_empty())
    }
}

impl Decoder {
    fn head(&mut self, line: &[u8]) -> Result<(), Fault> {
        let text = line.trim_ascii_start().strip_prefix(b"***").unwrap_or(line);
        let text = text.strip_suffix(b"***").unwrap_or(text);
        match text {
            b"HEX" => self.decimal = false,
            b"DEC" => self.decimal = true,
            b"SYSTEM MODE" => self.times = Times::Clock,
            b"ABSOLUTE MODE" => self.times = Times::FromStart,
            b"RELATIVE MODE" => self.times = Times::Differences,
            _ => {
                if let Some(protocol) = text.strip_prefix(b"PROTOCOL ") {
                    if protocol != b"CAN" {
                        return Err(Fault::malformed("a log of the protocol CAN", protocol));
                    }
                } else if let Some(start) = text.strip_prefix(b"START DATE AND TIME ") {
                    let fault = || Fault::malformed("a date such as 8:8:2014 11:49:7:965", start);
                    self.start_ns = date(start).ok_or_else(fault)?;
                    (self.last_ns, self.base_ns) = (0, 0);
                }
            }
        }
        Ok(())
    }

    /// A line's time since the epoch.
    fn time(&mut self, shown_ns: i64, zone: &Zone) -> i64 {
        let clock_ns = match self.times {
            Times::FromStart => self.start_ns.saturating_add(shown_ns),
            Times::Differences => {
                self.base_ns = self.base_ns.saturating_add(shown_ns);
                self.start_ns.saturating_add(self.base_ns)
            }
            Times::Clock => {
                let begin_ns = self.start_ns.rem_euclid(NS_PER_DAY);
                let before_ns = if self.last_ns == 0 { begin_ns } else { self.last_ns };
                // A time that is far earlier is on the next day; a little earlier is another channel's frame.
                if shown_ns < before_ns - NS_PER_DAY / 2 {
                    self.base_ns += NS_PER_DAY;
                }
                self.last_ns = shown_ns;
                (self.start_ns - begin_ns).saturating_add(self.base_ns).saturating_add(shown_ns)
            }
        };
        zone.utc_ns(clock_ns)
    }
}

/// `11:49:12:9420`: the last part is a fraction of a second, however many digits it has.
fn clock(text: &[u8]) -> Option<i64> {
    let mut parts = text.splitn(4, |byte| *byte == b':');
    let mut whole = || text::decimal(parts.next()?).and_then(|part| i64::try_from(part).ok());
    // Times from the start may exceed a day.
    let (hours, minutes, seconds) = (whole()?, whole()?, whole()?);
    let fraction = [b"0.", parts.next()?].concat();
    let fraction_ns = text::time(&fraction, NS_PER_S, b'.')?;
    let valid = hours < 1_000_000 && minutes < 60 && seconds < 60;
    valid.then(|| ((hours * 60 + minutes) * 60 + seconds) * NS_PER_S + fraction_ns)
}

/// `8:8:2014 11:49:7:965`: day, month, year, and a clock whose last part is milliseconds.
fn date(text: &[u8]) -> Option<i64> {
    const NS_PER_MS: i64 = 1_000_000;
    let text = std::str::from_utf8(text).ok()?.trim();
    let numbers = text.split([':', ' ']).filter(|part| !part.is_empty());
    let numbers: Vec<u64> = numbers.map(|part| text::decimal(part.as_bytes())).collect::<Option<_>>()?;
    let (date, ms) = match numbers[..] {
        [day, month, year, hour, minute, second] => ([day, month, year, hour, minute, second], 0),
        [day, month, year, hour, minute, second, ms] => ([day, month, year, hour, minute, second], ms),
        _ => return None,
    };
    let [day, month, year, hour, minute, second] = date;
    let of_day_ns = Date::of_day(hour, minute, second, i64::try_from(ms).ok()?.checked_mul(NS_PER_MS)?)?;
    let (day, month) = (u8::try_from(day).ok()?, u8::try_from(month).ok()?);
    Date { year: i64::try_from(year).ok()?, month, day, of_day_ns }.time_ns()
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::Format;

    fn as_log(file: &str) -> (String, Vec<String>) {
        tests::as_log(Format::Busmaster, file)
    }

    fn head(mode: &str) -> String {
        format!(
            "***BUSMASTER Ver 2.4.0***\n***PROTOCOL CAN***\n***NOTE: PLEASE DO NOT EDIT THIS DOCUMENT***\n\
             ***[START LOGGING SESSION]***\n***START DATE AND TIME 8:8:2014 23:59:58:965***\n{mode}\
             ***START CHANNEL BAUD RATE***\n***CHANNEL 1 - Kvaser - Leaf Light HS #0, Serial Number- 0 - 500000 bps***\n\
             ***END CHANNEL BAUD RATE***\n***<Time><Tx/Rx><Channel><CAN ID><Type><DLC><DataBytes>***\n"
        )
    }

    #[test]
    fn the_computers_clock_goes_over_midnight() {
        let (log, issues) = as_log(&format!(
            "{}23:59:59:9420 Rx 1 0x023 s 1 40 \n00:00:00:0001 Tx 2 0x18DAF110 x 2 03 E0 \n00:00:01:5000 Rx 1 0x460 sr 4 \n\
             00:00:01:5000 Rx 1 0x460 xr 0\n***END DATE AND TIME 9:8:2014 0:0:2:0***\n***[STOP LOGGING SESSION]***\n",
            head("***HEX***\n***SYSTEM MODE***\n")
        ));
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            log,
            "(1407542399.942000) can0 023#40\n(1407542400.000100) can1 18DAF110#03E0 T\n\
             (1407542401.500000) can0 460#R4\n(1407542401.500000) can0 00000460#R\n"
        );
    }

    /// As real logs have them.
    #[test]
    fn bytes_behind_remote_frames_are_those_of_their_length_and_mean_nothing() {
        let (log, issues) = as_log(&format!(
            "{}23:59:59:1 Rx 1 0x103 xr 8 00 00 00 00 00 00 00 00 \n23:59:59:1 Rx 1 0x104 sr 2 00 00\n\
             23:59:59:1 Rx 1 0x104 sr 2 00 00 00\n23:59:59:1 Rx 1 0x104 sr 2 0G 00\n",
            head("***HEX***\n***SYSTEM MODE***\n")
        ));
        assert_eq!(log, "(1407542399.100000) can0 00000103#R8\n(1407542399.100000) can0 104#R2\n");
        assert_eq!(issues.len(), 2, "{issues:#?}");
    }

    #[test]
    fn other_times_run_from_the_start_and_numbers_may_be_decimal() {
        let lines = "00:00:00:5000 Rx 1 35 s 2 64 255\n00:00:00:2500 Rx 1 35 s 0\n";
        let absolute = as_log(&format!("{}{lines}", head("***DEC***\n***ABSOLUTE MODE***\n")));
        assert_eq!(absolute.0, "(1407542399.465000) can0 023#40FF\n(1407542399.215000) can0 023#\n");
        let relative = as_log(&format!("{}{lines}", head("***DEC***\n***RELATIVE MODE***\n")));
        assert_eq!(relative.0, "(1407542399.465000) can0 023#40FF\n(1407542399.715000) can0 023#\n");
    }

    #[test]
    fn broken_lines_are_named() {
        let (log, issues) = as_log(&format!(
            "{}23:59:59 Rx 1 0x023 s 0\n23:59:59:1 Px 1 0x023 s 0\n23:59:59:1 Rx 300 0x023 s 0\n23:59:59:1 Rx 1 0xG s 0\n\
             23:59:59:1 Rx 1 0x023 q 0\n23:59:59:1 Rx 1 0x800 s 0\n23:59:59:1 Rx 1 0x023 s 16\n23:59:59:1 Rx 1 0x023 s 2 11\n\
             23:59:59:1 Rx 1 0x023 s 1 11 22\n23:59:59:1 Rx 1 0x023 s 1 1",
            head("***HEX***\n***SYSTEM MODE***\n")
        ));
        assert_eq!((log.as_str(), issues.len()), ("", 10), "{issues:#?}");
        assert!(issues[0].contains("line 12: expected a line such as"), "{issues:#?}");
        assert!(issues[9].contains("line 21: the file ends inside a line"), "{issues:#?}");
    }
}
