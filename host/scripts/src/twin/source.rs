//! Writes a model as scripts.

use std::fmt::Write as _;

use cantap_can::{Frame, Id};
use cantap_trace::clean;
use cantap_trace::counted;

use super::checksums::{Algorithm, Checksum, Part};
use super::counters::{Counter, Field};
use super::exchanges::{Answer, Exchange};
use super::model::{Model, Stream, Timing};
use super::role::Role;
use super::timing::Period;
use crate::checksum;

/// A period is written as a rounder one that is within this share of it, which is less than quartz crystals differ.
const ROUNDER: f64 = 100e-6;
/// Jitter below this, in nanoseconds, comes from other frames on the bus.
const NO_JITTER_NS: f64 = 200_000.0;
/// Frames of a channel that a device repeats by itself; some of its 32 slots are left to whoever edits the script.
const REPEATED: usize = 24;
/// A list takes at least this long before it begins again: one without any time would never end.
const SHORTEST_NS: u64 = 100_000_000;
/// The most characters of a line of a list.
const LINE: usize = 120;

/// The name of a channel's message in a database, if it has one.
pub type Names<'a> = &'a dyn Fn(u8, Id) -> Option<String>;

/// Sends recorded frames; both scripts have it.
const REPLAY: &str = "\
// Sends the next frame of a list after its delay, and so on.
fn replay(channel, list) {
    let step = list.next();
    after(step[0], || {
        send(channel, step[1]);
        replay(channel, list);
    });
}
";

const ANSWER: &str = "\
// Answers a request as recorded: by it and the one before, or else by it alone; several answers in turn.
fn answer(channel, answers, before, request) {
    let both = `${before} ${request}`;
    let key = if both in answers { both } else { request };
    if key in answers {
        answer_from(channel, answers[key].next(), 0);
    }
}

// Sends the frames of an answer from one on, each after its delay.
fn answer_from(channel, frames, at) {
    if at < frames.len() {
        after(frames[at][0], || {
            send(channel, frames[at][1]);
            answer_from(channel, frames, at + 1);
        });
    }
}
";

impl Model {
    /// The script of everything that sends by itself or answers. `title` says what it was learnt from.
    pub fn twin(&self, title: &str, names: Names<'_>) -> String {
        let mut out = String::new();
        heading(&mut out, "A twin", title, self);
        if self.omitted.0 > 0 {
            let (identifiers, frames) = self.omitted;
            line(
                &mut out,
                &format!(
                    "// Left out, because there are too many: {identifiers} with {frames}.",
                    identifiers = counted(identifiers, "identifier"),
                    frames = counted(frames, "frame")
                ),
            );
        }
        let senders = || self.streams.iter().filter(|stream| stream.role == Role::Sender);
        if senders().any(|stream| matches!(stream.timing, Timing::Recorded(_))) {
            let _ = write!(out, "\n{REPLAY}");
        }
        if !self.exchanges.is_empty() {
            let _ = write!(out, "\n{ANSWER}");
        }
        let mut slots = [REPEATED; 2];
        for stream in senders() {
            self.sender(&mut out, stream, &mut slots[usize::from(stream.key.channel == 2)], names);
        }
        for exchange in &self.exchanges {
            answers(&mut out, exchange, names);
        }
        out
    }

    /// The script of everything that asks, if anything does.
    pub fn tester(&self, title: &str, names: Names<'_>) -> Option<String> {
        if self.exchanges.is_empty() {
            return None;
        }
        let mut out = String::new();
        heading(&mut out, "The tester of a twin", title, self);
        let _ = write!(out, "\n{REPLAY}");
        for exchange in &self.exchanges {
            let _ = write!(
                out,
                "\n// {} by {}.\n",
                counted(exchange.asked.len(), "request"),
                named(exchange.channel, &exchange.requests, names)
            );
            let asked = &exchange.asked;
            recorded(&mut out, exchange.channel, asked, asked.len(), self.duration_ns);
        }
        Some(out)
    }

    fn sender(&self, out: &mut String, stream: &Stream, slots: &mut usize, names: Names<'_>) {
        let Stream { key, frames, timing, .. } = stream;
        let what = if key.remote { "remote frames" } else { "frames" };
        let how = match timing {
            Timing::Periodic { period, .. } => {
                let jitter = duration(period.jitter_ns);
                format!("every {}, with a standard deviation of {jitter}", duration(rounder(period.mean_ns)))
            }
            Timing::Recorded(list) if list.len() < *frames => {
                format!("not periodic; the first {} as recorded", list.len())
            }
            Timing::Recorded(_) => "not periodic; as recorded".to_owned(),
        };
        let _ = write!(out, "\n// {}: {frames} {what}, {how}.\n", named(key.channel, &[key.id], names));
        match timing {
            Timing::Recorded(list) => recorded(out, key.channel, list, *frames, self.duration_ns),
            Timing::Periodic { period, until_ns } => periodic(out, stream, *period, *until_ns, slots),
        }
    }
}

