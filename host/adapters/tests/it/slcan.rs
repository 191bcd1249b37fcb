//! slcan adapters: one that answers as Lawicel's manual says, one that answers nothing, as CANable's firmware.

use std::sync::{Arc, Mutex};

use cantap::wire::Refusal;
use cantap::wire::message::{Filter, Modifier, Periodic, Trigger, capability};
use cantap::{Channel, DeviceError, TraceEvent};
use cantap_adapters::{ListenOnly, OpenError, row};

use crate::port::Port;
use crate::{frames, losses, open, send, until, until_frame};

/// How the stand-in behaves.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Manner {
    Lawicel,
    /// `L` is refused.
    WithoutListening,
    Canable,
    /// Answers what belongs to the greeting, and nothing afterwards.
    Stalling,
    /// Each answer comes once more, with the next command; `L` is refused.
    Twice,
    /// Refuses the first of every two frames, because its queue is full.
    Full,
}

struct StandIn {
    port: Port,
    commands: Arc<Mutex<Vec<String>>>,
}

impl StandIn {
    fn start(manner: Manner) -> Self {
        let commands = Arc::new(Mutex::new(Vec::new()));
        let log = Arc::clone(&commands);
        let (mut line, mut state) = (String::new(), State::default());
        let mut again = "";
        let port = Port::start(move |byte| {
            if byte != b'\r' {
                line.push(char::from(byte));
                return std::mem::take(&mut again).as_bytes().to_vec();
            }
            let answer = state.answer(manner, &line);
            if manner == Manner::Twice {
                again = answer;
            }
            log.lock().unwrap().push(std::mem::take(&mut line));
            answer.as_bytes().to_vec()
        });
        Self { port, commands }
    }

    fn pull(self) {
        self.port.pull();
    }

    fn address(&self) -> String {
        format!("slcan:{}", self.port.path)
    }

    fn says(&self, text: &str) {
        self.port.says(text);
    }

    fn commands(&self) -> Vec<String> {
        self.commands.lock().unwrap().clone()
    }
}

#[derive(Default)]
struct State {
    open: Option<char>,
    frames: u32,
    opened: u32,
    flags_read: u32,
}

impl State {
    fn answer(&mut self, manner: Manner, line: &str) -> &'static str {
        const OK: &str = "\r";
        const NO: &str = "\x07";
        if manner == Manner::Canable {
            return if line == "V" { "b158aa7 github.com/normaldotcom/canable-fw.git\r" } else { "" };
        }
        if manner == Manner::Stalling && self.opened > 0 && self.open.is_none() && line != "C" {
            return "";
        }
        match line.chars().next() {
            None => OK,
            Some('V') => "V1013\r",
            Some('N') => "NA123\r",
            Some('S') if self.open.is_none() && ("S0"..="S8").contains(&line) => OK,
            Some('L') if matches!(manner, Manner::WithoutListening | Manner::Twice) => NO,
            Some(mode @ ('O' | 'L')) if self.open.is_none() => {
                self.open = Some(mode);
                self.opened += 1;
                OK
            }
            Some('C') if self.open.take().is_some() => OK,
            Some('F') if self.open.is_some() => {
                self.flags_read += 1;
                if self.flags_read == 1 { "F08\r" } else { "F00\r" }
            }
            Some('t' | 'r') if self.open == Some('O') => {
                self.frames += 1;
                if manner == Manner::Full && self.frames % 2 == 1 { NO } else { "z\r" }
            }
            Some('T' | 'R') if self.open == Some('O') => "Z\r",
            _ => NO,
        }
    }
}

#[test]
fn it_listens_without_ever_having_been_open_to_acknowledge() {
    let adapter = StandIn::start(Manner::Lawicel);
    let device = open(&adapter.address());
    assert_eq!((device.hello().board.as_str(), device.hello().serial.as_str()), ("slcan", "A123"));
    assert_eq!((device.hello().channels, device.hello().firmware), (1, [10, 13, 0]));
    device.listen(Channel::Can1, 250_000).unwrap();
    adapter.says("t1232DEAD\rT1ABCDEF00\rr4563\r");
    adapter.says("t1232BEEF0010\r");
    assert_eq!(frames(&until_frame(&device, "123#BEEF")), ["123#DEAD", "1ABCDEF0#", "456#R3", "123#BEEF"]);
    device.stop().unwrap();
    let commands = adapter.commands();
    assert!(!commands.iter().any(|command| command == "O"), "{commands:?}");
    let open_at = commands.iter().rposition(|command| command == "L").unwrap();
    assert_eq!(commands[open_at - 1], "S5");
    assert_eq!(commands.last().unwrap(), "C");
}

