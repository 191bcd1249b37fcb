//! One or more of every variant that crosses USB, with its bytes: what the tests pin and what `vectors.json` holds.

use cantap_wire::message::{
    ChannelConfig, ChannelStatus, Checksum, DISTURBANCE_WORD, Defaults, Edge, Edges, Failures, Filter,
    FrameKind, GATEWAY_TAG, GatewayEnd, GatewayRule, GatewayState, GatewayStatus, Modifier, Pass, Periodic,
    RegisterSet, Registers, Role, RuleCounts, Status, Trigger, TxFdFrame, TxFrame, capability,
};
use cantap_wire::record::{BusErrorKind, ErrorState, LossStage, TransmitFailure};
use cantap_wire::{BitTiming, Channel, Command, Event, FdFrame, Frame, Hello, Id, Refusal, Reply};

/// Bytes in the tables' notation.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().join(" ")
}

/// A frame in candump's notation.
pub fn frame(text: &str) -> Frame {
    text.parse().unwrap()
}

fn fd_frame(id: u32, (brs, esi): (bool, bool), data: &[u8]) -> FdFrame {
    FdFrame::new(Id::standard(id).unwrap(), brs, esi, data).unwrap()
}

const TIMING: BitTiming = BitTiming { prescaler: 300, segment1: 13, segment2: 2, jump_width: 1 };

/// Every event, without its time difference.
pub fn events() -> Vec<(Event, &'static str)> {
    let channel = Channel::Can2;
    vec![
        (Event::Lost { channel, stage: LossStage::Controller, count: 1, at_least: true }, "00 01 00 01 01"),
        (Event::Lost { channel, stage: LossStage::Queue, count: 300, at_least: false }, "00 01 01 ac 02 00"),
        (Event::Lost { channel, stage: LossStage::Link, count: 1, at_least: false }, "00 01 02 01 00"),
        (Event::Lost { channel, stage: LossStage::Host, count: 1, at_least: false }, "00 01 03 01 00"),
        (Event::Lost { channel, stage: LossStage::Gateway, count: 1, at_least: false }, "00 01 04 01 00"),
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
        (
            Event::TransmitFailed { channel, tag: GATEWAY_TAG, reason: TransmitFailure::Loop },
            "07 01 80 80 ff ff 0f 06",
        ),
        (Event::Disturbed { channel, ticks: 300 }, "09 01 ac 02"),
    ]
}

/// A gateway's rule in which every field differs.
fn rule() -> GatewayRule {
    GatewayRule {
        filter: Filter { extended: true, kind: FrameKind::Remote, id: 300, mask: 1 },
        pass: Some(Pass {
            extended: false,
            id_and: 0x7FF,
            id_xor: 300,
            dlc_and: 14,
            dlc_xor: 1,
            data_and: [1, 2, 3, 4, 5, 6, 7, 8],
            data_xor: [9, 10, 11, 12, 13, 14, 15, 16],
            modifiers: [
                Modifier::Counter { byte: 1, low_bit: 2, bits: 3 },
                Modifier::Checksum { byte: 2, algorithm: Checksum::Sum },
            ]
            .into_iter()
            .collect(),
            period_ticks: 300,
            delay_ticks: 5,
        }),
    }
}