fn heading(out: &mut String, what: &str, title: &str, model: &Model) {
    line(
        out,
        &format!(
            "// {what} of {}: plays what was on its buses in {}.",
            clean::line(title),
            duration(model.duration_ns as f64)
        ),
    );
    line(
        out,
        "// Written by `cantap twin`; edit it, and play it with `cantap run`. Its functions are in docs/scripts.md.",
    );
}

fn line(out: &mut String, text: &str) {
    out.push_str(text);
    out.push('\n');
}

/// Identifiers with their channel and their names.
fn named(channel: u8, ids: &[Id], names: Names<'_>) -> String {
    let one = |id: &Id| match names(channel, *id) {
        Some(name) => format!("{id} ({})", clean::line(&name)),
        None => id.to_string(),
    };
    format!("channel {channel}, {}", ids.iter().map(one).collect::<Vec<_>>().join(", "))
}

/// A list of a delay and a frame each, of so many frames in the trace; from the beginning again after the trace's length.
fn recorded(out: &mut String, channel: u8, list: &[(u64, Frame)], frames: usize, duration_ns: u64) {
    let Some(((first_ns, first), rest)) = list.split_first() else { return };
    let last_ns: u64 = list.iter().map(|(delay_ns, _)| delay_ns).sum();
    // A list that was cut off does not wait for the end of the trace.
    let again_ns = if list.len() < frames {
        (last_ns - first_ns) / list.len() as u64
    } else {
        duration_ns.saturating_sub(last_ns) + first_ns
    };
    let mut steps: Vec<String> = rest.iter().map(step).collect();
    let whole_ns = (again_ns + last_ns - first_ns).max(SHORTEST_NS);
    let again_ns = again_ns.max(whole_ns - (last_ns - first_ns));
    steps.push(step(&(again_ns, *first)));
    let _ = writeln!(out, "after(\"{}\", || {{", duration(*first_ns as f64));
    let _ = writeln!(out, "    send({channel}, \"{first}\");");
    let _ = writeln!(out, "    replay({channel}, steps([\n{}    ]));\n}});", list_of(&steps, 8));
}

/// A delay and the frame after it.
fn step((delay_ns, frame): &(u64, Frame)) -> String {
    format!("[\"{}\", \"{frame}\"]", duration(*delay_ns as f64))
}

/// Texts with commas, some to a line.
fn list_of(texts: &[String], indent: usize) -> String {
    let mut out = String::new();
    let mut row = String::new();
    for text in texts {
        if !row.is_empty() && indent + row.len() + text.len() + 2 > LINE {
            let _ = writeln!(out, "{:indent$}{}", "", row.trim_end());
            row.clear();
        }
        let _ = write!(row, "{text}, ");
    }
    let _ = writeln!(out, "{:indent$}{}", "", row.trim_end());
    out
}

