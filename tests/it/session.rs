//! The conversation between host and device, on fakes.

use crate::fakes;

use cantap_firmware::bus::filters::Layout;
use cantap_firmware::bus::queue::RecordQueue;
use cantap_firmware::{QUEUE_BYTES, TICK_HZ};
use cantap_wire::message::{EndReason, Filter, FrameKind, Mode, TxFrame};
use cantap_wire::record::LossStage;
use cantap_wire::{Channel, Command, Event, PROTOCOL_VERSION, Refusal, Reply, Request, Response};
use fakes::{Bench, SMALL_QUEUE, config, encode, numbered};

const CAN1: Channel = Channel::Can1;
const CAN2: Channel = Channel::Can2;

#[test]
fn a_greeting_tells_what_the_device_is() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.say(&[0]);
    let Ok(Reply::Hello(hello)) = bench.ask(Command::Hello { protocol: PROTOCOL_VERSION }) else { panic!() };
    assert_eq!((hello.protocol, hello.channels, hello.tick_hz), (PROTOCOL_VERSION, 2, TICK_HZ));
    assert_eq!((hello.board.as_str(), hello.serial.as_str()), ("fake", "0123456789ABCDEF"));
    assert_eq!(hello.queue_bytes, QUEUE_BYTES as u32);
}

#[test]
fn nothing_is_sent_before_the_host_speaks() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    for _ in 0..100 {
        bench.millisecond();
    }
    assert!(bench.port.packets.is_empty());
}

/// The start of a session takes time; if the clock were read twice, every stamp of the session would be off by the difference.
#[test]
fn stamps_do_not_depend_on_how_long_the_start_of_the_session_takes() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.board.clock.step.set(1000);
    bench.greet();
    bench.ask(Command::Open { channel: CAN1, config: Some(config(Mode::ListenOnly)) }).unwrap();
    bench.board.clock.step.set(0);
    bench.records.clear();
    let at = u64::from(bench.board.clock.now.get());
    bench.receive(CAN1, numbered(1));
    bench.millisecond();
    bench.millisecond();
    assert_eq!(bench.records.last().map(|(ticks, _)| *ticks), Some(at));
}

#[test]
fn another_protocol_version_is_refused_and_changes_nothing() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    assert_eq!(
        bench.ask(Command::Hello { protocol: PROTOCOL_VERSION + 1 }),
        Err(Refusal::Protocol { device: PROTOCOL_VERSION })
    );
    assert!(bench.board.control.iter().all(|control| control.running));
}

#[test]
fn commands_before_the_greeting_are_refused() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.say(&[0]);
    assert_eq!(bench.ask(Command::Status), Err(Refusal::NoSession));
}

/// Nothing is acknowledged on the bus once nobody is listening.
#[test]
fn closing_the_port_silences_both_channels_and_empties_the_queue() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    bench.port.takes = 0;
    bench.receive(CAN1, numbered(1));
    bench.port.open = false;
    bench.millisecond();
    assert!(bench.board.control.iter().all(|control| !control.running));
    bench.port.open = true;
    bench.port.takes = usize::MAX;
    bench.millisecond();
    assert!(bench.records.is_empty() && bench.port.to_device.is_empty());
    // The next host starts afresh.
    bench.greet();
    let Ok(Reply::Status(status)) = bench.ask(Command::Status) else { panic!() };
    assert_eq!((status.channels[0].frames, status.channels[0].open), (0, None));
    assert_eq!(status.queue_bytes, 0);
    assert!(bench.complaints.is_empty(), "{:?}", bench.complaints);
}

#[test]
fn a_stuck_bus_does_not_keep_a_channel_from_closing() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    bench.board.control[0].stuck = true;
    assert_eq!(bench.ask(Command::Close { channel: CAN1 }), Ok(Reply::Done));
    assert_eq!(bench.board.control[0].halts, 1);
}

