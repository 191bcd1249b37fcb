//! ELM327 chips, their copies and STN chips: stand-ins after the data sheet and the manual, on a serial port and on TCP.

use std::io::{ErrorKind, Read, Write};
use std::net::TcpListener;
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
    /// STN1110.
    Stn,
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
        }
    }

    fn end(&self) -> &'static str {
        if self.linefeeds { "\r\n" } else { "\r" }
    }

    fn byte(&mut self, byte: u8) -> Vec<u8> {
        if self.monitors {
            if self.chip == Chip::Stuck {
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
            out.extend(format!("{answer}{0}{0}>", self.end()).into_bytes());
        }
        out
    }

    /// `None` while it monitors.
    fn answer(&mut self, line: &str) -> Option<String> {
        let chip = self.chip;
        let stn = chip == Chip::Stn;
        let ok = Some("OK".to_owned());
        let unknown = Some("?".to_owned());
        match line {
            "ATZ" => {
                let commands = std::mem::take(&mut self.commands);
                *self = Self { commands, ..Self::new(chip) };
                Some(if stn { "\r\rELM327 v1.4b" } else { "\r\rELM327 v2.2" }.to_owned())
            }
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
            "ATCSM0" | "ATCSM1" if chip != Chip::Acknowledging => ok,
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
            Chip::Stn => self.passes_all,
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
    state: Arc<Mutex<State>>,
}

impl StandIn {
    fn start(chip: Chip) -> Self {
        let state = Arc::new(Mutex::new(State::new(chip)));
        let own = Arc::clone(&state);
        Self { port: Port::start(move |byte| own.lock().unwrap().byte(byte)), state }
    }

    fn address(&self) -> String {
        let scheme = if self.state.lock().unwrap().chip == Chip::Stn { "stn" } else { "elm327" };
        format!("{scheme}:{}", self.port.path)
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
        self.port.says(&format!("{text}\r\r>"));
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

#[test]
fn it_listens_in_silence_to_both_kinds_of_identifiers_and_sends_nothing() {
    let adapter = StandIn::start(Chip::Elm);
    let device = open(&adapter.address());
    assert_eq!((device.hello().board.as_str(), device.hello().firmware), ("elm327", [2, 2, 0]));
    device.listen(Channel::Can1, 125_000).unwrap();
    adapter.bus(&["123#DEAD", "1ABCDEF0#", "456#R", "1ABCDEF0#0011223344556677", "7FF#"]);
    let received = frames(&until_frame(&device, "7FF#"));
    assert_eq!(received, ["123#DEAD", "1ABCDEF0#", "456#R", "1ABCDEF0#0011223344556677", "7FF#"]);
    assert_eq!(device.hello().capabilities & capability::TRANSMIT, 0);
    let frame = TxFrame { tag: 1, frame: "123#".parse().unwrap(), at_ticks: None };
    device.send(Channel::Can1, &[frame]).unwrap_err();
    device.join(Channel::Can1, 125_000).unwrap_err();
    device.stop().unwrap();
    let commands = adapter.commands();
    let has = |command: &str| commands.iter().any(|sent| sent == command);
    assert!(has("ATCSM1") && has("ATPBE004") && has("ATTPB") && !has("ATCSM0"), "{commands:?}");
    // No command was repeated by a lone CR, which would monitor again.
    assert_eq!(commands.iter().filter(|command| *command == "ATMA").count(), 1, "{commands:?}");
    assert_eq!(commands.last().unwrap(), "ATPC");
}

#[test]
fn what_an_old_copy_does_not_receive_is_known_before_it_is_missed() {
    let adapter = StandIn::start(Chip::OldCopy);
    let device = open(&adapter.address());
    assert_eq!(device.hello().board.as_str(), "elm327-standard");
    assert!(row(&device.hello().board).unwrap().limits.unwrap().contains("extended frames are not received"));
    assert_eq!(refusal(&device.listen(Channel::Can1, 125_000).unwrap_err()), Some(Refusal::BadTiming));
    device.listen(Channel::Can1, 250_000).unwrap();
    adapter.bus(&["1ABCDEF0#", "7FF#"]);
    assert_eq!(frames(&until_frame(&device, "7FF#")), ["7FF#"]);
    assert!(adapter.commands().iter().any(|command| command == "ATSP8"));
    drop(device);
    let device = open(&format!("{}?ids=extended", adapter.address()));
    assert_eq!(device.hello().board.as_str(), "elm327-extended");
    device.listen(Channel::Can1, 500_000).unwrap();
    adapter.bus(&["7FF#", "1ABCDEF0#"]);
    assert_eq!(frames(&until_frame(&device, "1ABCDEF0#")), ["1ABCDEF0#"]);
}

#[test]
fn a_copy_that_does_not_confirm_its_silence_is_not_opened_until_the_user_allows_it() {
    let adapter = StandIn::start(Chip::Acknowledging);
    let device = open(&adapter.address());
    assert_eq!(row(&device.hello().board).unwrap().listen_only, ListenOnly::Never);
    let refused = device.listen(Channel::Can1, 500_000).unwrap_err();
    assert!(matches!(refused, DeviceError::AlwaysAcknowledges { .. }), "{refused}");
    assert!(!adapter.commands().iter().any(|command| command == "ATMA"));
    device.join(Channel::Can1, 500_000).unwrap();
    adapter.bus(&["123#"]);
    until_frame(&device, "123#");
}

#[test]
fn a_full_buffer_is_a_gap_of_unknown_size_and_it_goes_on() {
    let adapter = StandIn::start(Chip::Elm);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    adapter.bus(&["100#", "101#0011"]);
    adapter.ends("7E8064100BUFFER FULL");
    adapter.waits_for_monitoring();
    adapter.bus(&["102#", "7FF#"]);
    let records = until_frame(&device, "7FF#");
    assert_eq!(frames(&records), ["100#", "101#0011", "102#", "7FF#"]);
    assert_eq!(gaps(&records), [("queue", 0, true)]);
    let at =
        records.iter().position(|record| matches!(record.event, TraceEvent::Lost { stage: Some(_), .. }));
    let after = &records[at.unwrap() + 1];
    assert_eq!(after.frame().unwrap().to_string(), "102#");
    assert!(device.failures().unwrap().last.contains("buffer was full"));
}

#[test]
fn messages_about_the_bus_are_errors_and_gaps_and_no_frames() {
    let adapter = StandIn::start(Chip::Elm);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    adapter.says("7E8064100<DATA ERROR\r7E806<RX ERROR\r");
    for message in ["CAN ERROR", "UNABLE TO CONNECT", "STOPPED"] {
        adapter.ends(message);
        adapter.waits_for_monitoring();
    }
    // Without a reason.
    adapter.ends("");
    adapter.waits_for_monitoring();
    adapter.bus(&["7FF#"]);
    let records = until_frame(&device, "7FF#");
    assert_eq!(frames(&records), ["7FF#"]);
    let unknown = ("controller", 0, true);
    assert_eq!(gaps(&records), [("controller", 1, false), unknown, unknown, unknown, unknown]);
    let errors = |record: &TraceRecord| match record.event {
        TraceEvent::ErrorsSuppressed { count } => count,
        TraceEvent::BusError { kind: None | Some(BusErrorKind::Stuff), .. } => 1,
        _ => 0,
    };
    assert_eq!(records.iter().map(errors).sum::<u32>(), 3);
}

#[test]
fn one_that_has_started_again_ends_the_session_since_its_settings_are_gone() {
    for message in ["LV RESET", "ERR94", "ELM327 v2.2"] {
        let adapter = StandIn::start(Chip::Elm);
        let device = open(&adapter.address());
        device.listen(Channel::Can1, 500_000).unwrap();
        adapter.bus(&["100#"]);
        adapter.ends(message);
        let end = device.records().find_map(Result::err).unwrap();
        assert!(
            end.to_string().contains("started again") || matches!(end, DeviceError::Vanished { .. }),
            "{end}"
        );
        assert_eq!(device.counters().channels[0].received, 1);
    }
}

#[test]
fn babbling_is_counted_and_costs_no_memory_and_no_silence() {
    let adapter = StandIn::start(Chip::Elm);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    for _ in 0..256 {
        adapter.says(&"x".repeat(1024));
    }
    // Lengths and identifiers that lie, prompts without an end, and what pretends to be several things.
    adapter.says("\r800\r7E80\r7E8064100BE3EA8130000\r\0\x07\r");
    for _ in 0..64 {
        adapter.says(&">".repeat(1024));
    }
    adapter.says("\r7FF\r");
    let records = until_frame(&device, "7FF#");
    let link = losses(&records).iter().filter(|(stage, _)| *stage == "link").count();
    assert!((5..100).contains(&link), "{link}");
    assert!(gaps(&records).len() < 200);
    // Each prompt might be the answer to a command: it is told to go on no more often than it is looked at.
    assert!(device.failures().unwrap().last.contains("prompts"));
}

#[test]
fn pulled_out_it_ends_with_a_reason_and_nothing_captured_is_lost() {
    let adapter = StandIn::start(Chip::Elm);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    for id in 0..100 {
        adapter.bus(&[&format!("{id:03X}#")]);
    }
    until_frame(&device, "063#");
    adapter.port.pull();
    let end = device.records().find_map(Result::err).unwrap();
    assert!(matches!(end, DeviceError::Vanished { .. }), "{end}");
    assert_eq!(device.counters().channels[0].received, 100);
}

#[test]
fn one_that_does_not_stop_holds_up_nothing() {
    let adapter = StandIn::start(Chip::Stuck);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    adapter.bus(&["123#"]);
    until_frame(&device, "123#");
    device.stop().unwrap();
    assert_eq!(device.counters().channels[0].received, 1);
}

#[test]
fn what_cannot_listen_is_refused_with_the_reason() {
    let adapter = StandIn::start(Chip::RefusesMonitoring);
    let device = open(&adapter.address());
    assert_eq!(refusal(&device.listen(Channel::Can1, 500_000).unwrap_err()), Some(Refusal::Unsupported));
    let adapter = StandIn::start(Chip::AcceptsAll);
    let device = open(&adapter.address());
    assert_eq!(refusal(&device.listen(Channel::Can1, 250_000).unwrap_err()), Some(Refusal::BadTiming));
    assert!(!adapter.commands().iter().any(|command| command == "ATMA"));
    let adapter = StandIn::start(Chip::Formats);
    let error = open_error(&adapter.address());
    assert!(matches!(error, OpenError::Unsuitable { command: "ATCAF0", .. }), "{error}");
    // An ELM327 is no STN chip.
    let adapter = StandIn::start(Chip::Elm);
    let error = open_error(&format!("stn:{}", adapter.port.path));
    assert!(matches!(error, OpenError::Foreign { .. }), "{error}");
}

#[test]
fn an_stn_chip_has_any_bit_rate_and_lengths_that_can_be_checked() {
    let adapter = StandIn::start(Chip::Stn);
    let device = open(&adapter.address());
    assert_eq!((device.hello().board.as_str(), device.hello().firmware), ("stn", [4, 0, 4]));
    device.listen(Channel::Can1, 1_000_000).unwrap();
    adapter.bus(&["123#DEAD", "1ABCDEF0#11"]);
    // Two digits were lost on the way.
    adapter.says("1232DE\r");
    adapter.bus(&["456#R3", "7FF#"]);
    let records = until_frame(&device, "7FF#");
    assert_eq!(frames(&records), ["123#DEAD", "1ABCDEF0#11", "456#R3", "7FF#"]);
    assert_eq!(gaps(&records), [("link", 1, true)]);
    let commands = adapter.commands();
    let at = |command: &str| commands.iter().position(|sent| sent == command).unwrap();
    assert!(at("STP31") < at("STPBR1000000") && at("STFAP00,00") < at("STM"), "{commands:?}");
    assert!(at("STCMM0") < at("STM") && !commands.iter().any(|command| command == "STCMM1"));
}

#[test]
fn over_tcp_it_is_the_same() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("elm327:tcp://{}", listener.local_addr().unwrap());
    let adapter = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let mut state = State::new(Chip::Elm);
        let mut byte = [0];
        loop {
            match stream.read(&mut byte) {
                Ok(0) => return state.commands,
                Ok(_) => {
                    let was = state.monitors;
                    let mut answer = state.byte(byte[0]);
                    if state.monitors && !was {
                        answer.extend(state.print("123#DEAD").into_bytes());
                        answer.extend(state.print("1ABCDEF0#").into_bytes());
                    }
                    stream.write_all(&answer).unwrap();
                }
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(_) => return state.commands,
            }
        }
    });
    let device = open(&address);
    device.listen(Channel::Can1, 500_000).unwrap();
    assert_eq!(frames(&until_frame(&device, "1ABCDEF0#")), ["123#DEAD", "1ABCDEF0#"]);
    drop(device);
    assert_eq!(adapter.join().unwrap().last().unwrap(), "ATPC");
}

#[test]
fn nothing_that_it_says_while_it_is_asked_counts_as_an_answer() {
    // A terminal that echoes what it is sent is no ELM327.
    let port = Port::start(|byte| vec![byte, b'>']);
    let error = open_error(&format!("elm327:{}", port.path));
    assert!(matches!(error, OpenError::Foreign { .. }), "{error}");
    // One that never stops talking is given up, too.
    let port = Port::start(|_| b"ELM327 v1.5 ".repeat(100));
    let error = open_error(&format!("elm327:{}", port.path));
    assert!(matches!(error, OpenError::Foreign { .. }), "{error}");
}

#[test]
fn losses_are_not_counted_and_that_is_in_the_stream() {
    let adapter = StandIn::start(Chip::Elm);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    adapter.bus(&["7FF#"]);
    let records = until(&device, |record| record.frame().is_some());
    assert_eq!(records[0].event, TraceEvent::UNCOUNTED);
    assert_eq!(device.counters().channels[0].lost(), 0);
    assert_eq!(device.counters().channels[0].unknown, 1);
}
