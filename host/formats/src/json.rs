//! Frames as JSON: an object for each, on lines or in an array, as scripts write them: `{"timestamp": 1.5, "id": "123", "data": "DEADBEEF"}`.
//!
//! The names are those of a table's columns. What they do not say is what a table does not say either. `cantap search --json` has frames as candump
//! writes them.

mod object;

use std::io;

use super::codec::Decode;
use super::found::Found;
use super::input::Input;
use super::issue::{Fault, Place};
use super::row_format::{Line, RowFormat as _};
use super::table::{self, Columns, TypedColumn, TypedForm};
use super::text::{self, NS_PER_S};
use super::zone::Zone;
use cantap_trace::{DeviceNs, Direction, TraceEvent, TraceFrame, TraceRecord};
use object::{Field, Kind, Next};

const NO_FRAMES: &str = "JSON objects that are no frames";
const TOPICS: &str = "words before an object, such as its topic or a time, are left out";
const EXPECTED: &str =
    "a JSON object with a frame, such as {\"timestamp\": 1.5, \"id\": \"123\", \"data\": \"DEADBEEF\"}";

/// Reads the objects.
#[derive(Default)]
pub(crate) struct Decoder {
    table: table::Decoder,
    columns: Vec<Column>,
    /// Whether the first objects were looked at.
    begun: bool,
    /// Whether an object was entered for the array in it.
    inside: bool,
    around: Around,
    /// WiCAN's last stamp, and the whole minutes before it.
    minute: Option<(i64, i64)>,
    notes: Vec<&'static str>,
    noted: Vec<&'static str>,
}

/// A name that frames have.
struct Column {
    name: String,
    form: TypedForm,
}

/// What an object says of all frames in its array, such as the time at which an adapter sent them on.
#[derive(Default)]
struct Around {
    fields: Vec<Field>,
    /// How many bytes of the object are still to come.
    rest: usize,
}

impl Around {
    /// Of the fields of an object of which so many bytes are left behind the beginning of its array.
    fn of(mut fields: Vec<Field>, rest: usize) -> Self {
        if is_of_wican(&fields)
            && let Some(stamp) = fields.iter_mut().find(|field| field.name == WICAN_STAMP)
        {
            WICAN_MS.clone_into(&mut stamp.name);
        }
        for field in &mut fields {
            if field.name == "type" && matches!(field.value.as_str(), "rx" | "tx") {
                "direction".clone_into(&mut field.name);
            }
        }
        fields.retain(|field| table::role_of_many(&field.name).is_some());
        Self { fields, rest }
    }

    /// The stamp of WiCAN's message, in milliseconds.
    fn wican_ms(&mut self) -> Option<(&mut Field, i64)> {
        let stamp = self.fields.iter_mut().find(|field| field.name == WICAN_MS)?;
        let ms = text::decimal(stamp.value.as_bytes()).and_then(|ms| i64::try_from(ms).ok())?;
        Some((stamp, ms))
    }

    /// Adds to a frame's own fields what they do not say.
    fn add_to(&self, fields: &mut Vec<Field>) {
        for field in &self.fields {
            let role = table::role_of_many(&field.name);
            if fields.iter().all(|own| table::role_of_many(&own.name) != role) {
                fields.push(field.clone());
            }
        }
    }

    /// Goes on by so many bytes.
    fn pass(&mut self, bytes: usize) {
        self.rest = self.rest.saturating_sub(bytes);
        if self.rest == 0 {
            self.fields.clear();
        }
    }
}

/// WiCAN's stamp, and how it is called where it is known to be in milliseconds.
const WICAN_STAMP: &str = "ts";
const WICAN_MS: &str = "ts_ms";

const MINUTE_MS: i64 = 60_000;

/// Whether an object is a message of WiCAN's: `{"bus":"0","type":"rx","ts":34610,"frame":[…`.
fn is_of_wican(fields: &[Field]) -> bool {
    /// Eleven days; what is more counts since 1970, in whatever unit.
    const MOST_MS: u64 = 1_000_000_000;
    let value = |name: &str| fields.iter().find(|field| field.name == name).map(|field| field.value.as_str());
    let stamp = value(WICAN_STAMP).and_then(|stamp| text::decimal(stamp.as_bytes()));
    value("bus").is_some()
        && matches!(value("type"), Some("rx" | "tx"))
        && stamp.is_some_and(|ms| ms < MOST_MS)
}

