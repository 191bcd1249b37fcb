//! The bytes of every variant. A change here is a change of the protocol: it touches the version, the
//! documentation and the changelog too.

use cantap_wire::Channel::{Can1, Can2};
use cantap_wire::batch::BatchHeader;
use cantap_wire::framing::MAX_REQUEST;
use cantap_wire::message::{
    ChannelConfig, ChannelStatus, Checksum, Defaults, DeviceMessage, EndReason, Failures, Filter, FrameKind,
    MAX_FILTERS, MAX_SEND, Mode, Modifier, Periodic, RegisterSet, Registers, SessionEnd, Status, Trigger,
    TxFrame, capability, read_send, why_unreadable, write_response,
};
use cantap_wire::record::{
    BusErrorKind, ErrorState, LossStage, MAX_RECORD, TransmitFailure, encode_event, encode_received,
};
use cantap_wire::{
    BitTiming, Channel, Command, Event, Frame, Hello, PROTOCOL_VERSION, Received, Refusal, Reply, Request,
    Response, Stamp,
};
use serde::Serialize;

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().join(" ")
}

fn bytes(value: &impl Serialize) -> String {
    let mut out = [0; 600];
    hex(postcard::to_slice(value, &mut out).unwrap())
}

fn written(result: &Result<Reply, Refusal>) -> String {
    let mut out = [0; 600];
    let len = write_response(5, result, &mut out).unwrap();
    hex(&out[..len])
}

fn frame(text: &str) -> Frame {
    text.parse().unwrap()
}

const TIMING: BitTiming = BitTiming { prescaler: 300, segment1: 13, segment2: 2, jump_width: 1 };

#[test]
fn the_version_is_the_one_that_these_bytes_belong_to() {
    assert_eq!(PROTOCOL_VERSION, 3);
}

#[test]
fn received_frames() {
    let record = |text: &str, channel, stamp, data_omitted, ticks| {
        let mut out = [0; MAX_RECORD];
        let received = Received { channel, frame: frame(text), stamp, data_omitted };
        let len = encode_received(&received, ticks, &mut out);
        hex(&out[..len])
    };
    assert_eq!(record("555#", Can1, Stamp::Exact, false, 576), "80 55 05 80 09");
    assert_eq!(record("555#R2", Can2, Stamp::Exact, false, -1), "d2 55 05 01");
    assert_eq!(record("123#DEADBEEF", Can2, Stamp::Exact, false, 0), "c4 23 01 00 de ad be ef");
    assert_eq!(
        record("1F334455#11", Can1, Stamp::Exact, false, i64::from(i32::MAX)),
        "a1 55 44 33 1f fe ff ff ff 0f 11"
    );
    // Two wraps of a 32-bit timer: a difference has no bound.
    assert_eq!(record("1F334455#11", Can1, Stamp::Exact, false, 2 << 32), "a1 55 44 33 1f 80 80 80 80 40 11");
    assert_eq!(record("555#", Can1, Stamp::Exact, false, i64::MIN), "80 55 05 ff ff ff ff ff ff ff ff ff 01");
    assert_eq!(record("1F334455#11", Can1, Stamp::UpperBound, false, 64), "41 a1 55 44 33 1f 80 01 11");
    assert_eq!(record("123#1122", Can1, Stamp::Omitted, false, 64), "42 82 23 01 11 22");
    assert_eq!(record("123#1122", Can1, Stamp::Exact, true, 1), "44 82 23 01 02");
    assert_eq!(record("123#1122", Can1, Stamp::UpperBound, true, 1), "45 82 23 01 02");
    assert_eq!(record("123#1122", Can1, Stamp::Omitted, true, 1), "46 82 23 01");
    assert_eq!(record("123#1122334455667788_F", Can1, Stamp::Omitted, true, 1), "46 8f 23 01");
}

