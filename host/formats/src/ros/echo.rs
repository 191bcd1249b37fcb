//! CAN frames as `rostopic echo` and `ros2 topic echo` print them: a field on each line, `---` behind each message.

use super::{Kind, Message, OTHER_MESSAGES, time_ns};
use crate::error_frames::ErrorFrames;
use crate::issue::Fault;
use crate::row_format::{Line, RowFormat};
use crate::text;
use crate::zone::Zone;
use cantap_trace::counted;
use cantap_trace::fd::FD_MAX_BYTES;
use cantap_trace::{Direction, TraceRecord};

const NO_TIMES: &str = "messages without a time stand at the last one that was, or at 0";

/// Reads what was printed.
#[derive(Default)]
pub(crate) struct Decoder {
    fields: Fields,
    time_ns: i64,
    errors: ErrorFrames,
    notes: Vec<&'static str>,
    noted_times: bool,
}

/// The fields of the message that is being read.
#[derive(Default)]
struct Fields {
    /// A message has begun.
    begun: bool,
    /// A line of it could not be read, which was reported.
    broken: bool,
    seconds: Option<i64>,
    ns: Option<u32>,
    id: Option<u32>,
    extended: Option<bool>,
    remote: bool,
    error: bool,
    kind: Option<Kind>,
    len: u8,
    data: Option<Vec<u8>>,
    /// The lines that follow are the elements of `data`.
    in_data: bool,
}

/// Whether a text begins so.
pub(crate) fn is_head(text: &[u8]) -> bool {
    let has = |name: &[u8]| {
        let mut lines = text.split(|byte| *byte == b'\n');
        lines.any(|line| line.starts_with(name))
    };
    has(b"id: ") && has(b"is_extended: ")
}

/// `true` or `True`.
fn yes(value: &[u8]) -> Result<bool, Fault> {
    match value {
        b"True" | b"true" => Ok(true),
        b"False" | b"false" => Ok(false),
        other => Err(Fault::malformed("true or false", other)),
    }
}

fn number<N: TryFrom<u64>>(value: &[u8]) -> Result<N, Fault> {
    let number = text::decimal(value).and_then(|number| N::try_from(number).ok());
    number.ok_or_else(|| Fault::malformed("a number in decimal digits", value))
}

/// The bytes of a list in brackets.
fn list(value: &[u8]) -> Result<Vec<u8>, Fault> {
    let inner = value.strip_prefix(b"[").and_then(|value| value.strip_suffix(b"]"));
    let inner = inner.ok_or_else(|| Fault::malformed("the bytes in brackets", value))?;
    let words = inner.split(|byte| *byte == b',').map(<[u8]>::trim_ascii).filter(|word| !word.is_empty());
    words.map(number).collect()
}

impl Fields {
    fn take(&mut self, line: &[u8]) -> Result<(), Fault> {
        self.begun = true;
        if let (true, Some(element)) = (self.in_data, line.strip_prefix(b"- ")) {
            let data = self.data.get_or_insert_default();
            data.push(number(element)?);
            return match data.len() {
                0..=FD_MAX_BYTES => Ok(()),
                _ => Err(Fault::malformed("up to 64 data bytes", line)),
            };
        }
        self.in_data = false;
        let Some(colon) = memchr::memchr(b':', line) else { return Ok(()) };
        let (name, value) = (&line[..colon], line[colon + 1..].trim_ascii());
        match name {
            b"secs" | b"sec" => self.seconds = Some(number(value)?),
            b"nsecs" | b"nanosec" => self.ns = Some(number(value)?),
            b"id" => self.id = Some(number(value)?),
            b"is_rtr" => self.remote = yes(value)?,
            b"is_extended" => self.extended = Some(yes(value)?),
            b"is_error" => self.error = yes(value)?,
            b"dlc" => (self.kind, self.len) = (Some(Kind::Frame), number(value)?),
            b"len" => (self.kind, self.len) = (Some(Kind::FdFrame), number(value)?),
            b"data" if value.is_empty() => (self.data, self.in_data) = (Some(Vec::new()), true),
            // That of another type may be anything.
            b"data" if self.id.is_some() => self.data = Some(list(value)?),
            _ => {}
        }
        Ok(())
    }
}

