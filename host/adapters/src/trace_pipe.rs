//! A trace that another program writes while this one reads it: `candump -L can0 | cantap capture -d candump:-`, or what candump shows on a screen.
//!
//! Every format that can be read from its beginning can be read here. Its times become the device's, placed by arrivals: a trace that arrives
//! faster than it was recorded has none to keep, and its frames are stamped on arrival. Read such a file by its name.

use std::collections::VecDeque;
use std::path::Path;
use std::time::{Duration, Instant};

use cantap_formats::{Format, ReadOptions, TraceReader, open_reader};
use cantap_trace::TraceRecord;
use cantap_wire::record::LossStage;
use cantap_wire::{Channel, Frame, Refusal};

use crate::adapter_clock::AdapterClock;
use crate::driver::{At, Driver, Incoming, Oddities, OpenError, Opening};
use crate::rows::{Row, row};
use crate::source::{Piece, Source};

/// How long an address waits for the first bytes to be a trace before it counts as open: a quiet bus writes nothing.
const FIRST_BYTES: Duration = Duration::from_millis(200);
/// Unreadable parts after which it is none.
const MAX_FIRST: usize = 64;

/// What the reader found.
enum Found {
    Records(Vec<TraceRecord>),
    /// Something unreadable, with what it is.
    Issue(String),
}

/// The driver.
pub(crate) struct TracePipe {
    source: Source<Found>,
    clock: AdapterClock,
    /// Found while opening.
    first: VecDeque<(Found, Instant)>,
    is_open: [bool; 2],
    oddities: Oddities,
}

impl TracePipe {
    /// Reads from a file or pipe, `-` for standard input.
    pub fn open_path(path: &str, format: Format, address: &str) -> Result<Self, OpenError> {
        let no_trace = |reason: String| OpenError::NoTrace { address: address.to_owned(), reason };
        if path != "-" && !Path::new(path).exists() {
            return Err(no_trace("there is no such file or pipe; `-` is standard input".to_owned()));
        }
        let path = path.to_owned();
        let mut reader = None;
        // Opening a named pipe waits for its writer, so it happens in the thread.
        let mut source = Source::start(false, move || {
            if reader.is_none() {
                reader = Some(opened(&path, format)?);
            }
            let Some(reader) = &mut reader else { return Ok(None) };
            let mut records = Vec::new();
            match reader.next_batch(&mut records) {
                None => Err("its input has ended".to_owned()),
                Some(Ok(())) => Ok(Some(Found::Records(records))),
                Some(Err(issue)) => Ok(Some(Found::Issue(issue.fault.to_string()))),
            }
        })
        .map_err(|error| no_trace(error.to_string()))?;
        let first = first_of(&mut source, format).map_err(no_trace)?;
        // Nanoseconds that never start again.
        let clock = AdapterClock::new(1, 1 << 62);
        Ok(Self { source, clock, first, is_open: [false; 2], oddities: Oddities::default() })
    }

    fn take(&mut self, found: Found, arrival: Instant, reports: &mut Vec<Incoming>) {
        match found {
            Found::Records(records) => {
                for record in records {
                    self.record(&record, arrival, reports);
                }
            }
            Found::Issue(_) => {
                self.oddities.count("parts that cannot be read");
                // One gap, on whichever channel is open.
                if let Some(channel) = Channel::ALL.into_iter().find(|channel| self.is_open[channel.index()])
                {
                    let (stage, at) = (LossStage::Link, At::arrival(arrival));
                    reports.push(Incoming::Lost { channel, stage, count: 1, at_least: true, at });
                }
            }
        }
    }

    fn record(&mut self, record: &TraceRecord, arrival: Instant, reports: &mut Vec<Incoming>) {
        let Some(channel) = Channel::from_number(record.channel) else {
            return self.oddities.count("records of a third or higher channel");
        };
        let at = match u64::try_from(record.time_ns) {
            // A trace that arrives faster than it was recorded is no fault of anybody.
            Ok(time_ns @ 1..) => self.clock.place(time_ns, arrival, &mut Oddities::default()),
            // What candump shows without -t has no times.
            Ok(0) | Err(_) => At::arrival(arrival),
        };
        match Incoming::of(&record.event, channel, at) {
            Some(incoming) => reports.push(incoming),
            None => self.oddities.count("transmissions that failed elsewhere"),
        }
    }
}

/// Opens it. Of standard input the first line shows whether it is candump's log or its screen.
fn opened(path: &str, format: Format) -> Result<TraceReader, String> {
    let may_be_screen = path == "-" && format == Format::Candump;
    let options = ReadOptions { format: (!may_be_screen).then_some(format), ..ReadOptions::default() };
    let reader = open_reader(path, &options).map_err(|error| error.to_string())?;
    let found = reader.format();
    if found == format || may_be_screen && found == Format::CandumpScreen {
        return Ok(reader);
    }
    Err(format!("it is {found} and not {format}; convert it, or read it by its name"))
}

/// What comes within [`FIRST_BYTES`]: nothing, or something of which a part is a trace. An error is the reason why it is none.
fn first_of(source: &mut Source<Found>, format: Format) -> Result<VecDeque<(Found, Instant)>, String> {
    let deadline = Instant::now() + FIRST_BYTES;
    let mut first = VecDeque::new();
    let mut fault = None;
    let has_ended = loop {
        match source.next(deadline.saturating_duration_since(Instant::now())) {
            Ok(Some(Piece { at, content })) => {
                if let Found::Issue(what) = &content {
                    fault.get_or_insert_with(|| what.clone());
                }
                let is_trace = matches!(&content, Found::Records(records) if !records.is_empty());
                first.push_back((content, at));
                if is_trace {
                    return Ok(first);
                }
                if first.len() == MAX_FIRST {
                    break false;
                }
            }
            Ok(None) => break false,
            Err(reason) if first.is_empty() => return Err(reason),
            Err(_) => break true,
        }
    };
    // One line may be anything, such as the end of one whose beginning went elsewhere.
    let is_text = format == Format::Candump;
    match fault {
        Some(what) if is_text && (has_ended || first.len() > 1) => {
            Err(format!("{what}; have candump write its log format: candump -L"))
        }
        Some(what) if !is_text => Err(format!("{what}; it is no {format}")),
        _ => Ok(first),
    }
}

impl Driver for TracePipe {
    fn row(&self) -> &'static Row {
        row("trace-pipe").unwrap_or(&crate::ROWS[0])
    }

    fn channels(&self) -> u8 {
        2
    }

    fn open(&mut self, channel: Channel, opening: Opening) -> Result<(), Refusal> {
        // Nothing is acknowledged by reading, and nothing can be.
        if !opening.listen_only {
            return Err(Refusal::Unsupported);
        }
        self.is_open[channel.index()] = true;
        Ok(())
    }

    fn close(&mut self, channel: Channel) {
        self.is_open[channel.index()] = false;
    }

    fn send(&mut self, _channel: Channel, _mailbox: u8, _frame: &Frame) -> bool {
        false
    }

    fn poll(&mut self, wait: Duration, reports: &mut Vec<Incoming>) -> Result<(), String> {
        // Until somebody listens, the pipe waits.
        if self.is_open == [false; 2] {
            std::thread::sleep(wait);
            return Ok(());
        }
        if let Some((found, at)) = self.first.pop_front() {
            self.take(found, at, reports);
            return Ok(());
        }
        if let Some(piece) = self.source.next(wait)? {
            self.take(piece.content, piece.at, reports);
        }
        Ok(())
    }

    fn oddities(&self) -> (u32, String) {
        self.oddities.summary()
    }
}