#[test]
fn what_it_cannot_listen_to_silently_is_not_opened_until_the_user_allows_it() {
    let adapter = StandIn::start(Manner::WithoutListening);
    let device = open(&adapter.address());
    assert_ne!(device.hello().capabilities & capability::ALWAYS_ACKNOWLEDGES, 0);
    assert_eq!(row(&device.hello().board).unwrap().listen_only, ListenOnly::Never);
    let refused = device.listen(Channel::Can1, 500_000).unwrap_err();
    assert!(matches!(refused, DeviceError::AlwaysAcknowledges { .. }), "{refused}");
    assert!(!adapter.commands().iter().any(|command| command == "O"));
    device.join(Channel::Can1, 500_000).unwrap();
    assert!(adapter.commands().iter().any(|command| command == "O"));
}

#[test]
fn a_silent_dialect_is_known_by_its_version_and_listens_by_mode() {
    let adapter = StandIn::start(Manner::Canable);
    let device = open(&adapter.address());
    assert_eq!(device.hello().board.as_str(), "slcan-canable");
    device.listen(Channel::Can1, 1_000_000).unwrap();
    // Its remote frames carry data bytes, which mean nothing.
    adapter.says("r1232ABCD\rt00100\rt0011FF\r");
    let records = until_frame(&device, "001#FF");
    assert_eq!(frames(&records), ["123#R2", "001#FF"]);
    // A frame without data has nothing after its length; "t00100" is one with half a stamp.
    assert_eq!(losses(&records), [("link", 1)]);
    let commands = adapter.commands();
    let last: Vec<&str> = commands.iter().rev().take(3).rev().map(String::as_str).collect();
    assert_eq!(last, ["S8", "M1", "O"]);
}

/// It says nothing to what it is told, so a frame is handed over and no more; what comes and goes is as with the others.
#[test]
fn a_silent_dialect_sends_babbles_and_is_pulled_out_as_others_do() {
    let adapter = StandIn::start(Manner::Canable);
    let device = open(&adapter.address());
    device.join(Channel::Can1, 500_000).unwrap();
    assert_eq!(send(&device, "1ABCDEF0#22").result.unwrap().to_string(), "1ABCDEF0#22");
    let commands = adapter.commands();
    assert!(
        commands.contains(&"M0".to_owned()) && commands.contains(&"T1ABCDEF0122".to_owned()),
        "{commands:?}"
    );
    for _ in 0..256 {
        adapter.says(&"x".repeat(1024));
    }
    // Half a line, whose end comes later.
    adapter.says("\rt12");
    device.status().unwrap();
    adapter.says("31AA\r");
    let records = until_frame(&device, "123#AA");
    assert_eq!(frames(&records).last().unwrap(), "123#AA");
    assert!((1..100).contains(&losses(&records).len()), "{}", losses(&records).len());
    adapter.pull();
    let end = device.records().find_map(Result::err).unwrap();
    assert!(matches!(end, DeviceError::Vanished { .. }), "{end}");
}

#[test]
fn a_sent_frame_is_confirmed_when_the_adapter_has_accepted_it_even_if_it_refused_it_at_first() {
    let adapter = StandIn::start(Manner::Full);
    let device = open(&adapter.address());
    device.join(Channel::Can1, 500_000).unwrap();
    for frame in ["123#11", "456#R2", "1ABCDEF0#22"] {
        let end = send(&device, frame);
        assert_eq!(end.result.unwrap().to_string(), frame);
    }
    let commands = adapter.commands();
    let sent = |line: &str| commands.iter().filter(|command| *command == line).count();
    assert_eq!((sent("t123111"), sent("r4562"), sent("T1ABCDEF0122")), (2, 2, 1));
}

#[test]
fn flags_are_losses_of_the_controller_and_rubbish_is_a_loss_of_the_line() {
    let adapter = StandIn::start(Manner::Lawicel);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    let flagged = until(&device, |record| matches!(record.event, TraceEvent::Lost { .. }));
    assert_eq!(losses(&flagged), [("controller", 1)]);
    // Lengths that lie, identifiers that are too large, a megabyte without an end.
    adapter.says("t12381122\rtFFF0\rT400000000\rt123\r");
    for _ in 0..1024 {
        adapter.says(&"x".repeat(1024));
    }
    adapter.says("\rt7FF0\r");
    let records = until_frame(&device, "7FF#");
    // The flags may have been asked for again meanwhile, and the answer stand in the middle of the line without an end.
    let mut of_the_line = losses(&records);
    of_the_line.retain(|(stage, _)| *stage == "link");
    assert!(of_the_line.len() >= 5, "{of_the_line:?}");
    let failures = device.failures().unwrap();
    assert!(failures.count >= 5, "{}", failures.count);
    assert!(failures.last.contains("4 frames that cannot be read"), "{}", failures.last);
}

#[test]
fn errors_and_states_that_linux_s_driver_knows_are_reported() {
    let adapter = StandIn::start(Manner::Lawicel);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    adapter.says("e3ccc\rsp130007\re9a\rsx\rt0010\r");
    let records = until_frame(&device, "001#");
    let has = |wanted: TraceEvent| records.iter().any(|record| record.event == wanted);
    assert!(has(TraceEvent::BusError {
        kind: Some(cantap::wire::record::BusErrorKind::Crc),
        counters: Some((0, 0))
    }));
    assert!(has(TraceEvent::State {
        state: cantap::wire::record::ErrorState::Passive,
        counters: Some((7, 130))
    }));
}