/// After a reset of the controller the filters may be gone, including the other channel's.
#[test]
fn a_controller_that_was_made_to_leave_has_its_filters_written_again() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.greet();
    let filters = [Filter { extended: false, kind: FrameKind::Any, id: 1, mask: 1 }].into_iter().collect();
    bench.ask(Command::SetFilters { channel: CAN1, filters }).unwrap();
    for channel in Channel::ALL {
        bench.ask(Command::Open { channel, config: Some(config(Mode::Normal)) }).unwrap();
    }
    let written = bench.board.filters.written.clone();
    bench.ask(Command::Close { channel: CAN2 }).unwrap();
    assert_eq!(bench.board.filters.written, written, "it left on its own");
    bench.board.control[0].stuck = true;
    bench.board.control[0].halts_needed = 3;
    bench.ask(Command::Close { channel: CAN1 }).unwrap();
    assert_eq!(bench.board.control[0].halts, 3);
    // Right after the reset, and again once it has left.
    assert_eq!(
        bench.board.filters.written[written.len()..],
        [(); 2].map(|()| written.last().unwrap().clone())
    );
    assert!(bench.board.traffic[0].aborts > 0);
}

/// Nothing counts the frames that came while there were no filters, so the stream must say that some may be missing.
#[test]
fn a_channel_that_was_deaf_behind_the_others_reset_says_so() {
    for cleared in [false, true] {
        let queue = RecordQueue::<SMALL_QUEUE>::new();
        let mut bench = Bench::opened(&queue, Mode::Normal);
        bench.board.filters.written.push(Layout::open());
        bench.board.filters.cleared = cleared;
        bench.board.control[0].stuck = true;
        bench.ask(Command::Close { channel: CAN1 }).unwrap();
        bench.millisecond();
        bench.millisecond();
        let losses: Vec<Event> =
            bench.events().into_iter().filter(|event| matches!(event, Event::Lost { .. })).collect();
        let deaf = Event::Lost { channel: CAN2, stage: LossStage::Controller, count: 0, at_least: true };
        assert_eq!(losses, if cleared { vec![deaf] } else { Vec::new() });
    }
}

/// The reset was given up, ended later and took the filters with it: the channel would be deaf, and nothing would count what it misses.
#[test]
fn a_channel_is_opened_with_the_filters_that_a_late_reset_took() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    bench.board.control[0].stuck = true;
    bench.board.control[0].halts_needed = usize::MAX;
    assert_eq!(bench.ask(Command::Close { channel: CAN1 }), Err(Refusal::Hardware));
    bench.board.control[0].stuck = false;
    assert_eq!(bench.ask(Command::Close { channel: CAN1 }), Ok(Reply::Done));
    bench.board.filters.cleared = true;
    bench.ask(Command::Open { channel: CAN1, config: Some(config(Mode::ListenOnly)) }).unwrap();
    assert_eq!(bench.board.filters.changes, 1);
}

/// A controller without a clock: the host gets an answer, and can try again.
#[test]
fn a_controller_that_does_not_follow_is_refused_in_time() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    bench.board.control[0].stuck = true;
    bench.board.control[0].halts_needed = usize::MAX;
    let from = bench.board.clock.now.get();
    assert_eq!(bench.ask(Command::Close { channel: CAN1 }), Err(Refusal::Hardware));
    let waited_ms = (bench.board.clock.now.get() - from) / (TICK_HZ / 1000);
    assert!((200..=205).contains(&waited_ms), "after {waited_ms} ms");
    bench.say(&[0]);
    assert_eq!(bench.ask(Command::Hello { protocol: PROTOCOL_VERSION }), Err(Refusal::Hardware));
    assert_eq!(bench.ask(Command::Status), Err(Refusal::NoSession));
    bench.board.control[0].halts_needed = 0;
    bench.greet();
    bench.ask(Command::Open { channel: CAN1, config: Some(config(Mode::Normal)) }).unwrap();
}

