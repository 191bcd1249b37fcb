//! The port: every request is answered, and whatever else arrives is answered or dropped, and never makes the device
//! hang or disturbs the bus.

use crate::common;

use cantap_emu::traffic::{Kind, Traffic};
use cantap_emu::usb_host::{Outcome, Request as UsbRequest, Timing};
use cantap_sim::board::CLOCK;
use cantap_sim::rig::{MS, Rig, timing};
use cantap_wire::message::{ChannelConfig, Filter, FrameKind, MAX_FILTERS, Mode, Periodic, Trigger, TxFrame};
use cantap_wire::{Channel, Command, Frame, Id, PROTOCOL_VERSION, Refusal, Reply};

const MEGABIT: u32 = 1_000_000;
const CAN1: Channel = Channel::Can1;

fn connected() -> Rig {
    let mut rig = Rig::new(common::firmware(), common::setup(), Timing::hasty(CLOCK));
    rig.connect().unwrap();
    rig
}

/// Sends bytes that are not a request of ours and gives the device time to handle them.
fn say(rig: &mut Rig, bytes: &[u8]) {
    rig.with_host(|host, _| host.send(bytes));
    let sent = rig.run_while(2000 * MS, |rig| rig.with_host(|host, _| host.unsent()) > 0).unwrap();
    assert!(sent, "the device takes no more bytes");
    rig.run_for(3 * MS).unwrap();
}

fn refusal(rig: &mut Rig, command: Command) -> Refusal {
    rig.request(command).unwrap().result.unwrap_err()
}