/// Whether a text begins with such frames.
pub(crate) fn is_head(head: &[u8]) -> bool {
    /// Enough for what a program says of itself before the frames.
    const OBJECTS: usize = 8;
    let start = head.trim_ascii_start();
    if !matches!(start.first(), Some(b'{' | b'[' | 0x1E)) && !object::begins_behind_topic(start) {
        return false;
    }
    let decoder = Decoder::default();
    let mut objects = objects(head).take(OBJECTS);
    objects.any(|fields| own_frame(&fields).is_some() || decoder.is_frame(&fields))
}

/// The objects of a text, up to one that is not whole.
fn objects(text: &[u8]) -> impl Iterator<Item = Vec<Field>> {
    let (mut at, mut inside) = (0, false);
    let mut around = Around::default();
    std::iter::from_fn(move || {
        loop {
            match object::next(&text[at..], inside) {
                Next::Object { start, end, inner } => {
                    let mut fields = object::fields(&text[at + start..at + end]);
                    let is_frame = |fields: &Vec<Field>| Decoder::default().is_frame(fields);
                    if let Some(inner) = inner.filter(|_| !fields.as_ref().is_some_and(is_frame)) {
                        around = Around::of(fields.clone().unwrap_or_default(), end - inner);
                        (at, inside) = (at + inner, true);
                    } else {
                        around.pass(start);
                        if let Some(fields) = &mut fields {
                            around.add_to(fields);
                        }
                        around.pass(end - start);
                        at += end;
                    }
                    if let Some(fields) = fields {
                        return Some(fields);
                    }
                }
                Next::Wrapper { inner } => (at, inside) = (at + inner, true),
                // An object of which only the beginning is there may have the frames in it.
                Next::More { start } => {
                    let inner = memchr::memmem::find(&text[at + start..], b"{")?;
                    let rest = &text[at + start + inner + 1..];
                    let array = rest.windows(2).position(|pair| pair[0] == b'[')?;
                    (at, inside) = (at + start + inner + 1 + array + 1, true);
                }
                Next::Other { .. } | Next::Broken { .. } | Next::End => return None,
            }
        }
    })
}

/// A frame that stands in one value, as candump writes it.
fn own_frame(fields: &[Field]) -> Option<TraceFrame> {
    let frame = fields.iter().find(|field| field.name == "frame" && field.kind == Kind::Text)?;
    frame.value.parse().ok()
}

/// Two times that are one: seconds, and what is left over of them.
const SPLIT_TIMES: [(&str, &str, usize); 6] = [
    ("ts_sec", "ts_usec", 6),
    ("tv_sec", "tv_usec", 6),
    ("sec", "usec", 6),
    ("secs", "nsecs", 9),
    ("sec", "nanosec", 9),
    ("sec", "nsec", 9),
];

/// Makes of what only JSON has what tables have.
fn tidy(fields: &mut Vec<Field>) {
    let at = |fields: &[Field], name: &str| {
        fields.iter().position(|field| field.kind == Kind::Number && field.name.eq_ignore_ascii_case(name))
    };
    for (seconds, rest, digits) in SPLIT_TIMES {
        if let (Some(whole), Some(rest)) = (at(fields, seconds), at(fields, rest)) {
            let fraction = format!(".{:0>digits$}", fields[rest].value);
            fields[whole].value.push_str(&fraction);
            "timestamp_s".clone_into(&mut fields[whole].name);
            fields.remove(rest);
            break;
        }
    }
    // A frame without bytes has no layer of data; one whose bytes another protocol took has a length that says so.
    let has = |fields: &[Field], name: &str| fields.iter().any(|field| field.name == name);
    for (id, data) in [("can.id", "data.data"), ("can_can_id", "data_data_data")] {
        if has(fields, id) && !has(fields, data) {
            fields.push(Field { name: data.to_owned(), value: String::new(), kind: Kind::Text });
        }
    }
    // The same time, in milliseconds alone.
    if fields.iter().any(|field| field.name == "frame_frame_time_epoch") {
        fields.retain(|field| field.name != "timestamp");
    }
    for field in fields.iter_mut() {
        let name = field.name.to_ascii_lowercase();
        if field.kind == Kind::Text && matches!(name.as_str(), "is_rx" | "isrx") {
            "direction".clone_into(&mut field.name);
            let direction = if field.value == "true" { "rx" } else { "tx" };
            direction.clone_into(&mut field.value);
        }
    }
}

impl Decoder {
    /// With the names that the user gave, if any.
    pub(crate) fn new(columns: Option<Columns>) -> Self {
        Self { table: table::Decoder::new(columns), ..Self::default() }
    }

    fn say(&mut self, note: &'static str) {
        if !self.noted.contains(&note) {
            self.noted.push(note);
            self.notes.push(note);
        }
    }

