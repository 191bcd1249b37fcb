//! The same conversation with the firmware's logic running natively (`virtual:`) and with its ELF on the emulated board
//! (`emu:`): what one answers the other must answer too, and both capture the same log alike.
#![cfg(all(feature = "emu", feature = "virtual"))]

use std::path::{Path, PathBuf};
use std::time::Duration;

use cantap::device::Address;
use cantap::wire::message::{ChannelConfig, Filter, FrameKind, Hello, Mode, TxFrame};
use cantap::wire::{BitTiming, Command, Frame, Refusal, Reply};
use cantap::{Channel, Device, DeviceError};

const CHANNEL: Channel = Channel::Can1;
const BITRATE_BPS: u32 = 500_000;

/// The default board's ELF: `CANTAP_FIRMWARE_ELF`, or where `cargo xtask firmware` puts it.
fn elf() -> Option<PathBuf> {
    if let Some(path) = std::env::var_os("CANTAP_FIRMWARE_ELF") {
        return Some(PathBuf::from(path));
    }
    let built = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/firmware/cantap-olimex-p405.elf");
    if built.exists() {
        return Some(built);
    }
    eprintln!("SKIPPED: there is no {}; run `cargo xtask firmware` first", built.display());
    None
}

/// The virtual and the emulated device with the same options.
fn both(options: &str) -> Option<[Device; 2]> {
    let emulated = format!("emu:{},{options}", elf()?.display());
    let addresses = [format!("virtual:{options}"), emulated];
    Some(addresses.map(|address| Device::open(&address.parse::<Address>().unwrap()).unwrap()))
}

fn config(mode: Mode) -> ChannelConfig {
    let timing = BitTiming::choose(36_000_000, BITRATE_BPS, None).unwrap();
    ChannelConfig { mode, ..ChannelConfig::listen_only(timing) }
}

/// What must be equal of an answer: all of it but times, measured values, and what names the device.
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
fn both_devices_answer_alike() {
    let Some([native, emulated]) = both("load=0") else { return };
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

/// Frames with their channels, and their times in microseconds after the first.
fn capture(device: &Device, count: usize) -> Vec<(u8, Frame, i64)> {
    for channel in Channel::ALL {
        device.listen(channel, BITRATE_BPS).unwrap();
    }
    let mut records = device.records();
    let mut frames = Vec::new();
    while frames.len() < count {
        let batch = records.next_batch(Duration::from_secs(20)).unwrap().unwrap();
        assert!(!batch.is_empty(), "{} frames, and nothing more", frames.len());
        let new = batch.iter().filter_map(|record| Some((record.channel, *record.frame()?, record.time_ns)));
        frames.extend(new);
    }
    let first = frames.first().map_or(0, |frame| frame.2);
    frames.into_iter().map(|(channel, frame, at)| (channel, frame, (at - first) / 1000)).collect()
}

#[test]
fn both_devices_capture_a_log_alike() {
    let directory = tempfile::tempdir().unwrap();
    let log = directory.path().join("both.log");
    // The first frame comes when both channels are surely open.
    let numbered = (0..200_u64).map(|n| {
        let (at, interface, id) = (200_000 + n * 700, n % 2, (n * 0x0012_3457) & 0x1FFF_FFFF);
        format!("(0.{at:06}) can{interface} {id:08X}#{n:016X}\n")
    });
    let first = ["(0.000000) can0 000#\n", "(0.000000) can1 000#\n"].map(str::to_owned);
    let lines: String = first.into_iter().chain(numbered).collect();
    std::fs::write(&log, lines).unwrap();
    let Some([native, emulated]) = both(&format!("log={}", log.display())) else { return };
    let numbered = |device: &Device| {
        let mut frames = capture(device, 200);
        frames.retain(|(_, frame, _)| frame.id().is_extended());
        frames
    };
    let [one, other] = [numbered(&native), numbered(&emulated)];
    assert!(one.len().min(other.len()) >= 190, "{} and {}", one.len(), other.len());
    for (native, emulated) in one.iter().zip(&other) {
        assert_eq!((native.0, native.1), (emulated.0, emulated.1));
        let apart = (native.2 - one[0].2) - (emulated.2 - other[0].2);
        // The emulated device's clock is mapped to a wall clock that it does not keep up with.
        assert!(apart.abs() < 20_000, "{native:?} and {emulated:?}");
    }
}