#[test]
fn events() {
    let channel = Channel::Can2;
    for (event, expected) in [
        (Event::Lost { channel, stage: LossStage::Controller, count: 1, at_least: true }, "00 01 00 01 01"),
        (Event::Lost { channel, stage: LossStage::Queue, count: 300, at_least: false }, "00 01 01 ac 02 00"),
        (Event::Lost { channel, stage: LossStage::Link, count: 1, at_least: false }, "00 01 02 01 00"),
        (Event::Lost { channel, stage: LossStage::Host, count: 1, at_least: false }, "00 01 03 01 00"),
        (Event::BusError { channel, kind: BusErrorKind::Stuff, tec: 1, rec: 200 }, "01 01 00 01 c8"),
        (Event::BusError { channel, kind: BusErrorKind::Form, tec: 0, rec: 0 }, "01 01 01 00 00"),
        (Event::BusError { channel, kind: BusErrorKind::Acknowledgment, tec: 0, rec: 0 }, "01 01 02 00 00"),
        (Event::BusError { channel, kind: BusErrorKind::BitRecessive, tec: 0, rec: 0 }, "01 01 03 00 00"),
        (Event::BusError { channel, kind: BusErrorKind::BitDominant, tec: 0, rec: 0 }, "01 01 04 00 00"),
        (Event::BusError { channel, kind: BusErrorKind::Crc, tec: 0, rec: 0 }, "01 01 05 00 00"),
        (Event::ErrorsSuppressed { channel, count: 128 }, "02 01 80 01"),
        (Event::State { channel, state: ErrorState::Active, tec: 0, rec: 0 }, "03 01 00 00 00"),
        (Event::State { channel, state: ErrorState::Warning, tec: 96, rec: 0 }, "03 01 01 60 00"),
        (Event::State { channel, state: ErrorState::Passive, tec: 128, rec: 0 }, "03 01 02 80 00"),
        (Event::State { channel, state: ErrorState::BusOff, tec: 255, rec: 0 }, "03 01 03 ff 00"),
        (Event::Started { channel }, "04 01"),
        (Event::Stopped { channel: Channel::Can1 }, "05 00"),
        (Event::Transmitted { channel, tag: 1, frame: frame("123#1122") }, "06 01 01 a3 02 02 02 11 22"),
        (
            Event::Transmitted { channel, tag: 1, frame: frame("00000123#R2") },
            "06 01 01 a3 82 80 80 0c 02 00",
        ),
        (Event::TransmitFailed { channel, tag: 2, reason: TransmitFailure::ArbitrationLost }, "07 01 02 00"),
        (Event::TransmitFailed { channel, tag: 2, reason: TransmitFailure::BusError }, "07 01 02 01"),
        (Event::TransmitFailed { channel, tag: 2, reason: TransmitFailure::Aborted }, "07 01 02 02"),
        (Event::TransmitFailed { channel, tag: 2, reason: TransmitFailure::Closed }, "07 01 02 03"),
        (Event::TransmitFailed { channel, tag: 2, reason: TransmitFailure::BusOff }, "07 01 02 04"),
        (Event::SofMark { frame: 2047, doubled: 0 }, "08 ff 0f 00"),
        (Event::SofMark { frame: 0, doubled: 300 }, "08 00 ac 02"),
        (
            Event::TransmitFailed { channel, tag: 2, reason: TransmitFailure::Overtaken { periods: 300 } },
            "07 01 02 05 ac 02",
        ),
    ] {
        let mut out = [0; MAX_RECORD];
        let len = encode_event(&event, 576, &mut out);
        assert_eq!(hex(&out[..len]), format!("{expected} 80 09"), "{event:?}");
    }
}