fn periodic(out: &mut String, stream: &Stream, period: Period, until_ns: Option<u64>, slots: &mut usize) {
    let Stream { key, first_ns, content, .. } = stream;
    let (channel, id) = (key.channel, key.id);
    let every = duration(rounder(period.mean_ns));
    let first = duration(*first_ns as f64);
    let has_jitter = period.jitter_ns > NO_JITTER_NS;
    let is_constant = content.steps.len() == 1 && content.counters.is_empty() && content.checksum.is_none();
    let until = until_ns.map(|until_ns| duration(until_ns.saturating_sub(*first_ns) as f64));
    if let [(frame, _)] = &content.steps[..]
        && is_constant
        && !has_jitter
        && *slots > 0
    {
        *slots -= 1;
        let start = format!("periodic({channel}, frame(\"{frame}\"), \"{every}\")");
        match until {
            None => line(out, &format!("after(\"{first}\", || {start});")),
            Some(until) => line(
                out,
                &format!(
                    "after(\"{first}\", || {{\n    let repeated = {start};\n    after(\"{until}\", || stop(repeated));\n}});"
                ),
            ),
        }
        return;
    }
    line(out, "{");
    let as_frames = key.remote || content.steps.iter().any(|(frame, _)| frame.dlc() > 8);
    let text = |(frame, times): &(Frame, u32)| {
        let data = data_text(frame);
        if *times == 1 { format!("\"{data}\"") } else { format!("\"{data}*{times}\"") }
    };
    if content.steps.len() < content.all_steps {
        let _ = writeln!(
            out,
            "    // {} of {}, in rows from all over the trace.",
            content.steps.len(),
            counted(content.all_steps, "step")
        );
    }
    if as_frames {
        // One at a time: such frames are written as a whole.
        let all = content.steps.iter().map(|(frame, _)| format!("\"{frame}\"")).collect::<Vec<_>>();
        let _ = write!(out, "    let frames = steps([\n{}    ]);\n", list_of(&all, 8));
    } else {
        let all: Vec<String> = content.steps.iter().map(text).collect();
        let _ = write!(out, "    let payloads = payloads([\n{}    ]);\n", list_of(&all, 8));
    }
    let name = |at: usize| if at == 0 { "counter".to_owned() } else { format!("counter{}", at + 1) };
    for (at, begin) in content.begin.iter().enumerate() {
        let _ = writeln!(out, "    let {} = {begin};", name(at));
    }
    if let Some(checksum) = content.checksum.as_ref().filter(|checksum| checksum.constants.len() > 1) {
        let all: Vec<String> =
            checksum.constants.iter().map(|constant| format!("0x{constant:02X}")).collect();
        let _ = writeln!(out, "    let constants = [{}];", all.join(", "));
    }
    line(out, "    let play = || {");
    if as_frames {
        let _ = writeln!(out, "        send({channel}, frames.next());");
    } else {
        line(out, "        let data = payloads.next();");
        for (at, counter) in content.counters.iter().enumerate() {
            put_counter(out, counter, &name(at));
        }
        if let Some(checksum) = &content.checksum {
            let place = content.counters.first().map(|counter| match counter.first {
                0 => "counter".to_owned(),
                first => format!("counter - {first}"),
            });
            let len = content.lengths.first().copied().unwrap_or(1).max(1);
            put_checksum(out, checksum, len, place.as_deref());
        }
        for (at, counter) in content.counters.iter().enumerate() {
            count(out, counter, &name(at));
        }
        let _ = writeln!(out, "        send({channel}, frame(\"{id}\", data));");
    }
    line(out, "    };");
    let start = if has_jitter {
        // Two calls that are each late by up to this have an interval with that deviation.
        let late = duration((period.jitter_ns * 6_f64.sqrt()).min(0.9 * period.mean_ns));
        format!("every(\"{every}\", \"{late}\", play)")
    } else {
        format!("every(\"{every}\", play)")
    };
    let _ = writeln!(out, "    after(\"{first}\", || {{\n        play.call();");
    match until {
        None => {
            let _ = writeln!(out, "        {start};");
        }
        Some(until) => {
            let _ =
                writeln!(out, "        let timer = {start};\n        after(\"{until}\", || stop(timer));");
        }
    }
    line(out, "    });\n}");
}

fn data_text(frame: &Frame) -> String {
    frame.data().iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02X}");
        text
    })
}

/// Puts a counter's value into the data, where its bits are zero.
fn put_counter(out: &mut String, counter: &Counter, name: &str) {
    let _ = match counter.field {
        Field::Bits { byte, low: 0, width: 8 } => writeln!(out, "        data[{byte}] = {name};"),
        Field::Bits { byte, low: 0, .. } => writeln!(out, "        data[{byte}] = data[{byte}] | {name};"),
        Field::Bits { byte, low, .. } => {
            writeln!(out, "        data[{byte}] = data[{byte}] | ({name} << {low});")
        }
        Field::Big { byte } => {
            writeln!(out, "        data[{byte}] = {name} >> 8;\n        data[{}] = {name} & 0xFF;", byte + 1)
        }
        Field::Little { byte } => {
            writeln!(out, "        data[{byte}] = {name} & 0xFF;\n        data[{}] = {name} >> 8;", byte + 1)
        }
    };
}

/// The counter's next value.
fn count(out: &mut String, counter: &Counter, name: &str) {
    let Counter { first, modulus, step, .. } = counter;
    let _ = match first {
        0 => writeln!(out, "        {name} = ({name} + {step}) % {modulus};"),
        // Its values are not less than its first one.
        _ => writeln!(out, "        {name} = {first} + ({name} - {first} + {step}) % {modulus};"),
    };
}