fn frame() -> Frame {
    Frame::data_frame(Id::standard(0x123).unwrap(), &[1, 2, 3]).unwrap()
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn every_request_is_answered_on_a_closed_and_on_an_open_channel() {
    let mut rig = connected();
    let normal =
        ChannelConfig { mode: Mode::SilentLoopback, ..ChannelConfig::listen_only(timing(MEGABIT).unwrap()) };
    let filter = Filter { extended: false, kind: FrameKind::Any, id: 0x100, mask: 0x700 };
    let requests = || {
        let channel = CAN1;
        let send = TxFrame { tag: 1, frame: frame(), at_ticks: None };
        let periodic =
            Periodic { frame: frame(), period_ticks: 120_000, count: 2, modifiers: heapless::Vec::new() };
        vec![
            Command::Status,
            Command::Time,
            Command::SetFilters { channel, filters: [filter].into_iter().collect() },
            Command::SetFilters { channel, filters: heapless::Vec::new() },
            Command::Send { channel, frames: [send].into_iter().collect() },
            Command::SetPeriodic { channel, slot: 0, entry: Some(periodic) },
            Command::SetPeriodic { channel, slot: 0, entry: None },
            Command::SetPeriodic { channel, slot: 255, entry: None },
            Command::SetTrigger {
                channel,
                slot: 0,
                entry: Some(Trigger { filter, reply: frame(), count: 1 }),
            },
            Command::SetTrigger { channel, slot: 0, entry: None },
            Command::Abort { channel },
            Command::Registers { channel },
            Command::Recover { channel },
            Command::Identify { seconds: 1 },
            Command::SaveDefaults,
            Command::ClearDefaults,
            Command::Open { channel, config: None },
            Command::Open { channel, config: Some(normal) },
            Command::Close { channel },
        ]
    };
    for open in [false, true] {
        for command in requests() {
            if open {
                rig.request(Command::Open { channel: CAN1, config: Some(normal) }).unwrap();
            }
            // Any answer will do; none within a second is the failure.
            rig.request(command.clone()).unwrap();
            if open {
                rig.request(Command::Close { channel: CAN1 }).unwrap();
            }
        }
    }
    assert_eq!(rig.session.corruptions(), []);
    assert_eq!(rig.with_host(|_, otg| otg.misuse().tx_overflows), 0);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn refusals_name_their_reason() {
    let mut rig = connected();
    let send = TxFrame { tag: 1, frame: frame(), at_ticks: None };
    let send = Command::Send { channel: CAN1, frames: [send].into_iter().collect() };
    assert_eq!(refusal(&mut rig, send.clone()), Refusal::ChannelClosed);
    rig.listen(CAN1, MEGABIT).unwrap();
    assert_eq!(refusal(&mut rig, send), Refusal::ListenOnly);
    let again = Command::SetFilters { channel: CAN1, filters: heapless::Vec::new() };
    assert_eq!(refusal(&mut rig, again), Refusal::ChannelOpen);
    rig.close(CAN1).unwrap();
    let mut bad = ChannelConfig::listen_only(timing(MEGABIT).unwrap());
    bad.timing.segment1 = 17;
    assert_eq!(refusal(&mut rig, Command::Open { channel: CAN1, config: Some(bad) }), Refusal::BadTiming);
    let other = Command::Hello { protocol: PROTOCOL_VERSION + 1 };
    assert_eq!(refusal(&mut rig, other), Refusal::Protocol { device: PROTOCOL_VERSION });
    let filters = (0..MAX_FILTERS as u32).map(|id| Filter {
        extended: true,
        kind: FrameKind::Data,
        id,
        mask: Id::MAX_EXTENDED,
    });
    let reply =
        rig.request(Command::SetFilters { channel: CAN1, filters: filters.collect() }).unwrap().result;
    assert!(matches!(reply, Ok(Reply::Filters { .. }) | Err(Refusal::BanksExhausted { .. })), "{reply:?}");
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_reset_request_brings_the_device_back_on_the_bus() {
    let mut rig = connected();
    rig.ask(Command::Reset).unwrap();
    assert!(rig.run_while(2000 * MS, |rig| rig.machine.resets() == 0).unwrap(), "it was not restarted");
    rig.run_for(50 * MS).unwrap();
    rig.wait_for_port().unwrap();
    rig.greet().unwrap();
}

/// Random bytes, in pieces of every length, while a capture runs: the capture loses nothing, and nothing reaches the bus.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn garbage_neither_hangs_the_device_nor_disturbs_the_capture() {
    let mut rig = connected();
    rig.listen(CAN1, MEGABIT).unwrap();
    let from = rig.now();
    rig.add_traffic(CAN1, MEGABIT, Traffic::new(Kind::Mix, 5, 50.0, from, u64::MAX));
    let mut random = fastrand::Rng::with_seed(9);
    for _ in 0..60 {
        let length = random.usize(1..600);
        // Zeros end messages: without some, all of it is one.
        let bytes: Vec<u8> =
            (0..length).map(|_| if random.u8(..20) == 0 { 0 } else { random.u8(..) }).collect();
        say(&mut rig, &bytes);
    }
    let status = rig.status().unwrap();
    assert!(status.bad_requests > 10, "{status:?}");
    rig.close(CAN1).unwrap();
    assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
    assert_eq!(rig.ledger.losses(CAN1).total(), 0);
    assert_eq!(rig.dominant_bits(CAN1), 0);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn half_a_request_waits_and_a_zero_throws_it_away() {
    let mut rig = connected();
    let (id, bytes) = rig.session.request(Command::Time);
    let (first, second) = bytes.split_at(bytes.len() / 2);
    say(&mut rig, first);
    rig.run_for(100 * MS).unwrap();
    assert!(rig.session.response(id).is_none());
    say(&mut rig, second);
    assert!(rig.session.response(id).is_some(), "the second half completes it");
    let (_, bytes) = rig.session.request(Command::Identify { seconds: 3 });
    say(&mut rig, &bytes[..bytes.len() / 2]);
    rig.ask(Command::Time).unwrap();
}

/// Requests faster than they can be answered, both while the host reads and while it does not: the host is made to wait,
/// except on the control pipe, and every request is answered.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn every_request_of_a_flood_is_answered() {
    const FLOOD: usize = 400;
    for reading in [true, false] {
        let mut rig = connected();
        rig.with_host(|host, _| host.read(reading));
        let mut ids = Vec::new();
        for _ in 0..FLOOD {
            let (id, bytes) = rig.session.request(Command::Status);
            ids.push(id);
            rig.with_host(|host, _| host.send(&bytes));
        }
        rig.run_for(200 * MS).unwrap();
        rig.with_host(|host, _| host.read(true));
        rig.drain(3000 * MS).unwrap();
        let answered = ids.iter().filter(|id| rig.session.response(**id).is_some()).count();
        assert_eq!(answered, FLOOD, "the host reading: {reading}");
        assert_eq!(rig.status().unwrap().bad_requests, 0);
        assert_eq!(rig.session.corruptions(), []);
        assert_eq!(rig.session.responses(), []);
    }
}

/// The closing of the port arrives by the control pipe, past packets that must wait, and ends the capture.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_host_that_floods_and_never_reads_can_close_the_port() {
    let mut rig = connected();
    rig.listen(CAN1, MEGABIT).unwrap();
    rig.with_host(|host, _| host.read(false));
    for _ in 0..1500 {
        let (_, bytes) = rig.session.request(Command::Status);
        rig.with_host(|host, _| host.send(&bytes));
    }
    rig.run_for(100 * MS).unwrap();
    assert!(rig.with_host(|host, _| host.unsent()) > 1000, "nothing had to wait");
    rig.with_host(|host, _| host.close_port());
    rig.run_for(20 * MS).unwrap();
    rig.with_host(|host, _| host.read(true));
    rig.wait_for_port().unwrap();
    rig.greet().unwrap();
    let status = rig.status().unwrap();
    assert!(status.channels.iter().all(|channel| channel.open.is_none()), "{status:?}");
}

/// The device stalls requests that it need not support, and carries on.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn unknown_control_requests_are_refused_and_harm_nothing() {
    let mut rig = connected();
    for (kind, request) in [(0xC0, 1), (0xA1, 0x77), (0x40, 9), (0x80, 6), (0x21, 0x23)] {
        rig.with_host(|host, _| {
            host.control(UsbRequest::new(kind, request, 0x4200, 0, if kind & 0x80 == 0 { 0 } else { 8 }));
        });
        rig.run_for(10 * MS).unwrap();
        let outcome = rig.with_host(|host, _| host.control_outcome());
        // SEND_BREAK is optional in the class; a driver may take either answer.
        let refused = outcome == Some(Outcome::Stalled);
        assert!(
            refused || request == 0x23 && outcome == Some(Outcome::Done(vec![])),
            "{request:#x}: {outcome:?}"
        );
    }
    rig.ask(Command::Status).unwrap();
    assert_eq!(rig.with_host(|host, _| host.counters().stalls), 0);
}

/// Letters are slcan: a terminal program gets its version, and the native protocol works again in the next session.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_terminal_program_finds_slcan_on_the_same_port() {
    let mut rig = connected();
    rig.with_host(|host, _| host.close_port());
    rig.run_for(20 * MS).unwrap();
    rig.wait_for_port().unwrap();
    rig.record_bytes();
    say(&mut rig, b"V\r");
    say(&mut rig, b"N\r");
    let answer = String::from_utf8_lossy(rig.recorded_bytes()).into_owned();
    assert!(answer.starts_with('V') && answer.contains("\rN"), "{answer:?}");
    rig.with_host(|host, _| host.close_port());
    rig.run_for(20 * MS).unwrap();
    rig.wait_for_port().unwrap();
    rig.greet().unwrap();
}