#[test]
fn commands() {
    let channel = Channel::Can2;
    let config = ChannelConfig { one_shot: true, ..ChannelConfig::listen_only(TIMING) };
    let filter = Filter { extended: true, kind: FrameKind::Remote, id: 300, mask: 1 };
    let frame = frame("123#1122");
    let periodic = Periodic {
        frame,
        period_ticks: 300,
        count: 0,
        modifiers: [
            Modifier::Counter { byte: 1, low_bit: 2, bits: 3 },
            Modifier::Checksum { byte: 1, algorithm: Checksum::Xor },
            Modifier::Checksum { byte: 1, algorithm: Checksum::Sum },
            Modifier::Random { byte: 4 },
        ]
        .into_iter()
        .collect(),
    };
    let tx = |tag, at_ticks| TxFrame { tag, frame, at_ticks };
    for (command, expected) in vec![
        (Command::Hello { protocol: 3 }, "00 03"),
        (Command::Open { channel, config: None }, "01 01 00"),
        (Command::Open { channel, config: Some(config) }, "01 01 01 ac 02 0d 02 01 00 01 00 00 00"),
        (Command::Close { channel }, "02 01"),
        (Command::Status, "03"),
        (Command::Time, "04"),
        (Command::SetFilters { channel, filters: [filter].into_iter().collect() }, "05 01 01 01 01 ac 02 01"),
        (
            Command::Send { channel, frames: [tx(5, None), tx(6, Some(300))].into_iter().collect() },
            "06 01 02 05 a3 02 02 02 11 22 00 06 a3 02 02 02 11 22 01 ac 02",
        ),
        (Command::Abort { channel }, "07 01"),
        (Command::SetPeriodic { channel, slot: 3, entry: None }, "08 01 03 00"),
        (
            Command::SetPeriodic { channel, slot: 3, entry: Some(periodic) },
            "08 01 03 01 a3 02 02 02 11 22 ac 02 00 04 00 01 02 03 01 01 00 01 01 01 02 04",
        ),
        (Command::SetTrigger { channel, slot: 3, entry: None }, "09 01 03 00"),
        (
            Command::SetTrigger { channel, slot: 3, entry: Some(Trigger { filter, reply: frame, count: 9 }) },
            "09 01 03 01 01 01 ac 02 01 a3 02 02 02 11 22 09",
        ),
        (Command::Registers { channel }, "0a 01"),
        (Command::Recover { channel }, "0b 01"),
        (Command::Identify { seconds: 3 }, "0c 03"),
        (Command::Reset, "0d"),
        (Command::Bootloader, "0e"),
        (Command::SaveDefaults, "0f"),
        (Command::ClearDefaults, "10"),
        (Command::Configure { channel, config }, "11 01 ac 02 0d 02 01 00 01 00 00 00"),
        (Command::Defaults { channel }, "12 01"),
        (Command::Failures, "13"),
    ] {
        assert_eq!(
            bytes(&Request { id: 300, command: command.clone() }),
            format!("ac 02 {expected}"),
            "{command:?}"
        );
    }
    assert_eq!(bytes(&Checksum::Crc8J1850), "02");
    assert_eq!(bytes(&[FrameKind::Data, FrameKind::Remote, FrameKind::Any]), "00 01 02");
    assert_eq!(bytes(&[Mode::ListenOnly, Mode::Normal, Mode::Loopback, Mode::SilentLoopback]), "00 01 02 03");
}