    fn is_frame(&self, fields: &[Field]) -> bool {
        let typed: Vec<_> =
            fields.iter().map(|field| TypedColumn { name: &field.name, form: TypedForm::Text }).collect();
        self.table.has_frame(&typed)
    }

    /// Goes on from minute to minute where WiCAN's stamps begin again. What was sent and what was received may come in another
    /// order than it was.
    fn enter(&mut self, mut around: Around) {
        const LATE_MS: i64 = 1000;
        if let Some((stamp, ms)) = around.wican_ms().filter(|(_, ms)| *ms < MINUTE_MS) {
            let (last_ms, whole_ms) = self.minute.unwrap_or((ms, 0));
            let whole_ms = if ms < last_ms - LATE_MS {
                whole_ms + MINUTE_MS
            } else if ms > last_ms + MINUTE_MS - LATE_MS && whole_ms > 0 {
                whole_ms - MINUTE_MS
            } else {
                whole_ms
            };
            self.minute = Some((ms, whole_ms));
            stamp.value = (whole_ms + ms).to_string();
        }
        self.around = around;
    }

    /// Takes names that came for the first time into the columns.
    fn learn(&mut self, fields: &[Field]) -> Result<bool, Fault> {
        let mut is_new = false;
        for field in fields.iter().filter(|field| field.kind != Kind::Nothing) {
            if self.columns.iter().all(|column| column.name != field.name) {
                let form = match field.kind {
                    Kind::Number => TypedForm::Number,
                    Kind::Bytes => TypedForm::Bytes,
                    Kind::Text | Kind::Nothing => TypedForm::Text,
                };
                self.columns.push(Column { name: field.name.clone(), form });
                is_new = true;
            }
        }
        if is_new {
            let typed: Vec<_> = self
                .columns
                .iter()
                .map(|column| TypedColumn { name: &column.name, form: column.form })
                .collect();
            self.table.begin_typed(&typed)?;
        }
        Ok(is_new)
    }

    /// A cell for each column.
    fn cells(&self, fields: &[Field]) -> Vec<String> {
        let cell = |column: &Column| {
            let Some(field) = fields.iter().find(|field| field.name == column.name) else {
                return String::new();
            };
            match (column.form, field.kind) {
                // An identifier that is sometimes a number and mostly a text of hexadecimal digits.
                (TypedForm::Text, Kind::Number) if text::decimal(field.value.as_bytes()).is_some() => field
                    .value
                    .parse::<u64>()
                    .map_or_else(|_| field.value.clone(), |number| format!("0x{number:X}")),
                _ => field.value.clone(),
            }
        };
        self.columns.iter().map(cell).collect()
    }

    /// Learns the columns from the frames at the beginning.
    fn begin(&mut self, head: &[u8]) -> Result<(), Fault> {
        const OBJECTS: usize = 200;
        let first: Vec<_> = objects(head)
            .take(OBJECTS)
            .map(|mut fields| {
                tidy(&mut fields);
                fields
            })
            .filter(|fields| self.is_frame(fields))
            .collect();
        for fields in &first {
            self.learn(fields)?;
        }
        let rows: Vec<_> = first.iter().map(|fields| self.cells(fields)).collect();
        let rows: Vec<Vec<&[u8]>> =
            rows.iter().map(|cells| cells.iter().map(String::as_bytes).collect()).collect();
        if !rows.is_empty() {
            self.table.first_typed_rows(rows.iter().map(Vec::as_slice));
        }
        Ok(())
    }

    /// What an object is.
    fn object(&mut self, mut fields: Vec<Field>, zone: &Zone) -> Result<Line, Fault> {
        if let Some(frame) = own_frame(&fields) {
            return own_record(&fields, frame, zone).map(Line::Record);
        }
        tidy(&mut fields);
        if !self.is_frame(&fields) {
            return Ok(Line::LeftOut(NO_FRAMES));
        }
        let is_first = self.learn(&fields)? && self.columns.len() == fields.len();
        let cells = self.cells(&fields);
        let row: Vec<&[u8]> = cells.iter().map(String::as_bytes).collect();
        if is_first {
            self.table.first_typed_rows(std::iter::once(row.as_slice()));
        }
        self.table.typed_row(&row, zone)
    }
}