/// Puts the checksum into the data, where its bits are zero.
fn put_checksum(out: &mut String, checksum: &Checksum, len: usize, place: Option<&str>) {
    let Checksum { byte, part, algorithm, constants } = checksum;
    let (constant, single) = match (&constants[..], place) {
        ([constant], _) | ([constant, ..], None) => (format!("0x{constant:02X}"), Some(*constant)),
        ([_, _, ..], Some(place)) => (format!("constants[{place}]"), None),
        ([], _) => ("0".to_owned(), Some(0)),
    };
    let over = if *part == Part::Byte { format!("without(data, {byte})") } else { "data".to_owned() };
    let exclusive_or = |sum: String| if single == Some(0) { sum } else { format!("{sum} ^ {constant}") };
    let value = match algorithm {
        Algorithm::Xor => exclusive_or(format!("xor8({over})")),
        Algorithm::Crc { polynomial, reflected, followed } => {
            let function = if *reflected { "crc8_reflected" } else { "crc8" };
            let over = if *followed { format!("{over} + bytes(\"00\")") } else { over };
            let others = len - 1 + usize::from(*followed);
            let (start, xor_out) = start_and_end(*polynomial, *reflected, single.unwrap_or_default(), others);
            match single {
                Some(_) if start == 0 && xor_out == 0 => format!("{function}({over}, 0x{polynomial:02X})"),
                Some(_) => format!("{function}({over}, 0x{polynomial:02X}, 0x{start:02X}, 0x{xor_out:02X})"),
                None => format!("{function}({over}, 0x{polynomial:02X}) ^ {constant}"),
            }
        }
        Algorithm::Sum if single == Some(0) => format!("sum8({over})"),
        Algorithm::Sum => format!("sum8({over}) + {constant}"),
        Algorithm::NegatedSum => format!("{constant} - sum8({over})"),
        Algorithm::NibbleSum => format!("nibble_sum({over}) + {constant}"),
        Algorithm::NegatedNibbleSum => format!("{constant} - nibble_sum({over})"),
        Algorithm::ByCounter => constant,
    };
    let _ = match part {
        Part::Byte => writeln!(out, "        data[{byte}] = ({value}) & 0xFF;"),
        Part::Low => writeln!(out, "        data[{byte}] = data[{byte}] | (({value}) & 0x0F);"),
        Part::High => writeln!(out, "        data[{byte}] = data[{byte}] | ((({value}) & 0x0F) << 4);"),
    };
}

/// A CRC's constant as start and final exclusive or: with a start of FF if the rest is then 00 or FF, as in most standards.
fn start_and_end(polynomial: u8, reflected: bool, constant: u8, others: usize) -> (u8, u8) {
    let zeros = vec![0; others];
    let of_start = if reflected {
        checksum::crc8_reflected(zeros, polynomial, 0xFF, 0)
    } else {
        checksum::crc8(zeros, polynomial, 0xFF, 0)
    };
    let rest = constant ^ of_start;
    if constant != 0 && matches!(rest, 0 | 0xFF) { (0xFF, rest) } else { (0, constant) }
}

/// Who answers whom.
fn answers(out: &mut String, exchange: &Exchange, names: Names<'_>) {
    let Exchange { channel, requests, answers, table, .. } = exchange;
    let who = named(*channel, answers, names);
    let whom = named(*channel, requests, names);
    let _ = write!(out, "\n// {who} answer {whom}.\n{{\n");
    let variant = |answer: &Answer| format!("[{}]", answer.iter().map(step).collect::<Vec<_>>().join(", "));
    line(out, "    let answers = #{");
    for ((before, request), variants) in table {
        let key = before.as_ref().map_or_else(|| request.clone(), |before| format!("{before} {request}"));
        let all: Vec<String> = variants.iter().map(variant).collect();
        let _ = write!(out, "        \"{key}\": steps([\n{}        ]),\n", list_of(&all, 12));
    }
    line(out, "    };\n    let before = \"\";");
    for id in requests {
        let _ =
            writeln!(out, "    on_frame(\"{id}\", |request| {{\n        if request.channel == {channel} {{");
        let _ = writeln!(out, "            answer({channel}, answers, before, request.to_string());");
        line(out, "            before = request.to_string();\n        }\n    });");
    }
    line(out, "}");
}

/// A time in nanoseconds as scripts have it, to a nanosecond.
fn duration(ns: f64) -> String {
    let ns = ns.round().max(0.0);
    let (unit, ns_each) = match ns {
        1e9.. => ("s", 1e9),
        1e6.. => ("ms", 1e6),
        1e3.. => ("us", 1e3),
        _ => ("ns", 1.0),
    };
    // A decimal fraction of whole nanoseconds.
    let text = format!("{:.9}", ns / ns_each);
    format!("{}{unit}", text.trim_end_matches('0').trim_end_matches('.'))
}

/// The roundest number of nanoseconds that is nearly the same.
fn rounder(ns: f64) -> f64 {
    let units = [1e9, 1e8, 1e7, 5e6, 1e6, 5e5, 1e5, 1e4, 1e3, 1e2, 1e1];
    let rounded = units.map(|unit| (ns / unit).round() * unit);
    rounded
        .into_iter()
        .find(|each| *each > 0.0 && (each - ns).abs() <= ROUNDER * ns)
        .unwrap_or(ns)
        .max(1_000.0)
}