#[test]
fn replies() {
    let config =
        ChannelConfig { manual_recovery: true, omit_data: true, ..ChannelConfig::listen_only(TIMING) };
    let filter = Filter { extended: true, kind: FrameKind::Remote, id: 300, mask: 1 };
    let hello = Hello {
        protocol: 3,
        firmware: [0, 1, 300],
        board: "ab".try_into().unwrap(),
        serial: "c".try_into().unwrap(),
        channels: 2,
        tick_hz: 12_000_000,
        can_clock_hz: 36_000_000,
        queue_bytes: 98_304,
        tx_queue: 256,
        periodic_slots: 32,
        trigger_slots: 8,
        filter_banks: 28,
        capabilities: capability::TRANSMIT | capability::BOOTLOADER,
    };
    let closed = ChannelStatus {
        open: None,
        state: ErrorState::Active,
        tec: 0,
        rec: 0,
        last_error: None,
        frames: 0,
        lost_controller: 0,
        lost_queue: 0,
        bus_errors: 0,
        transmitted: 0,
        transmit_failures: 0,
        tx_pending: 0,
    };
    let open = ChannelStatus {
        open: Some(config),
        state: ErrorState::Passive,
        tec: 1,
        rec: 2,
        last_error: Some(BusErrorKind::Crc),
        frames: 3,
        lost_controller: 4,
        lost_queue: 5,
        bus_errors: 6,
        transmitted: 7,
        transmit_failures: 8,
        tx_pending: 9,
    };
    let status = Status {
        ticks: 300,
        queue_bytes: 1,
        queue_high_water_bytes: 2,
        bad_requests: 3,
        temperature_decicelsius: Some(-1),
        supply_millivolts: None,
        channels: [closed, open],
    };
    let set = RegisterSet { mcr: 1, msr: 2, tsr: 3, rf0r: 4, ier: 5, esr: 6, btr: 7 };
    for (reply, expected) in [
        (
            Reply::Hello(hello),
            "00 03 00 01 ac 02 02 61 62 01 63 02 80 b6 dc 05 80 a2 95 11 80 80 06 80 02 20 08 1c 11",
        ),
        (Reply::Done, "01"),
        (Reply::Opened(config), "02 ac 02 0d 02 01 00 00 01 01 00"),
        (
            Reply::Status(status),
            "03 ac 02 01 02 03 01 01 00 00 00 00 00 00 00 00 00 00 00 00 00 \
             01 ac 02 0d 02 01 00 00 01 01 00 02 01 02 01 05 03 04 05 06 07 08 09",
        ),
        (Reply::Time(300), "04 ac 02"),
        (Reply::Filters { banks_used: 1, banks_total: 27 }, "05 01 1b"),
        (Reply::Queued { free: 300 }, "06 ac 02"),
        (Reply::Registers(Registers { now: set, at_last_error: None }), "07 01 02 03 04 05 06 07 00"),
        (
            Reply::Registers(Registers { now: set, at_last_error: Some(set) }),
            "07 01 02 03 04 05 06 07 01 01 02 03 04 05 06 07",
        ),
        (
            Reply::Defaults(Defaults { config, filters: [filter].into_iter().collect() }),
            "08 ac 02 0d 02 01 00 00 01 01 00 01 01 01 ac 02 01",
        ),
        (Reply::Failures(Failures { count: 300, last: "ab".try_into().unwrap() }), "09 ac 02 02 61 62"),
    ] {
        let message = DeviceMessage::Response(Response { id: 5, result: Ok(reply.clone()) });
        assert_eq!(bytes(&message), format!("01 05 00 {expected}"), "{message:?}");
        assert_eq!(written(&Ok(reply)), format!("01 05 00 {expected}"), "{message:?}");
    }
}

#[test]
fn refusals() {
    for (refusal, expected) in [
        (Refusal::Protocol { device: 300 }, "00 ac 02"),
        (Refusal::Malformed, "01"),
        (Refusal::NoSession, "02"),
        (Refusal::Unsupported, "03"),
        (Refusal::BadTiming, "04"),
        (Refusal::BadId, "05"),
        (Refusal::BadDlc, "06"),
        (Refusal::BadTag, "07"),
        (Refusal::BadEntry, "08"),
        (Refusal::BadSlot, "09"),
        (Refusal::ChannelOpen, "0a"),
        (Refusal::ChannelClosed, "0b"),
        (Refusal::ListenOnly, "0c"),
        (Refusal::QueueFull { free: 300 }, "0d ac 02"),
        (Refusal::BanksExhausted { needed: 29, available: 28 }, "0e 1d 1c"),
        (Refusal::WouldDisturb, "0f"),
        (Refusal::TooFarAhead, "10"),
        (Refusal::Hardware, "11"),
        (Refusal::NothingSaved, "12"),
        (Refusal::NotBusOff, "13"),
    ] {
        let message = DeviceMessage::Response(Response { id: 5, result: Err(refusal) });
        assert_eq!(bytes(&message), format!("01 05 01 {expected}"), "{message:?}");
        assert_eq!(written(&Err(refusal)), format!("01 05 01 {expected}"), "{message:?}");
    }
}

