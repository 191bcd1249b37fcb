//! What the firmware's ELF does on request: filters, bit rates, replies, periods.

use crate::common;

use cantap_emu::bus::{BitTime, Node};
use cantap_emu::machine::Setup;
use cantap_emu::timing::Bound;
use cantap_emu::traffic::{Kind, Script, Traffic};
use cantap_emu::usb_host::Timing;
use cantap_sim::board::{self, CLOCK};
use cantap_sim::drive;
use cantap_sim::rig::{MS, Rig, timing};
use cantap_sim::stream::join;
use cantap_wire::message::{ChannelConfig, Filter, FrameKind};
use cantap_wire::{Channel, Command, Event, Frame};

const MEGABIT: u32 = 1_000_000;
use Channel::{Can1, Can2};

fn connected() -> Rig {
    connected_under(common::bound())
}

/// A board under a bound of time.
fn connected_under(bound: Bound) -> Rig {
    let mut rig = Rig::new(common::firmware(), Setup { bound, ..board::setup() }, Timing::hasty(CLOCK));
    rig.connect().unwrap();
    rig
}

/// Longer emulation would add nothing: these are 100 replies at different phases of the other channel's traffic.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_reply_starts_within_50_us_even_with_the_other_channel_full() {
    for bound in Bound::ALL {
        let mut rig = connected_under(bound);
        join(&mut rig, &[Can1]).unwrap();
        rig.listen(Can2, MEGABIT).unwrap();
        let from = rig.now();
        rig.add_traffic(Can2, MEGABIT, Traffic::new(Kind::Std0, 1, 100.0, from, from + 90 * MS));
        let latency = drive::reply_latency(&mut rig).unwrap().expect("every call has its reply");
        eprintln!("{bound}: reply latency {latency:?}");
        assert!(latency.min_us >= 3.0 && latency.max_us <= 50.0, "{bound}: {latency:?}");
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn periodic_frames_keep_their_period() {
    for bound in Bound::ALL {
        let mut rig = connected_under(bound);
        join(&mut rig, &[Can1]).unwrap();
        rig.listen(Can2, MEGABIT).unwrap();
        let from = rig.now();
        rig.add_traffic(Can2, MEGABIT, Traffic::new(Kind::Mix, 1, 100.0, from, from + 110 * MS));
        let jitter = drive::periodic_jitter(&mut rig, 1000).unwrap().expect("all were sent");
        eprintln!("{bound}: periodic jitter {jitter:?}");
        assert!(jitter.min_us >= -2.0 && jitter.max_us <= 2.0, "{bound}: {jitter:?}");
    }
}

/// 6150 frames a second on each bus, 78 % of it: none is left out, and one that is due together with others waits for some of them, 0.13 ms
/// each.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn all_periodic_entries_of_both_channels_keep_their_periods() {
    let mut rig = connected();
    join(&mut rig, &[Can1, Can2]).unwrap();
    let tables = drive::periodic_tables(&mut rig, 5_000, 300_000).unwrap().expect("no frame is left out");
    eprintln!("full tables {tables:?}");
    assert_eq!(tables.wrong, 0);
    assert!(tables.late.max_us <= 2_000.0, "{tables:?}");
    let failed = |(_, event): &&(u64, Event)| matches!(event, Event::TransmitFailed { .. });
    assert_eq!(rig.events().iter().filter(failed).count(), 0);
    let confirmed = |(_, event): &&(u64, Event)| matches!(event, Event::Transmitted { .. });
    assert!(rig.events().iter().filter(confirmed).count() >= tables.frames);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn hardware_filters_accept_and_reject() {
    let mut rig = connected();
    let filter = |extended, kind, id, mask| Filter { extended, kind, id, mask };
    let filters = [
        filter(false, FrameKind::Data, 0x123, 0x7FF),
        filter(false, FrameKind::Any, 0x400, 0x700),
        filter(true, FrameKind::Remote, 0x1234_5678, 0x1FFF_FFFF),
        filter(true, FrameKind::Any, 0x1000_0000, 0x1F00_0000),
    ];
    let texts = [
        "123#",
        "123#R",
        "124#",
        "400#R",
        "4FF#00",
        "500#",
        "00000123#",
        "12345678#R1",
        "12345678#",
        "10ABCDEF#",
        "11000000#",
        "00000400#",
    ];
    let wanted: Vec<Frame> = texts.iter().map(|text| text.parse().unwrap()).collect();
    let wanted = wanted.iter().filter(|frame| filters.iter().any(|filter| filter.matches(frame))).count();
    assert_eq!(wanted, 5);
    for channel in [Can1, Can2] {
        rig.ask(Command::SetFilters { channel, filters: filters.into_iter().collect() }).unwrap();
        // Not through the books, which expect every frame on the bus.
        let config = ChannelConfig::listen_only(timing(MEGABIT).unwrap());
        rig.ask(Command::Open { channel, config: Some(config) }).unwrap();
        let from = rig.now() + MS;
        let frames =
            texts.iter().zip(0..).map(|(text, n)| (from + n * MS / 4, text.parse().unwrap())).collect();
        let mut board = rig.machine.board();
        let wire = &mut board.wires[channel.index()];
        wire.add(Node::new(BitTime::of_rate(MEGABIT, CLOCK)));
        wire.add(Node::new(BitTime::of_rate(MEGABIT, CLOCK)).with_source(Script::new(frames)));
        drop(board);
        rig.run_for(6 * MS).unwrap();
        let status = rig.status().unwrap().channels[channel.index()];
        assert_eq!((status.frames as usize, status.bus_errors), (wanted, 0), "{channel:?}");
        rig.ask(Command::Close { channel }).unwrap();
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn every_cia_rate_is_heard_and_its_double_is_not() {
    let mut rig = connected();
    let mut added = false;
    for rate in [1_000_000, 800_000, 500_000, 250_000, 125_000, 100_000, 50_000, 20_000] {
        let from = rig.now() + MS;
        let ms = 12_000_000 / u64::from(rate) + 4;
        let traffic = Traffic::new(Kind::Mix, u64::from(rate), 80.0, from, from + 3 * ms * MS);
        if added {
            rig.change_traffic(Can1, BitTime::of_rate(rate, CLOCK), Some(Box::new(traffic)));
        } else {
            rig.add_traffic(Can1, rate, traffic);
            added = true;
        }
        let mut before = rig.status().unwrap().channels[0];
        for (listen_at, heard) in [(rate, true), (if rate == 1_000_000 { 500_000 } else { 2 * rate }, false)]
        {
            if timing(listen_at).is_err() || listen_at > 1_000_000 {
                continue;
            }
            let config = ChannelConfig::listen_only(timing(listen_at).unwrap());
            rig.ask(Command::Open { channel: Can1, config: Some(config) }).unwrap();
            rig.run_for(ms * MS).unwrap();
            rig.ask(Command::Close { channel: Can1 }).unwrap();
            let now = rig.status().unwrap().channels[0];
            let (frames, errors) = (now.frames - before.frames, now.bus_errors - before.bus_errors);
            assert_eq!(
                (frames > 3, errors == 0),
                (heard, heard),
                "{rate} heard at {listen_at}: {frames}, {errors}"
            );
            before = now;
        }
        assert_eq!(rig.dominant_bits(Can1), 0, "a listener that drives the bus");
    }
}
