//! A run as a picture: a file in the Chrome trace event format, which Perfetto (ui.perfetto.dev) and
//! chrome://tracing can show. There is a line for every interrupt, for masked windows, for sleep and
//! for each bus; FIFO fill levels are counters.

use std::collections::BTreeSet;
use std::io::{self, Write};

use cantap_can::Frame;
use serde_json::json;

use crate::Clock;
use crate::bus::{BusFrame, Member};

/// Lines of the picture that do not belong to an exception.
const MASKED: u32 = 1000;
const SLEEP: u32 = 1001;
const STALL: u32 = 1002;
const BUS: u32 = 1010;

#[derive(Clone, Copy, Debug)]
enum Entry {
    Span { line: u32, start: u64, end: u64 },
    Fifo { controller: usize, at: u64, fill: usize },
    Bus { wire: usize, frame: BusFrame },
}

/// What was recorded.
#[derive(Clone, Debug)]
pub struct Trace {
    clock: Clock,
    entries: Vec<Entry>,
    open: Vec<(u16, u64)>,
    fifo: [usize; 2],
    seen: [usize; 2],
}

impl Trace {
    /// An empty trace.
    pub(crate) fn new(clock: Clock) -> Self {
        Self { clock, entries: Vec::new(), open: Vec::new(), fifo: [0; 2], seen: [0; 2] }
    }

    /// Entries recorded so far.
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Whether nothing was recorded.
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    pub(crate) fn enter(&mut self, exception: u16, now: u64) {
        self.open.push((exception, now));
    }

    pub(crate) fn leave(&mut self, exception: u16, now: u64) {
        if let Some(position) = self.open.iter().rposition(|(open, _)| *open == exception) {
            let (_, start) = self.open.remove(position);
            self.entries.push(Entry::Span { line: exception.into(), start, end: now });
        }
    }

    pub(crate) fn masked(&mut self, start: u64, end: u64) {
        self.entries.push(Entry::Span { line: MASKED, start, end });
    }

    pub(crate) fn slept(&mut self, start: u64, end: u64) {
        // Every event of the emulation splits a sleep; the picture shows it in one piece.
        if let Some(Entry::Span { line: SLEEP, end: last, .. }) = self.entries.last_mut()
            && *last == start
        {
            *last = end;
            return;
        }
        self.entries.push(Entry::Span { line: SLEEP, start, end });
    }

    pub(crate) fn stalled(&mut self, start: u64, end: u64) {
        self.entries.push(Entry::Span { line: STALL, start, end });
    }

    pub(crate) fn fifo(&mut self, controller: usize, fill: usize, now: u64) {
        if self.fifo[controller] != fill {
            self.fifo[controller] = fill;
            self.entries.push(Entry::Fifo { controller, at: now, fill });
        }
    }

    /// Adds what is new in a bus's history.
    pub(crate) fn frames(&mut self, wire: usize, history: &[BusFrame]) {
        let seen = if self.seen[wire] <= history.len() { self.seen[wire] } else { 0 };
        self.entries.extend(history[seen..].iter().map(|frame| Entry::Bus { wire, frame: *frame }));
        self.seen[wire] = history.len();
    }

    /// Frames that were in the history before recording began are not part of the picture.
    pub(crate) fn skip(&mut self, wire: usize, history: &[BusFrame]) {
        self.seen[wire] = history.len();
    }

    /// Writes the file. `name_of` names an exception by its number.
    pub fn write(&self, out: &mut impl Write, name_of: impl Fn(u16) -> String) -> io::Result<()> {
        let clock = self.clock;
        let mut lines = BTreeSet::new();
        let mut comma = "";
        write!(out, "{{\"displayTimeUnit\":\"ns\",\"traceEvents\":[")?;
        for entry in &self.entries {
            let event = match *entry {
                Entry::Span { line, start, end } => {
                    lines.insert(line);
                    let name = line_name(line, &name_of);
                    span(clock, line, &name, start, end)
                }
                Entry::Fifo { controller, at, fill } => json!({
                    "ph": "C", "pid": 1, "ts": clock.to_us(at), "name": format!("CAN{} FIFO", controller + 1),
                    "args": { "frames": fill },
                }),
                Entry::Bus { wire, frame } => {
                    let line = BUS + wire as u32;
                    lines.insert(line);
                    bus_frame(clock, line, &frame)
                }
            };
            write!(out, "{comma}\n{event}")?;
            comma = ",";
        }
        for line in lines {
            let name = line_name(line, &name_of);
            let event = json!({
                "ph": "M", "pid": 1, "tid": line, "name": "thread_name", "args": { "name": name },
            });
            write!(out, "{comma}\n{event}")?;
            comma = ",";
        }
        writeln!(out, "\n]}}")
    }
}

fn span(clock: Clock, line: u32, name: &str, start: u64, end: u64) -> serde_json::Value {
    json!({
        "ph": "X", "pid": 1, "tid": line, "name": name, "ts": clock.to_us(start), "dur": clock.to_us(end - start),
    })
}

fn bus_frame(clock: Clock, line: u32, bus: &BusFrame) -> serde_json::Value {
    let frame: Frame = bus.frame;
    let sender = match bus.sender {
        Member::Controller(n) => format!("CAN{}", n + 1),
        Member::Node(n) => format!("node {n}"),
    };
    let mut event = span(clock, line, &frame.to_string(), bus.start, bus.end);
    event["args"] = json!({ "sender": sender, "error": bus.error.map(|kind| format!("{kind:?}")) });
    event
}

fn line_name(line: u32, name_of: &impl Fn(u16) -> String) -> String {
    match line {
        MASKED => "interrupts masked".to_owned(),
        SLEEP => "asleep".to_owned(),
        STALL => "flash busy".to_owned(),
        line if line >= BUS => format!("bus {}", line - BUS + 1),
        line => name_of(line as u16),
    }
}
