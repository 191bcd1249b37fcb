//! ELM327 chips, their copies and STN chips: stand-ins after the data sheet and the manual, on a serial port and on TCP.

mod hostile;
mod listening;

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use cantap::wire::message::{TxFrame, capability};
use cantap::wire::record::BusErrorKind;
use cantap::wire::{Frame, Refusal};
use cantap::{Channel, DeviceError, TraceEvent, TraceRecord};
use cantap_adapters::{ListenOnly, OpenError, Place, row};

use crate::port::Port;
use crate::{frames, losses, open, until, until_frame};

/// Which chip it is.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Chip {
    /// ELM327 v2.2.
    Elm,
    /// A copy of v1.3: no `ATPB` with options, no `ATTP`.
    OldCopy,
    /// A copy without silent monitoring.
    Acknowledging,
    /// Accepts everything, and stays on protocol 6.
    AcceptsAll,
    /// Refuses to print frames as they are.
    Formats,
    /// Refuses `ATMA`.
    RefusesMonitoring,
    /// Never stops monitoring.
    Stuck,
    /// Refuses to be silent, and gives each answer once more with the next command.
    Twice,
    /// STN1110.
    Stn,
    /// The same, which never stops monitoring.
    StuckStn,
}

impl Chip {
    fn is_stn(self) -> bool {
        matches!(self, Self::Stn | Self::StuckStn)
    }

    fn is_stuck(self) -> bool {
        matches!(self, Self::Stuck | Self::StuckStn)
    }
}

/// Its settings, all as after a start.
struct State {
    chip: Chip,
    commands: Vec<String>,
    line: String,
    echo: bool,
    linefeeds: bool,
    spaces: bool,
    headers: bool,
    formats: bool,
    dlc: bool,
    protocol: char,
    both_ids: bool,
    monitors: bool,
    passes_all: bool,
    /// What it says once more.
    again: String,
}

impl State {
    fn new(chip: Chip) -> Self {
        Self {
            chip,
            commands: Vec::new(),
            line: String::new(),
            echo: true,
            linefeeds: true,
            spaces: true,
            headers: false,
            formats: true,
            dlc: false,
            protocol: '0',
            both_ids: false,
            monitors: false,
            passes_all: false,
            again: String::new(),
        }
    }

    fn end(&self) -> &'static str {
        if self.linefeeds { "\r\n" } else { "\r" }
    }

    fn byte(&mut self, byte: u8) -> Vec<u8> {
        if self.monitors {
            if self.chip.is_stuck() {
                return Vec::new();
            }
            self.monitors = false;
            return format!("STOPPED{0}{0}>", self.end()).into_bytes();
        }
        let mut out = if self.echo { vec![byte] } else { Vec::new() };
        if byte != b'\r' {
            self.line.push(char::from(byte));
            return out;
        }
        let line: String = std::mem::take(&mut self.line).split_whitespace().collect();
        // A lone CR repeats the last command.
        let line = if line.is_empty() { self.commands.last().cloned().unwrap_or_default() } else { line };
        self.commands.push(line.clone());
        if let Some(answer) = self.answer(&line) {
            let answer = format!("{answer}{0}{0}>", self.end());
            let twice = self.chip == Chip::Twice;
            let again =
                std::mem::replace(&mut self.again, if twice { answer.clone() } else { String::new() });
            // The one before once more, or this one for the first time.
            out.extend(if again.is_empty() { answer } else { again }.into_bytes());
        }
        out
    }

    /// `None` while it monitors.
    fn answer(&mut self, line: &str) -> Option<String> {
        let chip = self.chip;
        let stn = chip.is_stn();
        let ok = Some("OK".to_owned());
        let unknown = Some("?".to_owned());
        match line {
            "ATZ" => {
                let commands = std::mem::take(&mut self.commands);
                *self = Self { commands, ..Self::new(chip) };
                Some(if stn { "\r\rELM327 v1.4b" } else { "\r\rELM327 v2.2" }.to_owned())
            }
            "ATI" => Some(if stn { "ELM327 v1.4b" } else { "ELM327 v2.2" }.to_owned()),
            "STI" if stn => Some("STN1110 v4.0.4".to_owned()),
            "ATE0" | "ATE1" => {
                self.echo = line == "ATE1";
                ok
            }
            "ATL0" => {
                self.linefeeds = false;
                ok
            }
            "ATS0" => {
                self.spaces = false;
                ok
            }
            "ATH1" => {
                self.headers = true;
                ok
            }
            "ATCAF0" if chip == Chip::Formats => unknown,
            "ATCAF0" => {
                self.formats = false;
                ok
            }
            "ATD1" => {
                self.dlc = true;
                ok
            }
            "ATM0" | "ATAL" | "ATPC" => ok,
            "ATCSM0" | "ATCSM1" if !matches!(chip, Chip::Acknowledging | Chip::Twice) => ok,
            "STCMM0" | "STCMM1" | "STFCFC" | "STP31" if stn => ok,
            "STFAP00,00" if stn => {
                self.passes_all = true;
                ok
            }
            _ if stn && line.starts_with("STPBR") => ok,
            "ATDPN" => {
                Some(if chip == Chip::AcceptsAll { "6".to_owned() } else { self.protocol.to_string() })
            }
            "ATMA" | "STM" if chip == Chip::RefusesMonitoring => unknown,
            "ATMA" => {
                self.monitors = true;
                None
            }
            "STM" if stn => {
                self.monitors = true;
                None
            }
            _ if chip == Chip::OldCopy && (line.starts_with("ATPB") || line.starts_with("ATTP")) => unknown,
            _ if line.starts_with("ATPB") => {
                self.both_ids = line.starts_with("ATPBE0");
                ok
            }
            _ if line.starts_with("ATTP") || line.starts_with("ATSP") => {
                self.protocol = line.chars().last().unwrap();
                ok
            }
            _ if chip == Chip::AcceptsAll => ok,
            _ => unknown,
        }
    }

    /// What it prints when a frame is on its bus.
    fn print(&self, text: &str) -> String {
        let frame: Frame = text.parse().unwrap();
        let passes = match self.chip {
            Chip::Stn | Chip::StuckStn => self.passes_all,
            _ if self.protocol == 'B' => self.both_ids || !frame.id().is_extended(),
            _ => frame.id().is_extended() == matches!(self.protocol, '7' | '9'),
        };
        if !self.monitors || !passes {
            return String::new();
        }
        assert!(self.headers && !self.formats, "its lines would be no frames");
        let mut line = if frame.id().is_extended() {
            format!("{:08X}", frame.id().raw())
        } else {
            format!("{:03X}", frame.id().raw())
        };
        line.extend(self.dlc.then(|| format!("{:X}", frame.dlc())));
        line.extend(frame.data().iter().map(|byte| format!("{byte:02X}")));
        if frame.is_remote() {
            line += "RTR";
        }
        line + self.end()
    }
}