#[test]
fn pulled_out_it_ends_with_a_reason_and_nothing_captured_is_lost() {
    let adapter = StandIn::start(Manner::Lawicel);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    for id in 0..100 {
        adapter.says(&format!("t{id:03X}0\r"));
    }
    until_frame(&device, "063#");
    adapter.pull();
    let end = device.records().find_map(Result::err).unwrap();
    assert!(matches!(end, DeviceError::Vanished { .. }), "{end}");
    assert_eq!(device.counters().channels[0].received, 100);
}

#[test]
fn one_that_stalls_is_refused_and_holds_up_nothing() {
    let adapter = StandIn::start(Manner::Stalling);
    let device = open(&adapter.address());
    let refused = device.listen(Channel::Can1, 500_000).unwrap_err();
    assert!(matches!(refused, DeviceError::Refused { refusal: Refusal::Hardware }), "{refused}");
    device.status().unwrap();
    drop(adapter);
}

/// Its refusal to only listen would be taken for the answer to another command.
#[test]
fn one_whose_answers_come_twice_is_not_opened() {
    let adapter = StandIn::start(Manner::Twice);
    let place: cantap_adapters::Place = adapter.address().parse().unwrap();
    let error = cantap_adapters::open(&place).err().unwrap();
    assert!(matches!(error, OpenError::Foreign { .. }), "{error}");
    assert!(error.to_string().contains("that no other program uses it"), "{error}");
}

#[test]
fn answers_to_nothing_are_counted_and_confirm_nothing() {
    let adapter = StandIn::start(Manner::Lawicel);
    let device = open(&adapter.address());
    device.join(Channel::Can1, 500_000).unwrap();
    adapter.says("z\rZ\r\rt7FF0\r");
    assert_eq!(frames(&until_frame(&device, "7FF#")), ["7FF#"]);
    assert!(device.failures().unwrap().last.contains("3 answers to nothing"));
}

#[test]
fn what_no_adapter_can_is_refused() {
    let adapter = StandIn::start(Manner::Lawicel);
    let device = open(&adapter.address());
    let unsupported =
        |error: DeviceError| matches!(error, DeviceError::Refused { refusal: Refusal::Unsupported });
    assert!(unsupported(device.bootloader().unwrap_err()));
    assert!(unsupported(device.save_defaults().unwrap_err()));
    assert!(unsupported(device.registers(Channel::Can1).unwrap_err()));
    assert!(unsupported(device.measure_edges(Some(Channel::Can1)).unwrap_err()));
    let bad = device.listen(Channel::Can1, 400_000).unwrap_err();
    assert!(matches!(bad, DeviceError::Refused { refusal: Refusal::BadTiming }), "{bad}");
    assert!(matches!(device.listen(Channel::Can2, 500_000), Err(DeviceError::NoChannel { .. })));
}

#[test]
fn periodic_frames_replies_and_filters_are_the_firmware_s() {
    let adapter = StandIn::start(Manner::Lawicel);
    let device = open(&adapter.address());
    let filter =
        |id| Filter { extended: false, kind: cantap::wire::message::FrameKind::Any, id, mask: 0x7FF };
    device.set_filters(Channel::Can1, &[filter(0x100), filter(0x7FF)]).unwrap();
    device.join(Channel::Can1, 500_000).unwrap();
    let reply = Trigger { filter: filter(0x100), reply: "101#01".parse().unwrap(), count: 1 };
    device.set_trigger(Channel::Can1, 0, Some(reply)).unwrap();
    let modifiers = [Modifier::Counter { byte: 0, low_bit: 0, bits: 8 }].into_iter().collect();
    let frame = "200#00".parse().unwrap();
    let entry = Periodic { frame, period_ticks: device.hello().tick_hz / 100, count: 3, modifiers };
    let ends = device.transmissions();
    device.set_periodic(Channel::Can1, 0, Some(entry)).unwrap();
    let sent: Vec<String> = ends.iter().take(3).map(|end| end.result.unwrap().to_string()).collect();
    assert_eq!(sent[2][..4], *"200#");
    adapter.says("t1000\rt1230\r");
    assert_eq!(ends.recv().unwrap().result.unwrap().to_string(), "101#01");
    adapter.says("t7FF0\r");
    let received = until_frame(&device, "7FF#");
    assert!(!frames(&received).contains(&"123#".to_owned()));
    let commands = adapter.commands();
    let counters: Vec<&String> = commands.iter().filter(|command| command.starts_with("t200")).collect();
    assert_eq!(counters.len(), 3, "{commands:?}");
    assert!(counters.is_sorted() && counters[0] != counters[2], "{counters:?}");
}