/// Every command, without the request's id.
pub fn commands() -> Vec<(Command, &'static str)> {
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
    vec![
        (Command::Hello { protocol: 4 }, "00 04"),
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
        (Command::MeasureEdges { channel: None }, "14 00"),
        (Command::MeasureEdges { channel: Some(channel) }, "14 01 01"),
        (Command::Edges, "15"),
        (Command::SetGatewayRule { from: channel, slot: 3, rule: None }, "16 01 03 00"),
        (
            Command::SetGatewayRule {
                from: channel,
                slot: 3,
                rule: Some(GatewayRule { filter, pass: None }),
            },
            "16 01 03 01 01 01 ac 02 01 00",
        ),
        (
            Command::SetGatewayRule { from: channel, slot: 3, rule: Some(rule()) },
            "16 01 03 01 01 01 ac 02 01 01 00 ff 0f ac 02 0e 01 01 02 03 04 05 06 07 08 09 0a 0b 0c 0d 0e 0f 10 \
             02 00 01 02 03 01 02 01 ac 02 05",
        ),
        (Command::StartGateway, "17"),
        (Command::StopGateway, "18"),
        (Command::GatewayStatus { from: channel, first: 16 }, "19 01 10"),
        (Command::GatewayRule { from: channel, slot: 3 }, "1a 01 03"),
        (Command::SaveGateway, "1b"),
        (
            Command::SendFd {
                channel,
                frames: [
                    TxFdFrame { tag: 1, frame: fd_frame(0x123, (true, false), &[1, 2]), at_ticks: None },
                    TxFdFrame { tag: 300, frame: fd_frame(1, (false, true), &[0; 12]), at_ticks: Some(300) },
                ]
                .into_iter()
                .collect(),
            },
            "1c 01 02 01 a3 82 80 80 04 02 01 02 00 ac 02 81 80 80 80 02 0c 00 00 00 00 00 00 00 00 00 00 00 00 01 ac 02",
        ),
        (Command::UnlockDisturbance { word: DISTURBANCE_WORD }, "1d a3 e9 83 a2 0e"),
        (Command::Disturb { channel, at_ticks: 300, bits: 6 }, "1e 01 ac 02 06"),
    ]
}

/// Every reply.
pub fn replies() -> Vec<(Reply, &'static str)> {
    let config =
        ChannelConfig { manual_recovery: true, omit_data: true, ..ChannelConfig::listen_only(TIMING) };
    let filter = Filter { extended: true, kind: FrameKind::Remote, id: 300, mask: 1 };
    let hello = Hello {
        protocol: 4,
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
    let edges = [
        Edge { ticks: 300, dominant: true, unsure: true },
        Edge { ticks: 12, dominant: false, unsure: false },
    ];
    let set = RegisterSet { mcr: 1, msr: 2, tsr: 3, rf0r: 4, ier: 5, esr: 6, btr: 7 };
    vec![
        (
            Reply::Hello(hello),
            "00 04 00 01 ac 02 02 61 62 01 63 02 80 b6 dc 05 80 a2 95 11 80 80 06 80 02 20 08 1c 11",
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
        (Reply::Edges(Edges { ticks: 300, dominant: false, edges: heapless::Vec::new() }), "0a ac 02 00 00"),
        (
            Reply::Edges(Edges { ticks: 300, dominant: true, edges: edges.into_iter().collect() }),
            "0a ac 02 01 02 ac 02 01 01 0c 00 00",
        ),
        (
            Reply::Gateway(GatewayStatus {
                state: GatewayState::Ended(GatewayEnd::ChannelClosed),
                standalone: true,
                from: Channel::Can2,
                unmatched: 300,
                waiting: 4,
                rules: 17,
                first: 16,
                counts: [RuleCounts { matched: 300, sent: 1, overtaken: 2, lost: 3, failed: 4 }]
                    .into_iter()
                    .collect(),
            }),
            "0b 02 01 01 01 ac 02 04 11 10 01 ac 02 01 02 03 04",
        ),
        (
            Reply::GatewayRule(rule()),
            "0c 01 01 ac 02 01 01 00 ff 0f ac 02 0e 01 01 02 03 04 05 06 07 08 09 0a 0b 0c 0d 0e 0f 10 \
             02 00 01 02 03 01 02 01 ac 02 05",
        ),
    ]
}

/// Every refusal.
pub fn refusals() -> Vec<(Refusal, &'static str)> {
    vec![
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
        (Refusal::NotMeasuring, "14"),
        (Refusal::NotGranted { needs: Role::Send }, "15 02"),
        (Refusal::Held, "16"),
        (Refusal::OtherSettings, "17"),
        (Refusal::NoBoard, "18"),
        (Refusal::NotNormal, "19"),
        (Refusal::GatewayRunning, "1a"),
        (Refusal::DisturbanceLocked, "1b"),
        (Refusal::TooOften, "1c"),
        (Refusal::TooLate, "1d"),
    ]
}