struct StandIn {
    port: Port,
    /// Where its port is served.
    server: Option<SocketAddr>,
    state: Arc<Mutex<State>>,
}

impl StandIn {
    fn start(chip: Chip) -> Self {
        let state = Arc::new(Mutex::new(State::new(chip)));
        let own = Arc::clone(&state);
        Self { port: Port::start(move |byte| own.lock().unwrap().byte(byte)), server: None, state }
    }

    /// The same behind a server, as those with Wi-Fi are.
    fn start_on_tcp(chip: Chip) -> Self {
        let adapter = Self::start(chip);
        let server = Some(adapter.port.serve());
        Self { server, ..adapter }
    }

    fn address(&self) -> String {
        let scheme = if self.state.lock().unwrap().chip.is_stn() { "stn" } else { "elm327" };
        match self.server {
            Some(server) => format!("{scheme}:tcp://{server}"),
            None => format!("{scheme}:{}", self.port.path),
        }
    }

    /// These frames are on its bus.
    fn bus(&self, frames: &[&str]) {
        self.waits_for_monitoring();
        let state = self.state.lock().unwrap();
        let lines: String = frames.iter().map(|frame| state.print(frame)).collect();
        self.port.says(&lines);
    }

    fn says(&self, text: &str) {
        self.port.says(text);
    }

    /// It prints this, and monitors no more.
    fn ends(&self, text: &str) {
        self.state.lock().unwrap().monitors = false;
        self.port.says(format!("{text}\r\r>"));
    }

    /// Waits until it monitors again.
    fn waits_for_monitoring(&self) {
        while !self.state.lock().unwrap().monitors {
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    fn commands(&self) -> Vec<String> {
        self.state.lock().unwrap().commands.clone()
    }
}

/// Losses with their stage, count and whether there may be more, without the one that every session begins with.
fn gaps(records: &[TraceRecord]) -> Vec<(&'static str, u32, bool)> {
    let loss = |record: &TraceRecord| match record.event {
        TraceEvent::Lost { stage: Some(stage), count, at_least } => Some((stage.name(), count, at_least)),
        _ => None,
    };
    records.iter().filter_map(loss).collect()
}

fn refusal(error: &DeviceError) -> Option<Refusal> {
    match error {
        DeviceError::Refused { refusal } => Some(*refusal),
        _ => None,
    }
}

fn open_error(address: &str) -> OpenError {
    cantap_adapters::open(&address.parse::<Place>().unwrap()).err().unwrap()
}