/// A line of `cantap search --json`.
fn own_record(fields: &[Field], frame: TraceFrame, zone: &Zone) -> Result<TraceRecord, Fault> {
    let value = |name: &str| {
        fields.iter().find(|field| field.name == name).map(|field| field.value.as_bytes()).unwrap_or_default()
    };
    let time = value("time_s");
    let time_ns = text::time(time, NS_PER_S, b'.').or_else(|| table::date(time, zone));
    let time_ns = time_ns.ok_or_else(|| Fault::malformed("a time in seconds, time_s", time))?;
    let channel = text::decimal(value("channel")).unwrap_or(1);
    let channel =
        u8::try_from(channel).map_err(|_| Fault::malformed("a channel of 0 to 255", value("channel")))?;
    let device_ns = text::decimal(value("device_ns")).and_then(DeviceNs::new);
    let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
    Ok(TraceRecord { time_ns, device_ns, channel, event })
}

impl Decode for Decoder {
    fn needs_one_line(&self) -> bool {
        false
    }

    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        if let Some(note) = self.notes.pop() {
            return Ok(Found::Note(note));
        }
        let zone = input.zone().clone();
        loop {
            let buffered = input.buffered();
            if !buffered.is_empty() && !std::mem::replace(&mut self.begun, true) {
                let head = buffered.to_vec();
                if let Err(fault) = self.begin(&head) {
                    let rest = head.len();
                    input.consume_lines(rest, lines_in(&head));
                    return Ok(Found::Issue(Place::Line(1), fault));
                }
            }
            let text = input.buffered();
            let was_inside = self.inside;
            let (skipped, used, found) = match object::next(text, self.inside) {
                Next::Object { start, end, inner } => {
                    let fields = object::fields(&text[start..end]);
                    match fields {
                        Some(mut fields) => {
                            let enters =
                                inner.filter(|_| own_frame(&fields).is_none() && !self.is_frame(&fields));
                            self.inside |= enters.is_some();
                            let used = enters.unwrap_or(end);
                            let line = if let Some(inner) = enters {
                                self.enter(Around::of(fields, end - inner));
                                Ok(Line::Nothing)
                            } else {
                                self.around.pass(start);
                                self.around.add_to(&mut fields);
                                self.around.pass(end - start);
                                self.object(fields, &zone)
                            };
                            (start, used, Some(line))
                        }
                        None => (start, end, Some(Err(Fault::malformed(EXPECTED, shown(&text[start..end]))))),
                    }
                }
                Next::Wrapper { inner } => {
                    self.inside = true;
                    (0, inner, None)
                }
                Next::Other { start, end } | Next::Broken { start, end } => {
                    (start, end, Some(Err(Fault::malformed(EXPECTED, shown(&text[start..end])))))
                }
                Next::More { start } => {
                    let len = text.len();
                    if input.peek(len + 1)?.len() > len {
                        continue;
                    }
                    let rest = input.buffered()[start..].to_vec();
                    let place = Place::Line(input.line_number() + 1 + lines_in(&input.buffered()[..start]));
                    let all = input.buffered().to_vec();
                    input.consume_lines(all.len(), lines_in(&all));
                    let fault = match rest.first() {
                        _ if self.inside && rest.first() != Some(&b'{') => return Ok(Found::End),
                        Some(b'{') => Fault::Truncated("an object"),
                        _ => Fault::malformed(EXPECTED, shown(&rest)),
                    };
                    return Ok(Found::Issue(place, fault));
                }
                Next::End => {
                    let all = text.to_vec();
                    input.consume_lines(all.len(), lines_in(&all));
                    if input.peek(1)?.is_empty() {
                        return Ok(Found::End);
                    }
                    continue;
                }
            };
            let line = input.line_number() + 1 + lines_in(&text[..skipped]);
            if !was_inside
                && matches!(found, Some(Ok(_)))
                && text[..skipped].iter().any(u8::is_ascii_alphanumeric)
            {
                self.say(TOPICS);
            }
            let lines = lines_in(&text[..used]);
            input.consume_lines(used, lines);
            while let Some(note) = self.table.note() {
                self.say(note);
            }
            match found {
                None | Some(Ok(Line::Nothing | Line::Two(..))) => {}
                Some(Ok(Line::Record(record))) => return Ok(Found::Record(record)),
                Some(Ok(Line::LeftOut(what))) => return Ok(Found::LeftOut(what)),
                Some(Err(fault)) => return Ok(Found::Issue(Place::Line(line), fault)),
            }
        }
    }
}

fn lines_in(text: &[u8]) -> u64 {
    memchr::memchr_iter(b'\n', text).count() as u64
}

fn shown(text: &[u8]) -> &[u8] {
    const SHOWN: usize = 200;
    &text[..text.len().min(SHOWN)]
}

#[cfg(test)]
mod tests;
