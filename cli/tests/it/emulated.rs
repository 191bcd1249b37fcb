//! The same conversation with the firmware's logic running natively (`virtual:`) and with its ELF on the emulated board
//! (`emu:`): both must answer alike, and both capture the same log alike.
#![cfg(feature = "emu")]

use crate::common;

use std::sync::PoisonError;
use std::time::Duration;

use cantap::bits_on_bus;
use cantap::device::Link;
use cantap::replay::{Pace, Replay};
use cantap::wire::message::{ChannelConfig, Filter, FrameKind, Hello, Mode, TxFrame};
use cantap::wire::{BitTiming, Command, Frame, Refusal, Reply};
use cantap::{Channel, Device, DeviceError};
use cantap_emu::bus::Member;
use cantap_sim::address::Address;

const CHANNEL: Channel = Channel::Can1;
const BITRATE_BPS: u32 = 500_000;

/// The virtual and the emulated device with the same options.
fn both(options: &str) -> [Device; 2] {
    let emulated: Address = format!("{},{options}", common::elf().display()).parse().unwrap();
    let port = emulated.open().unwrap();
    let link = Link::new(port.reader, port.writer).keeping(port.device);
    [cantap_virtual::open(options.parse().unwrap()).unwrap(), Device::over(link, "emulated").unwrap()]
}

fn config(mode: Mode) -> ChannelConfig {
    let timing = BitTiming::choose(36_000_000, BITRATE_BPS, None).unwrap();
    ChannelConfig { mode, ..ChannelConfig::listen_only(timing) }
}

/// The part of an answer that must be equal: everything except times, measured values, and names of the
/// device.
fn comparable(result: Result<Reply, DeviceError>) -> Result<Reply, Refusal> {
    match result {
        Ok(Reply::Status(mut status)) => {
            status.ticks = 0;
            status.queue_high_water_bytes = 0;
            status.temperature_decicelsius = None;
            status.supply_millivolts = None;
            Ok(Reply::Status(status))
        }
        Ok(Reply::Time(_)) => Ok(Reply::Time(0)),
        Ok(reply) => Ok(reply),
        Err(DeviceError::Refused { refusal }) => Err(refusal),
        Err(error) => panic!("{error}"),
    }
}