#[test]
fn refused_commands_say_why_and_change_nothing() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    let frames = [TxFrame { tag: 1, frame: numbered(1), at_ticks: None }].into_iter().collect();
    assert_eq!(bench.ask(Command::Send { channel: CAN1, frames }), Err(Refusal::ListenOnly));
    let open = Command::Open { channel: CAN1, config: Some(config(Mode::Normal)) };
    assert_eq!(bench.ask(open), Err(Refusal::ChannelOpen));
    let filters = heapless::Vec::new();
    assert_eq!(bench.ask(Command::SetFilters { channel: CAN1, filters }), Err(Refusal::ChannelOpen));
    assert_eq!(bench.ask(Command::Recover { channel: CAN1 }), Err(Refusal::NotBusOff));
    bench.ask(Command::Close { channel: CAN1 }).unwrap();
    let mut bad = config(Mode::Normal);
    bad.timing.segment2 = 0;
    assert_eq!(bench.ask(Command::Open { channel: CAN1, config: Some(bad) }), Err(Refusal::BadTiming));
    assert_eq!(bench.ask(Command::Open { channel: CAN1, config: None }), Err(Refusal::NothingSaved));
    let filters =
        [Filter { extended: false, kind: FrameKind::Any, id: 0x800, mask: 0 }].into_iter().collect();
    assert_eq!(bench.ask(Command::SetFilters { channel: CAN1, filters }), Err(Refusal::BadId));
    let filters = [Filter { extended: false, kind: FrameKind::Any, id: 1, mask: 1 }].into_iter().collect();
    assert_eq!(bench.ask(Command::SetFilters { channel: CAN1, filters }), Err(Refusal::WouldDisturb));
    assert_eq!(bench.board.filters.changes, 0);
    assert_eq!(bench.board.control[1].started.len(), 1);
}

/// Noise on the port, half a command, a flood: the device keeps answering after each.
#[test]
fn garbage_is_dropped_and_the_next_command_answered() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.say(&[0xFF; 5000]);
    bench.say(&[1, 2, 3, 0, 0, 0, 7]);
    bench.say(&[0]);
    let status = encode(&Request { id: 99, command: Command::Status });
    bench.say(&status[..status.len() / 2]);
    bench.say(&[0]);
    let Ok(Reply::Status(status)) = bench.ask(Command::Status) else { panic!() };
    assert!(status.bad_requests >= 3, "{}", status.bad_requests);
}

#[test]
fn a_request_behind_something_too_long_and_its_zero_is_answered() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.say(&[0xFF; 1500]);
    bench.say(&[0]);
    let Ok(Reply::Status(status)) = bench.ask(Command::Status) else { panic!() };
    assert_eq!(status.bad_requests, 1);
}

#[test]
fn every_request_of_a_flood_is_answered_while_nothing_is_read() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.port.takes = 0;
    let count = 60;
    for id in 1000..1000 + count {
        bench.say(&encode(&Request { id, command: Command::Time }));
    }
    bench.port.takes = usize::MAX;
    bench.millisecond();
    let answered: Vec<u16> = bench.responses.iter().map(|response| response.id).collect();
    assert_eq!(answered, (1000..1000 + count).collect::<Vec<_>>());
}

/// A full last packet would leave the host waiting for more.
#[test]
fn a_transfer_that_ends_in_a_full_packet_is_ended_by_an_empty_one() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    let mut seen = false;
    for number in 0..200 {
        for _ in 0..number % 80 {
            bench.receive(CAN1, numbered(number));
            bench.pass(1000);
        }
        let before = bench.port.packets.len();
        bench.millisecond();
        bench.millisecond();
        if let Some(full) = bench.port.packets[before..].iter().rposition(|&len| len == 64) {
            assert!(before + full + 1 < bench.port.packets.len(), "a full packet was the last");
            seen |= bench.port.packets.last() == Some(&0);
        }
    }
    assert!(seen, "no transfer ended in a full packet");
}

#[test]
fn saved_defaults_open_a_channel_after_a_power_cycle() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.greet();
    let filters: heapless::Vec<_, 56> =
        [Filter { extended: true, kind: FrameKind::Data, id: 0x123, mask: 0x1FFF_FFFF }]
            .into_iter()
            .collect();
    bench.ask(Command::SetFilters { channel: CAN2, filters }).unwrap();
    bench.ask(Command::Open { channel: CAN2, config: Some(config(Mode::Loopback)) }).unwrap();
    assert_eq!(bench.ask(Command::SaveDefaults), Err(Refusal::ChannelOpen));
    bench.ask(Command::Close { channel: CAN2 }).unwrap();
    bench.ask(Command::SaveDefaults).unwrap();
    let saved = bench.board.chip.saved.clone();

    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.board.chip.saved = saved;
    bench.greet();
    assert_eq!(
        bench.ask(Command::Open { channel: CAN2, config: None }),
        Ok(Reply::Opened(config(Mode::Loopback)))
    );
    let layout = bench.board.filters.written.last().unwrap();
    assert_eq!(layout.used(CAN2), 1);
    assert_ne!(layout.banks[14].unwrap().second, 0);
    assert_eq!(bench.ask(Command::Open { channel: CAN1, config: None }), Err(Refusal::NothingSaved));
    bench.ask(Command::Close { channel: CAN2 }).unwrap();
    bench.ask(Command::ClearDefaults).unwrap();
    assert!(bench.board.chip.saved.is_empty());
}