#[test]
fn batch_headers_and_the_end_of_a_session() {
    let header = BatchHeader { sequence: 300, base_ticks: 1 << 32, frames_before: [128, 1] };
    assert_eq!(bytes(&DeviceMessage::Batch(header)), "00 ac 02 80 80 80 80 10 80 01 01");
    let end = SessionEnd { reason: EndReason::Suspended, header };
    assert_eq!(bytes(&DeviceMessage::Ended(end)), "02 00 ac 02 80 80 80 80 10 80 01 01");
}

/// What a device reads apart must be what the whole type reads.
#[test]
fn frames_to_be_sent_are_read_as_the_request_has_them_and_no_other_request_is() {
    let tx = |tag: u32| TxFrame {
        tag,
        frame: frame(if tag.is_multiple_of(2) { "1F334455#R8_F" } else { "123#DEADBEEF" }),
        at_ticks: tag.is_multiple_of(3).then_some(u64::MAX - u64::from(tag)),
    };
    let read = |request: &[u8]| {
        let mut frames = heapless::Vec::new();
        read_send(request, &mut frames).map(|(id, channel)| (id, channel, frames))
    };
    let encoded = |id, command| {
        let mut out = [0; MAX_REQUEST];
        postcard::to_slice(&Request { id, command }, &mut out).unwrap().to_vec()
    };
    for count in 0..=MAX_SEND as u32 {
        let frames: heapless::Vec<_, MAX_SEND> = (0..count).map(|n| tx(n * 1000)).collect();
        let request = encoded(300, Command::Send { channel: Can2, frames: frames.clone() });
        assert_eq!(read(&request), Some((300, Can2, frames)));
        for cut in 0..request.len() {
            assert_eq!(read(&request[..cut]), None, "{cut} bytes of {count} frames");
        }
    }
    let too_many = MAX_SEND + 1;
    let one_more = [&[5, 6, 0, too_many as u8][..], &[1, 1, 0, 0, 0].repeat(too_many)].concat();
    assert_eq!(read(&one_more), None);
    assert_eq!(read(&encoded(5, Command::Close { channel: Can1 })), None);
}

/// Requests of a client that does not keep to the ranges, byte by byte.
#[test]
fn a_frame_that_cannot_be_is_refused_by_its_fault_and_all_else_as_malformed() {
    let refusal = |text: &str| {
        let request: Vec<u8> = text.split(' ').map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect();
        assert!(postcard::from_bytes::<Request>(&request).is_err(), "{text} is a good request");
        why_unreadable(&request)
    };
    for (text, expected) in [
        // Send: a good frame and one with the standard identifier 800.
        ("05 06 00 02 01 a3 02 01 01 11 00 02 80 10 00 00 00", Refusal::BadId),
        // DLC 16, and two bytes of data for DLC 1.
        ("05 06 00 01 01 a3 02 10 08 01 02 03 04 05 06 07 08 00", Refusal::BadDlc),
        ("05 06 00 01 01 a3 02 01 02 01 02 00", Refusal::BadDlc),
        ("05 08 00 00 01 80 10 00 00 ac 02 00 00", Refusal::BadId),
        ("05 08 00 00 01 a3 02 10 00 ac 02 00 00", Refusal::BadDlc),
        ("05 09 00 00 01 00 02 01 01 80 10 00 00 00", Refusal::BadId),
        // A third channel, a command that does not exist, one that is cut off, and nothing.
        ("05 06 02 00", Refusal::Malformed),
        ("05 7f", Refusal::Malformed),
        ("05 06 00 01 01", Refusal::Malformed),
        ("05", Refusal::Malformed),
    ] {
        assert_eq!(refusal(text), expected, "{text}");
    }
}

/// Every request there can be fits what a device holds.
#[test]
fn the_longest_request_fits() {
    let filter = Filter { extended: true, kind: FrameKind::Any, id: 0x1FFF_FFFF, mask: 0x1FFF_FFFF };
    let filters = [filter; MAX_FILTERS].into_iter().collect();
    let request = Request { id: u16::MAX, command: Command::SetFilters { channel: Can2, filters } };
    assert!(postcard::to_slice(&request, &mut [0; MAX_REQUEST]).is_ok());
}