fn conversation() -> Vec<Command> {
    let channel = CHANNEL;
    let frame: Frame = "123#1122".parse().unwrap();
    let send = |tag| Command::Send {
        channel,
        frames: [TxFrame { tag, frame, at_ticks: None }].into_iter().collect(),
    };
    let filters = |count: u32| Command::SetFilters {
        channel,
        filters: (0..count)
            .map(|id| Filter { extended: true, kind: FrameKind::Data, id, mask: 0x1FFF_FFFF })
            .collect(),
    };
    let mut bad = config(Mode::Normal);
    bad.timing.segment2 = 9;
    vec![
        Command::Status,
        Command::Time,
        send(1),
        filters(3),
        filters(56),
        filters(0),
        Command::Open { channel, config: None },
        Command::Open { channel, config: Some(bad) },
        Command::Open { channel, config: Some(config(Mode::ListenOnly)) },
        send(2),
        filters(1),
        Command::Recover { channel },
        Command::Status,
        Command::Close { channel },
        Command::Close { channel },
        Command::Abort { channel },
        Command::SetPeriodic { channel, slot: 255, entry: None },
        Command::SetTrigger { channel, slot: 255, entry: None },
        Command::Identify { seconds: 1 },
        Command::Hello { protocol: 99 },
    ]
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn both_devices_answer_alike() {
    let [native, emulated] = both("load=0");
    let facts = |hello: &Hello| {
        let queues = (hello.queue_bytes, hello.tx_queue, hello.periodic_slots, hello.trigger_slots);
        (
            hello.protocol,
            hello.firmware,
            hello.channels,
            hello.tick_hz,
            hello.can_clock_hz,
            queues,
            hello.filter_banks,
        )
    };
    assert_eq!(facts(native.hello()), facts(emulated.hello()));
    for command in conversation() {
        let [one, other] = [&native, &emulated].map(|device| match device.request(command.clone()) {
            Err(DeviceError::Protocol { device }) => Err(Refusal::Protocol { device }),
            result => comparable(result),
        });
        assert_eq!(one, other, "{command:?}");
    }
}

const FRAMES: u64 = 400;

/// The log's frame number, by which the captures are compared.
fn number(frame: &Frame) -> u64 {
    u64::from_be_bytes(frame.padded_data())
}

/// Every frame up to the log's last, with its channel and its time in microseconds.
fn capture(device: &Device) -> Vec<(u8, Frame, i64)> {
    for channel in Channel::ALL {
        device.listen(channel, BITRATE_BPS).unwrap();
    }
    let mut records = device.records();
    let mut frames = Vec::new();
    while frames.last().is_none_or(|(_, frame, _)| number(frame) < FRAMES - 1) {
        let batch = records.next_batch(Duration::from_secs(20)).unwrap().unwrap();
        assert!(!batch.is_empty(), "{} frames, and nothing more", frames.len());
        let new = batch
            .iter()
            .filter_map(|record| Some((record.channel, *record.frame()?.classic()?, record.time_ns / 1000)));
        frames.extend(new);
    }
    frames
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn both_devices_capture_a_log_alike() {
    let directory = tempfile::tempdir().unwrap();
    let log = directory.path().join("both.log");
    let lines: Vec<String> = (0..FRAMES)
        .map(|n| {
            let (at, interface, id) = (n * 700, n % 2, (n * 0x0012_3457) & 0x1FFF_FFFF);
            format!("(0.{at:06}) can{interface} {id:08X}#{n:016X}\n")
        })
        .collect();
    std::fs::write(&log, lines.concat()).unwrap();
    let [native, emulated] = both(&format!("log={}", log.display()));
    let [mut one, mut other] = [capture(&native), capture(&emulated)];
    // A busy machine may have opened a channel late, when frames were already waiting: compare what both saw
    // undisturbed.
    let first = number(&one[0].1).max(number(&other[0].1)) + 50;
    for frames in [&mut one, &mut other] {
        frames.retain(|(_, frame, _)| number(frame) >= first);
        frames.sort_by_key(|(channel, ..)| *channel);
    }
    assert_eq!(one.len(), other.len());
    assert!(one.len() > 50, "{}", one.len());
    for (native, emulated) in one.iter().zip(&other) {
        assert_eq!((native.0, native.1), (emulated.0, emulated.1));
        let apart = (native.2 - one[0].2) - (emulated.2 - other[0].2);
        // The emulated device's clock is mapped to a wall clock with which it cannot keep up.
        assert!(apart.abs() < 20_000, "{native:?} and {emulated:?}");
    }
}

/// The whole way: the host's stream, the emulated USB, the firmware's alarm, the bus. Time is slowed down, so that a busy
/// machine does not act as a slow host.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_replay_keeps_the_traces_spacing_and_order_on_the_elf() {
    const MEGABIT: u32 = 1_000_000;
    const CYCLES_PER_US: f64 = 144.0;
    let elf = common::elf();
    for load_percent in [30.0, 90.0] {
        let mut address: cantap_sim::address::Address =
            format!("{},load=0,speed=0.1", elf.display()).parse().unwrap();
        address.manner.witness = true;
        let port = address.open().unwrap();
        let witness = port.device.witness();
        let link = Link::new(port.reader, port.writer).keeping(port.device);
        let device = Device::over(link, "emulated").unwrap();
        let timing = device.timing(MEGABIT).unwrap();
        let config = ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing) };
        device.open_channel(CHANNEL, Some(config)).unwrap();
        let mut replay = Replay::new(&device, Pace::default(), [MEGABIT; 2]).unwrap();
        let mut begin_us = 0.0;
        let mut planned = Vec::new();
        for n in 0..600_u64 {
            let frame: Frame = match n % 3 {
                0 => format!("{:03X}#{n:016X}", n % 0x7FF),
                1 => format!("{:08X}#{n:08X}", n * 0x0012_3457 % 0x1FFF_FFFF),
                _ => format!("{:03X}#R{}", 0x7FF - n % 0x700, n % 9),
            }
            .parse()
            .unwrap();
            let bits = f64::from(bits_on_bus(&frame));
            planned.push((begin_us, frame));
            // A trace's time is the end of a frame, without the three bits of the intermission.
            let end_ns = ((begin_us + bits - 3.0) * 1000.0) as i64;
            assert!(replay.push(end_ns, CHANNEL, frame, |_| true).unwrap());
            begin_us += (bits * 100.0 / load_percent).ceil();
        }
        assert!(replay.finish(|since| since < Duration::from_secs(10)).unwrap());
        let ended = replay.take_ended();
        assert!(ended.len() == planned.len() && ended.iter().all(|end| end.result.is_ok()));
        assert!(ended.iter().map(|end| end.tag).eq(0..planned.len() as u32));
        let accuracy = replay.accuracy();
        drop(replay);
        drop(device);
        let seen = witness.lock().unwrap_or_else(PoisonError::into_inner);
        let ours =
            seen.frames[CHANNEL.index()].iter().filter(|crossed| crossed.sender == Member::Controller(0));
        let crossed: Vec<(f64, Frame)> =
            ours.map(|crossed| (crossed.start as f64 / CYCLES_PER_US, crossed.frame)).collect();
        assert!(crossed.iter().map(|(_, frame)| frame).eq(planned.iter().map(|(_, frame)| frame)));
        let late = crossed.iter().zip(&planned).map(|((start, _), (begin, _))| start - begin);
        let (least, most) = late.fold((f64::MAX, f64::MIN), |(a, b), us| (a.min(us), b.max(us)));
        eprintln!("at {load_percent} %: spacing {:.2} us, by the confirmations {accuracy:?}", most - least);
        assert!(most - least <= 2.0, "at {load_percent} %: {} us", most - least);
        assert!(accuracy.early_us <= 3.5 && accuracy.late_us <= 3.5, "{accuracy:?}");
    }
}