#[test]
fn a_restart_is_answered_before_it_happens() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    assert_eq!(bench.ask(Command::Reset), Ok(Reply::Done));
    assert_eq!(bench.board.chip.resets, 0);
    for _ in 0..100 {
        bench.millisecond();
    }
    assert_eq!(bench.board.chip.resets, 1);
}

#[test]
fn a_restart_happens_though_the_host_is_gone_as_soon_as_it_is_answered() {
    for command in [Command::Reset, Command::Bootloader] {
        let queue = RecordQueue::<SMALL_QUEUE>::new();
        let mut bench = Bench::opened(&queue, Mode::ListenOnly);
        assert_eq!(bench.ask(command.clone()), Ok(Reply::Done));
        bench.port.open = false;
        for _ in 0..100 {
            bench.millisecond();
        }
        let bootloader = usize::from(matches!(command, Command::Bootloader));
        assert_eq!((bench.board.chip.resets, bench.board.chip.bootloaders), (1, bootloader), "{command:?}");
    }
}

/// Answers to a program that has ended must not reach the next.
#[test]
fn a_greeting_takes_back_the_answers_that_were_not_sent_yet() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.responses.clear();
    bench.port.takes = 0;
    for id in 900..905 {
        bench.say(&encode(&Request { id, command: Command::Time }));
    }
    bench.say(&encode(&Request { id: 950, command: Command::Hello { protocol: PROTOCOL_VERSION } }));
    bench.millisecond();
    bench.port.takes = usize::MAX;
    bench.millisecond();
    let answered: Vec<u16> = bench.responses.iter().map(|response| response.id).collect();
    assert_eq!(answered, [950]);
    assert_eq!(bench.complaints, Vec::<String>::new());
}

#[test]
fn opening_and_closing_one_channel_leaves_the_other_alone() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.ask(Command::Close { channel: CAN1 }).unwrap();
    bench.receive(CAN2, numbered(7));
    bench.ask(Command::Open { channel: CAN1, config: Some(config(Mode::Normal)) }).unwrap();
    bench.millisecond();
    assert_eq!(bench.frames(CAN2), [numbered(7)]);
    assert_eq!(bench.board.control[1].started.len(), 1);
    assert_eq!(bench.board.filters.changes, 0);
    assert_eq!(bench.events(), [Event::Stopped { channel: CAN1 }, Event::Started { channel: CAN1 }]);
}

/// A packet of the last session may still be in the endpoint when the next one begins.
#[test]
fn a_response_is_readable_behind_an_unfinished_message() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.port.from_device.extend([5, 1, 2, 3]);
    bench.greet();
    assert_eq!(bench.complaints, ["Corrupt(Framing(Cobs))"]);
}

/// A mailbox that never reports its end must not keep the channel from closing.
#[test]
fn a_channel_closes_though_a_mailbox_stays_silent() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    let frames = [TxFrame { tag: 1, frame: numbered(1), at_ticks: None }].into_iter().collect();
    bench.ask(Command::Send { channel: CAN1, frames }).unwrap();
    // The controller forgets the frame.
    bench.board.traffic[0].order.clear();
    assert_eq!(bench.ask(Command::Close { channel: CAN1 }), Ok(Reply::Done));
    bench.millisecond();
    bench.millisecond();
    let reason = cantap_wire::record::TransmitFailure::Closed;
    assert_eq!(
        bench.events(),
        [Event::TransmitFailed { channel: CAN1, tag: 1, reason }, Event::Stopped { channel: CAN1 }]
    );
}