impl Decoder {
    /// The message that has ended.
    fn message(&mut self) -> Result<Line, Fault> {
        let fields = std::mem::take(&mut self.fields);
        if !fields.begun || fields.broken {
            return Ok(Line::Nothing);
        }
        let (Some(id), Some(extended)) = (fields.id, fields.extended) else {
            return Ok(Line::LeftOut(OTHER_MESSAGES));
        };
        let (Some(data), Some(kind)) = (fields.data, fields.kind) else {
            return Err(Fault::malformed("dlc or len, and data, in a message with a frame", b"---"));
        };
        let is_fd = kind == Kind::FdFrame;
        if !is_fd && !fields.error && data.len() < usize::from(fields.len.min(8)) {
            let found = counted(data.len(), "byte");
            return Err(Fault::malformed(format!("{} data bytes", fields.len), found.as_bytes()));
        }
        let message = Message {
            time_ns: time_ns(fields.seconds.unwrap_or(0), fields.ns.unwrap_or(0)),
            id,
            remote: fields.remote,
            extended,
            error: fields.error,
            len: fields.len,
            data: &data,
            is_fd,
        };
        // Which topic it is was said to the program, and not in its text.
        let content = message.content(Direction::Rx, &mut self.errors)?;
        match content.time_ns {
            Some(time_ns) => self.time_ns = time_ns,
            None if !std::mem::replace(&mut self.noted_times, true) => self.notes.push(NO_TIMES),
            None => {}
        }
        let record = TraceRecord { time_ns: self.time_ns, device_ns: None, channel: 1, event: content.event };
        Ok(match content.second {
            Some(second) => Line::Two(record, second),
            None => Line::Record(record),
        })
    }
}

impl RowFormat for Decoder {
    fn line(&mut self, line: &[u8], _zone: &Zone) -> Result<Line, Fault> {
        if line == b"---" {
            return self.message();
        }
        if line.is_empty() || line.starts_with(b"#") {
            return Ok(Line::Nothing);
        }
        let taken = self.fields.take(line);
        self.fields.broken |= taken.is_err();
        taken.map(|()| Line::Nothing)
    }

    fn may_be_cut(&self, _line: &[u8], _record: &TraceRecord) -> bool {
        false
    }

    fn note(&mut self) -> Option<&'static str> {
        self.notes.pop().or_else(|| self.errors.note())
    }

    fn missing(&self) -> Option<&'static str> {
        self.fields.begun.then_some("'---' behind the last message")
    }
}

#[cfg(test)]
mod tests {
    use crate::{Format, tests};
    use proptest::prelude::*;

    #[test]
    fn messages_of_both_generations_are_read() {
        let one = "header: \n  seq: 10450\n  stamp: \n    secs: 1520743044\n    nsecs:   8934087\n  frame_id: ''\nid: 304\nis_rtr: False\n\
                   is_extended: False\nis_error: False\ndlc: 3\ndata: [0, 10, 255, 92, 110, 16, 4, 36]\n---\n";
        let two = "header:\n  stamp:\n    sec: 1520743045\n    nanosec: 8934087\n  frame_id: can\nid: 418382848\nis_rtr: false\n\
                   is_extended: true\nis_error: false\ndlc: 2\ndata:\n- 17\n- 34\n- 0\n- 0\n- 0\n- 0\n- 0\n- 0\n---\n";
        let fd = "header:\n  stamp:\n    sec: 1520743046\n    nanosec: 0\n  frame_id: can\nid: 1\nis_extended: false\n\
                  is_error: false\nlen: 12\ndata:\n- 0\n- 1\n- 2\n- 3\n- 4\n- 5\n- 6\n- 7\n- 8\n- 9\n- 10\n- 11\n---\n";
        let other = "data: Hello\n---\n";
        let file = [one, two, fd, other].concat();
        assert_eq!(Format::of_content(file.as_bytes()), Some(Format::RosEcho));
        let (log, issues) = tests::as_log(Format::RosEcho, &file);
        assert_eq!(
            log,
            "(1520743044.008934) can0 130#000AFF\n(1520743045.008934) can0 18F00400#1122\n\
             (1520743046.000000) can0 001##0000102030405060708090A0B\n"
        );
        assert_eq!(issues, Vec::<String>::new());
        // What is cut off is no frame.
        let (log, issues) = tests::as_log(Format::RosEcho, &file[..one.len() + two.len() - 9]);
        assert_eq!((log.lines().count(), issues.len()), (1, 1), "{issues:?}");
    }

    #[test]
    fn broken_messages_are_named() {
        let good = "id: 304\nis_rtr: False\nis_extended: False\nis_error: False\ndlc: 1\ndata: [1, 2, 3, 4, 5, 6, 7, 8]\n---\n";
        for (from, to) in [
            ("304", "4096"),
            ("304", "x"),
            ("[1, 2", "[1, 256"),
            ("dlc: 1", "dlc: 16"),
            ("8]", "8"),
            ("False\ndlc", "no\ndlc"),
            ("dlc: 1\n", ""),
            ("dlc: 1\ndata: [1, 2, 3, 4, 5, 6, 7, 8]", "dlc: 3\ndata: [1]"),
        ] {
            let (log, issues) =
                tests::as_log(Format::RosEcho, format!("{}{good}", good.replacen(from, to, 1)));
            assert_eq!(
                (log.as_str(), issues.is_empty()),
                ("(0.000000) can0 130#01\n", false),
                "{to}: {issues:?}"
            );
        }
    }

    proptest! {
        #[test]
        fn no_text_ends_the_reader(text in "((id|dlc|len|data|is_extended|secs|---|-|\\[)[: ]?[0-9TruealsF,\\[\\]]{0,9}\n){0,20}") {
            let _ = Format::of_content(text.as_bytes());
            tests::read(Format::RosEcho, &text);
        }
    }
}