/// What is queued when the host falls asleep is delivered when it wakes, followed by the session's end: nothing is missing
/// without being counted.
#[test]
fn a_host_that_wakes_gets_what_was_queued_and_is_told_that_the_session_has_ended() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    let frames = [TxFrame { tag: 1, frame: numbered(9), at_ticks: None }].into_iter().collect();
    bench.port.takes = 0;
    bench.receive(CAN1, numbered(1));
    bench.receive(CAN2, numbered(2));
    bench.say(&encode(&Request { id: 900, command: Command::Send { channel: CAN2, frames } }));
    bench.millisecond();
    bench.receive(CAN1, numbered(3));
    bench.sleep(true);
    bench.millisecond();
    assert!(bench.board.control.iter().all(|control| !control.running));
    let left_at = u64::from(bench.board.clock.now.get());
    for _ in 0..100 {
        bench.millisecond();
    }
    assert!(bench.records.is_empty());
    bench.port.takes = usize::MAX;
    bench.sleep(false);
    bench.say(&encode(&Request { id: 901, command: Command::Time }));
    for _ in 0..3 {
        bench.millisecond();
    }
    assert_eq!(bench.frames(CAN1), [numbered(1), numbered(3)]);
    assert_eq!(bench.frames(CAN2), [numbered(2)]);
    let reason = cantap_wire::record::TransmitFailure::Closed;
    assert_eq!(
        bench.events(),
        [
            Event::TransmitFailed { channel: CAN2, tag: 1, reason },
            Event::Stopped { channel: CAN1 },
            Event::Stopped { channel: CAN2 }
        ]
    );
    let [(ended_at, EndReason::Suspended)] = bench.ends[..] else { panic!("{:?}", bench.ends) };
    assert!(ended_at.abs_diff(left_at) <= u64::from(TICK_HZ / 1000), "{ended_at} is not {left_at}");
    assert_eq!(bench.responses.last(), Some(&Response { id: 901, result: Err(Refusal::NoSession) }));
    assert!(bench.complaints.is_empty(), "{:?}", bench.complaints);

    // It is reported once, and the next session is like any other.
    bench.sleep(true);
    bench.millisecond();
    bench.sleep(false);
    bench.millisecond();
    assert_eq!(bench.ends.len(), 1);
    bench.records.clear();
    bench.greet();
    bench.ask(Command::Open { channel: CAN1, config: Some(config(Mode::ListenOnly)) }).unwrap();
    bench.receive(CAN1, numbered(4));
    bench.millisecond();
    bench.millisecond();
    assert_eq!(bench.frames(CAN1), [numbered(4)]);
}

/// The cable was pulled, or the host lost power while it slept: there is nobody to report to.
#[test]
fn what_was_kept_for_a_sleeping_host_goes_with_it() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.port.takes = 0;
    let before = bench.port.packets.len();
    bench.receive(CAN1, numbered(1));
    bench.sleep(true);
    bench.millisecond();
    bench.port.suspended = false;
    bench.millisecond();
    bench.port.open = true;
    bench.port.takes = usize::MAX;
    bench.millisecond();
    assert!(bench.records.is_empty() && bench.ends.is_empty() && bench.port.packets.len() == before);
    bench.greet();
    let Ok(Reply::Status(status)) = bench.ask(Command::Status) else { panic!() };
    assert_eq!((status.queue_bytes, status.channels[0].open), (0, None));
}

/// A client whose host reconfigured the device still has the port open, and may not know: when it makes a request, it gets what was
/// captured, the reason why there is no more, and the refusal, in this order.
#[test]
fn a_host_that_configured_the_device_anew_gets_the_rest_and_the_reason_when_it_asks() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    bench.port.takes = 0;
    for number in 0..400 {
        bench.receive(Channel::ALL[number as usize % 2], numbered(number));
        bench.pass(1000);
    }
    bench.millisecond();
    bench.port.history.configured += 1;
    bench.port.takes = usize::MAX;
    bench.millisecond();
    assert!(bench.board.control.iter().all(|control| !control.running));
    let left_at = u64::from(bench.board.clock.now.get());
    let sent = bench.port.from_device.len();
    for _ in 0..100 {
        bench.millisecond();
    }
    assert_eq!(bench.port.from_device.len(), sent, "it may be another program that is listening");

    // In one packet each, so that the first is answered before the rest is read.
    bench.say(&encode(&Request { id: 900, command: Command::Time }));
    let early: Vec<u16> = bench.responses.iter().map(|response| response.id).collect();
    assert!(bench.ends.len() == 1 || early.is_empty(), "a refusal before the end ends the client's reading");
    bench.say(&encode(&Request { id: 901, command: Command::Status }));
    for _ in 0..5 {
        bench.millisecond();
    }
    assert_eq!((bench.frames(CAN1).len(), bench.frames(CAN2).len()), (200, 200));
    assert_eq!(bench.events(), [Event::Stopped { channel: CAN1 }, Event::Stopped { channel: CAN2 }]);
    let [(ended_at, EndReason::Configured)] = bench.ends[..] else { panic!("{:?}", bench.ends) };
    assert!(ended_at.abs_diff(left_at) <= u64::from(TICK_HZ / 1000), "{ended_at} is not {left_at}");
    let refused = |id| Response { id, result: Err(Refusal::NoSession) };
    assert_eq!(bench.responses, [refused(900), refused(901)]);
    assert!(bench.complaints.is_empty(), "{:?}", bench.complaints);

    // It may begin again on the same port.
    bench.records.clear();
    bench.greet();
    bench.ask(Command::Open { channel: CAN1, config: Some(config(Mode::ListenOnly)) }).unwrap();
    bench.receive(CAN1, numbered(4));
    bench.millisecond();
    bench.millisecond();
    assert_eq!(bench.frames(CAN1), [numbered(4)]);
}

/// If refusals overtook the rest of a session, the client would stop reading before it.
#[test]
fn no_refusal_overtakes_what_a_session_that_ended_still_has_to_say() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.port.takes = 0;
    for number in 0..1200 {
        bench.receive(CAN1, numbered(number));
        bench.pass(1000);
    }
    bench.sleep(true);
    bench.millisecond();
    bench.sleep(false);
    bench.say(&encode(&Request { id: 900, command: Command::Time }));
    while bench.ends.is_empty() {
        // One transfer at a time.
        bench.port.takes = 1;
        bench.millisecond();
        assert!(bench.responses.is_empty() || !bench.ends.is_empty(), "after {} frames", bench.records.len());
    }
    bench.port.takes = usize::MAX;
    bench.millisecond();
    assert_eq!(bench.responses, [Response { id: 900, result: Err(Refusal::NoSession) }]);
    assert_eq!(bench.frames(CAN1).len(), 1200);
}

/// A program that opens the port after a reconfiguration, or greets the device, is a new one: it gets nothing of the previous session.
#[test]
fn what_was_left_when_the_device_was_configured_anew_is_not_for_the_next_program() {
    for opens in [true, false] {
        let queue = RecordQueue::<SMALL_QUEUE>::new();
        let mut bench = Bench::opened(&queue, Mode::ListenOnly);
        bench.port.takes = 0;
        bench.receive(CAN1, numbered(1));
        bench.millisecond();
        bench.port.history.configured += 1;
        bench.millisecond();
        bench.port.history.opened += u8::from(opens);
        bench.port.takes = usize::MAX;
        bench.millisecond();
        bench.greet();
        let Ok(Reply::Status(status)) = bench.ask(Command::Status) else { panic!() };
        assert_eq!((status.queue_bytes, status.channels[0].open), (0, None));
        assert!(bench.records.is_empty() && bench.ends.is_empty(), "opens: {opens}");
    }
}

/// Without a configuration there are no endpoints: what is left waits for them.
#[test]
fn what_is_left_outlives_a_time_without_a_configuration() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.port.takes = 0;
    bench.receive(CAN1, numbered(1));
    bench.port.history.configured += 1;
    bench.sleep(true);
    for _ in 0..20 {
        bench.millisecond();
    }
    assert!(bench.board.control.iter().all(|control| !control.running));
    bench.port.history.configured += 1;
    bench.sleep(false);
    bench.port.takes = usize::MAX;
    bench.millisecond();
    assert!(bench.records.is_empty());
    assert_eq!(bench.ask(Command::Time), Err(Refusal::NoSession));
    assert_eq!(bench.frames(CAN1), [numbered(1)]);
    assert!(matches!(bench.ends[..], [(_, EndReason::Configured)]), "{:?}", bench.ends);
}
