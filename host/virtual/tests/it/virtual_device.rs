//! The device handle against the firmware's own logic on a simulated bus.

use std::io::Read;
use std::time::{Duration, Instant};

use cantap::autobaud;
use cantap::device::{Device, Link, Ticks};
use cantap::wire::message::{ChannelConfig, Filter, FrameKind, Mode, TxFrame};
use cantap::wire::record::{BusErrorKind, ErrorState, TransmitFailure};
use cantap::{Channel, Direction, Frame, TraceEvent, TraceFrame, TraceRecord};
use cantap_virtual::simbus::Frames;
use cantap_virtual::{Options, Pace, SequenceCheck, open_terminal, start};

const BITRATE: u32 = 1_000_000;

fn options(load_percent: f64, frames: Frames) -> Options {
    Options { load_percent, frames, pace: Pace::Fast, ..Options::default() }
}

fn open(options: Options) -> Device {
    Device::over(start(options).unwrap().into_link(), "virtual").unwrap()
}

fn config(device: &Device, mode: Mode) -> ChannelConfig {
    let timing = device.timing(BITRATE).unwrap();
    ChannelConfig { mode, ..ChannelConfig::listen_only(timing) }
}

/// Takes records, in whole batches, until `enough` returns true; fails after ten seconds.
fn collect(device: &Device, mut enough: impl FnMut(&TraceRecord) -> bool) -> Vec<TraceRecord> {
    let mut records = device.records();
    let mut taken = Vec::new();
    let deadline = Instant::now() + Duration::from_secs(10);
    while Instant::now() < deadline {
        let batch = records.next_batch(Duration::from_millis(100)).unwrap().unwrap_or_default();
        let done = batch.iter().any(&mut enough);
        taken.extend(batch);
        if done {
            return taken;
        }
    }
    panic!("{} records and not what was waited for", taken.len());
}

/// Checks the law of counting on both channels. Returns how much each delivered and lost.
fn check_law(records: &[TraceRecord], options: &Options, heard: [u64; 2]) -> ([u64; 2], [u64; 2]) {
    let mut checks = [0, 1].map(|channel| SequenceCheck::new(options.source(channel)));
    for record in records {
        checks[usize::from(record.channel - 1)].push(record);
    }
    for (check, sent) in checks.iter().zip(heard) {
        assert!(check.holds(sent), "{} delivered + {} lost of {sent}", check.delivered(), check.lost());
    }
    (checks.each_ref().map(SequenceCheck::delivered), checks.each_ref().map(SequenceCheck::lost))
}

#[test]
fn both_channels_saturated_arrive_complete_in_order_and_spaced_by_their_lengths() {
    for frames in [Frames::Std0, Frames::Mix, Frames::Ext8, Frames::Rtr] {
        let options = options(100.0, frames);
        let connection = start(options.clone()).unwrap();
        let witness = connection.witness.clone();
        let device = Device::over(connection.into_link(), "virtual").unwrap();
        for channel in Channel::ALL {
            device.listen(channel, BITRATE).unwrap();
        }
        let mut count = 0;
        let mut records = collect(&device, |_| {
            count += 1;
            count == 20_000
        });
        device.stop().unwrap();
        records.extend(device.records().map(Result::unwrap));
        let (delivered, lost) = check_law(&records, &options, witness.activity().frames);
        assert!(delivered.iter().all(|count| *count > 5000));
        assert_eq!(lost, [0; 2]);
        assert!(records.is_sorted_by_key(|record| record.time_ns));
        for channel in [1, 2] {
            let on_channel: Vec<&TraceRecord> =
                records.iter().filter(|record| record.channel == channel).collect();
            for pair in on_channel.windows(2) {
                let bits = pair[1].frame().unwrap().bus_bits().total();
                let spacing = pair[1].time_ns - pair[0].time_ns;
                assert!((spacing - i64::from(bits) * 1000).abs() <= 170, "{bits} bits in {spacing} ns");
                assert!(matches!(pair[1].event, TraceEvent::Frame { late: false, .. }), "{:?}", pair[1]);
            }
        }
    }
}

/// Stops reading for a while, once.
struct Stalling<R> {
    inner: R,
    from: Instant,
    length: Duration,
}

impl<R: Read> Read for Stalling<R> {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        if self.from.elapsed() > Duration::ZERO && !self.length.is_zero() && Instant::now() > self.from {
            std::thread::sleep(std::mem::take(&mut self.length));
        }
        self.inner.read(out)
    }
}

#[test]
fn a_host_that_stalls_too_long_loses_frames_and_every_one_is_counted() {
    let options = Options { pace: Pace::RealTime, ..options(100.0, Frames::Std0) };
    let connection = start(options.clone()).unwrap();
    let witness = connection.witness.clone();
    let reader = Stalling {
        inner: connection.reader,
        from: Instant::now() + Duration::from_millis(300),
        length: Duration::from_millis(1500),
    };
    let link = Link::new(reader, connection.writer).keeping(connection.device);
    let device = Device::over(link, "virtual").unwrap();
    for channel in Channel::ALL {
        device.listen(channel, BITRATE).unwrap();
    }
    std::thread::sleep(Duration::from_millis(2200));
    let status = device.stop().unwrap();
    let records: Vec<TraceRecord> = device.records().map(Result::unwrap).collect();
    let (_, lost) = check_law(&records, &options, witness.activity().frames);
    assert!(lost.iter().all(|count| *count > 1000), "{lost:?}");
    assert_eq!(status.channels.map(|channel| u64::from(channel.lost_queue)), lost);
    assert!(status.queue_high_water_bytes > 90_000);
}

#[test]
fn frames_are_sent_confirmed_and_lose_arbitration_to_lower_identifiers() {
    let device = open(Options { pace: Pace::RealTime, ..options(30.0, Frames::Std8) });
    let transmissions = device.transmissions();
    device.open_channel(Channel::Can1, Some(config(&device, Mode::Normal))).unwrap();
    let frame: Frame = "7FF#DEADBEEF".parse().unwrap();
    device.send(Channel::Can1, &[TxFrame { tag: 42, frame, at_ticks: None }]).unwrap();
    let sent = transmissions.recv_timeout(Duration::from_secs(5)).unwrap();
    assert_eq!((sent.channel, sent.tag, sent.result), (Channel::Can1, 42, Ok(frame.into())));
    collect(&device, |record| {
        record.event == TraceEvent::Frame { frame: frame.into(), direction: Direction::Tx, late: false }
    });
    let refused = device.send(Channel::Can2, &[TxFrame { tag: 1, frame, at_ticks: None }]).unwrap_err();
    assert_eq!(refused.to_string(), "the device refused: the channel is closed; open it first");
}

#[test]
fn in_loopback_a_device_hears_itself_and_nothing_of_the_bus() {
    let device = open(options(100.0, Frames::Std8));
    device.open_channel(Channel::Can2, Some(config(&device, Mode::SilentLoopback))).unwrap();
    let frame: Frame = "123#R3".parse().unwrap();
    device.send(Channel::Can2, &[TxFrame { tag: 1, frame, at_ticks: None }]).unwrap();
    let heard = collect(&device, |record| {
        record.event == TraceEvent::Frame { frame: frame.into(), direction: Direction::Rx, late: false }
    });
    assert!(heard.len() <= 2, "{heard:?}");
}

#[test]
fn two_channels_on_one_wire_hear_each_other() {
    let device = open(Options { joined: true, ..options(0.0, Frames::Std8) });
    for channel in Channel::ALL {
        device.open_channel(channel, Some(config(&device, Mode::Normal))).unwrap();
    }
    let frame: Frame = "1F334455#1122334455667788".parse().unwrap();
    device.send(Channel::Can1, &[TxFrame { tag: 1, frame, at_ticks: None }]).unwrap();
    let event = TraceEvent::Frame { frame: frame.into(), direction: Direction::Rx, late: false };
    collect(&device, |record| record.channel == 2 && record.event == event);
}

/// According to the bus, the controllers did not drive a single dominant bit.
#[test]
fn whatever_only_listens_never_drives_the_bus() {
    let pace = Pace::RealTime;
    let bus = Options { bitrate_bps: Some(250_000), pace, ..options(60.0, Frames::Mix) };
    let connection = start(bus).unwrap();
    let witness = connection.witness.clone();
    let device = Device::over(connection.into_link(), "virtual").unwrap();
    let normal = config(&device, Mode::Normal);
    for channel in Channel::ALL {
        device.configure(channel, normal).unwrap();
    }
    device.save_defaults().unwrap();
    assert_eq!(device.defaults(Channel::Can2).unwrap().unwrap().config, normal);
    let found =
        autobaud::search(&device, Channel::Can1, &autobaud::Limits::default(), &mut |_| true).unwrap();
    assert!(matches!(found, autobaud::Outcome::Found { bitrate_bps: 250_000, .. }), "{found:?}");
    // At the right bit rate, and at a wrong one.
    device.listen(Channel::Can1, 250_000).unwrap();
    device.listen(Channel::Can2, BITRATE).unwrap();
    let mut count = 0;
    collect(&device, |_| {
        count += 1;
        count == 500
    });
    assert_eq!(witness.activity().driven, [0, 0]);
    device.close_channel(Channel::Can1).unwrap();
    let timing = device.timing(250_000).unwrap();
    device.open_channel(Channel::Can1, Some(ChannelConfig { timing, ..normal })).unwrap();
    let mut count = 0;
    collect(&device, |_| {
        count += 1;
        count == 50
    });
    let heard = witness.activity();
    assert!(heard.driven[0] > 0 && heard.driven[1] == 0, "{heard:?}");
}

#[test]
fn the_wrong_bit_rate_shows_as_bus_errors() {
    let device = open(Options { bitrate_bps: Some(250_000), ..options(50.0, Frames::Std8) });
    device.listen(Channel::Can1, BITRATE).unwrap();
    collect(&device, |record| {
        matches!(record.event, TraceEvent::BusError { kind: Some(BusErrorKind::Stuff), .. })
    });
    let status = device.status().unwrap();
    assert_eq!(status.channels[0].frames, 0);
    // A silent controller's counters do not change.
    assert_eq!((status.channels[0].tec, status.channels[0].rec), (0, 0));
}

#[test]
fn without_an_acknowledge_a_sender_becomes_passive_and_aborts_on_request() {
    let device = open(Options { acknowledge: false, ..options(0.0, Frames::Std8) });
    device.open_channel(Channel::Can1, Some(config(&device, Mode::Normal))).unwrap();
    let frame: Frame = "100#01".parse().unwrap();
    device.send(Channel::Can1, &[TxFrame { tag: 7, frame, at_ticks: None }]).unwrap();
    collect(&device, |record| matches!(record.event, TraceEvent::State { state: ErrorState::Passive, .. }));
    device.abort(Channel::Can1).unwrap();
    let aborted = TraceEvent::TransmitFailed { tag: 7, reason: TransmitFailure::Aborted };
    collect(&device, |record| record.event == aborted);
}

#[test]
fn filters_let_pass_what_they_should_and_nothing_else() {
    let device = open(options(80.0, Frames::Mix));
    let filters = [
        Filter { extended: false, kind: FrameKind::Data, id: 0x123, mask: 0x70F },
        Filter { extended: true, kind: FrameKind::Any, id: 0x0000_0001, mask: 0x0000_0003 },
    ];
    device.set_filters(Channel::Can1, &filters).unwrap();
    device.listen(Channel::Can1, BITRATE).unwrap();
    let mut seen = [0; 2];
    let records = collect(&device, |record| {
        for (seen, filter) in seen.iter_mut().zip(&filters) {
            let classic = record.frame().and_then(TraceFrame::classic);
            *seen += usize::from(classic.is_some_and(|frame| filter.matches(frame)));
        }
        seen.iter().all(|count| *count > 20)
    });
    for record in records {
        let frame = *record.frame().unwrap().classic().unwrap();
        assert!(filters.iter().any(|filter| filter.matches(&frame)), "{frame}");
    }
}

#[cfg(unix)]
#[test]
fn behind_a_pseudo_terminal_it_is_a_serial_port_and_can_be_opened_again() {
    let terminal = open_terminal(Options { pace: Pace::RealTime, ..options(60.0, Frames::Std8) }).unwrap();
    let port = terminal.path().to_owned();
    for _ in 0..3 {
        let device = Device::open(&port).unwrap();
        assert!(matches!(Device::open(&port), Err(cantap::DeviceError::Busy { .. })));
        device.listen(Channel::Can1, BITRATE).unwrap();
        let mut count = 0;
        collect(&device, |_| {
            count += 1;
            count == 500
        });
        let status = device.stop().unwrap();
        assert!(status.channels[0].frames >= 500);
        assert_eq!(device.counters().channels[0].lost(), 0);
    }
    drop(terminal);
    assert!(Device::open(&port).is_err());
}

/// A board's port comes back with the same name, and with what was saved in its flash.
#[cfg(unix)]
#[test]
fn behind_a_pseudo_terminal_it_comes_back_after_a_reset_and_not_from_the_bootloader() {
    let (pace, started) = (Pace::RealTime, Instant::now());
    let terminal = open_terminal(Options { pace, ..options(60.0, Frames::Std8) }).unwrap();
    let port = terminal.path().to_owned();
    let device = Device::open(&port).unwrap();
    let normal = config(&device, Mode::Normal);
    device.configure(Channel::Can1, normal).unwrap();
    device.save_defaults().unwrap();
    device.listen(Channel::Can1, BITRATE).unwrap();
    std::thread::sleep(Duration::from_millis(300));
    device.reset().unwrap();
    let deadline = Instant::now() + Duration::from_secs(5);
    // A program that has it open finds that there is no session any more.
    while device.status().is_ok() {
        assert!(Instant::now() < deadline, "it was not restarted");
        std::thread::sleep(Duration::from_millis(5));
    }
    drop(device);
    let device = Device::open(&port).unwrap();
    // The firmware's time started over.
    let since_reset = Duration::from_millis(device.time().unwrap() / 12_000);
    assert!(since_reset + Duration::from_millis(300) < started.elapsed() && terminal.is_running());
    assert_eq!(device.defaults(Channel::Can1).unwrap().unwrap().config, normal);
    assert!(device.status().unwrap().channels.iter().all(|channel| channel.open.is_none()));
    device.bootloader().unwrap();
    let deadline = Instant::now() + Duration::from_secs(5);
    while terminal.is_running() {
        assert!(Instant::now() < deadline, "it is still there");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_log_is_replayed_at_its_own_times() {
    let file = tempfile::NamedTempFile::with_suffix(".log").unwrap();
    let lines = "(100.000000) can0 123#11\n(100.000500) can1 456#22\n(100.010000) can0 124#33\n";
    std::fs::write(file.path(), lines).unwrap();
    let options: Options = format!("pace=fast,log={}", file.path().display()).parse().unwrap();
    let device = open(options);
    for channel in Channel::ALL {
        device.listen(channel, BITRATE).unwrap();
    }
    let mut count = 0;
    let records = collect(&device, |_| {
        count += 1;
        count == 3
    });
    let of = |channel| records.iter().filter(move |record: &&TraceRecord| record.channel == channel);
    let texts = |channel| of(channel).map(|record| record.frame().unwrap().to_string()).collect::<Vec<_>>();
    assert_eq!((texts(1), texts(2)), (vec!["123#11".into(), "124#33".into()], vec!["456#22".into()]));
    let times: Vec<i64> = of(1).map(|record| record.time_ns).collect();
    assert!((times[1] - times[0] - 10_000_000).abs() < 5000, "{times:?}");
}

/// One channel's errors and state changes until `enough`, and the device's own count of errors.
fn errors_of(bus: Options, frames: &[&str]) -> (Vec<TraceEvent>, u32) {
    let device = open(bus);
    device.open_channel(Channel::Can1, Some(config(&device, Mode::Normal))).unwrap();
    let frames: Vec<TxFrame> = (1..)
        .zip(frames)
        .map(|(tag, text)| TxFrame { tag, frame: text.parse().unwrap(), at_ticks: None })
        .collect();
    device.send(Channel::Can1, &frames).unwrap();
    std::thread::sleep(Duration::from_millis(30));
    device.close_channel(Channel::Can1).unwrap();
    let errors = device.stop().unwrap().channels[0].bus_errors;
    let events = device.records().map(|record| record.unwrap().event);
    (events.filter(|event| !matches!(event, TraceEvent::Frame { .. })).collect(), errors)
}

#[test]
fn errors_states_and_recovery_are_told_in_order_and_every_error_counted() {
    use ErrorState::{Active, BusOff, Passive, Warning};
    let quiet = || options(0.0, Frames::Std8);
    let (events, errors) = errors_of(Options { disturb: 32, ..quiet() }, &["100#01"]);
    assert_eq!(errors, 32);
    let states: Vec<_> = events
        .iter()
        .filter_map(|event| match event {
            TraceEvent::State { state, counters } => Some((*state, counters.map(|(tec, _)| tec))),
            _ => None,
        })
        .collect();
    assert_eq!(states, [(Warning, Some(96)), (Passive, Some(128)), (BusOff, Some(255)), (Active, Some(0))]);
    let mut kinds = Vec::new();
    let mut counted = 0;
    for event in &events {
        match event {
            TraceEvent::BusError { kind, counters } => {
                kinds.extend(*kind);
                counted += 1;
                // Eight for each, starting with the first.
                assert_eq!(
                    counters.map(|(tec, _)| u32::from(tec)),
                    Some((counted * 8).min(255)),
                    "{events:?}"
                );
            }
            TraceEvent::ErrorsSuppressed { count } => counted += *count,
            _ => {}
        }
    }
    assert_eq!(counted, errors);
    assert!(kinds.contains(&BusErrorKind::BitDominant) && kinds.contains(&BusErrorKind::BitRecessive));
    let (events, errors) = errors_of(Options { acknowledge: false, ..quiet() }, &["100#01"]);
    let suppressed: u32 = events
        .iter()
        .map(|event| match event {
            TraceEvent::ErrorsSuppressed { count } => *count,
            TraceEvent::BusError { kind, .. } => {
                assert_eq!(*kind, Some(BusErrorKind::Acknowledgment));
                1
            }
            _ => 0,
        })
        .sum();
    assert_eq!(suppressed, errors);
    // A lone node stays error passive (ISO 11898-1:2015, 12.1.4.2), however long.
    assert!(!events.iter().any(|event| matches!(event, TraceEvent::State { state: BusOff, .. })));
}

/// Like the board (`sim/tests/it/live_bus.rs`): initialisation mode does not affect them.
#[test]
fn error_counters_outlive_closing_and_opening() {
    let device = open(Options { acknowledge: false, ..options(0.0, Frames::Std8) });
    device.open_channel(Channel::Can1, Some(config(&device, Mode::Normal))).unwrap();
    let frame: Frame = "100#01".parse().unwrap();
    device.send(Channel::Can1, &[TxFrame { tag: 1, frame, at_ticks: None }]).unwrap();
    let deadline = Instant::now() + Duration::from_secs(10);
    while device.status().unwrap().channels[0].tec < 128 {
        assert!(Instant::now() < deadline);
    }
    device.abort(Channel::Can1).unwrap();
    device.close_channel(Channel::Can1).unwrap();
    device.open_channel(Channel::Can1, Some(config(&device, Mode::ListenOnly))).unwrap();
    // The firmware reads the counters once a millisecond.
    std::thread::sleep(Duration::from_millis(30));
    let state = device.status().unwrap().channels[0];
    assert_eq!((state.tec, state.state), (128, ErrorState::Passive));
}

#[test]
fn a_channel_with_manual_recovery_stays_off_until_it_is_told_to_come_back() {
    let device = open(Options { disturb: 32, ..options(0.0, Frames::Std8) });
    let transmissions = device.transmissions();
    let manual = ChannelConfig { manual_recovery: true, ..config(&device, Mode::Normal) };
    device.open_channel(Channel::Can1, Some(manual)).unwrap();
    let refused = device.recover(Channel::Can1).unwrap_err().to_string();
    assert!(refused.contains("not bus-off"), "{refused}");
    let send = |tag| {
        let frame: Frame = "100#01".parse().unwrap();
        device.send(Channel::Can1, &[TxFrame { tag, frame, at_ticks: None }]).unwrap();
        let end = transmissions.recv_timeout(Duration::from_secs(5)).unwrap();
        (end.tag, end.result.map(|_| ()))
    };
    assert_eq!(send(1), (1, Err(TransmitFailure::BusOff)));
    // It does not forget that it is bus-off: frames fail immediately, with the reason.
    assert_eq!(send(2), (2, Err(TransmitFailure::BusOff)));
    assert_eq!(device.status().unwrap().channels[0].state, ErrorState::BusOff);
    let mut recovery = cantap::recovery::Recovery::new(Duration::from_millis(40));
    let asked = Instant::now();
    let recovered = loop {
        let recovered = recovery.look(&device).unwrap();
        if !recovered.is_empty() {
            break recovered;
        }
        assert!(asked.elapsed() < Duration::from_secs(10));
        std::thread::sleep(Duration::from_millis(5));
    };
    assert_eq!(recovered, [Channel::Can1]);
    assert!(asked.elapsed() >= Duration::from_millis(40));
    assert_eq!(send(3), (3, Ok(())));
    assert_eq!(device.status().unwrap().channels[0].state, ErrorState::Active);
}

#[test]
fn the_shortest_period_is_the_firmwares() {
    let firmware_us = cantap_firmware::bus::periodic::MIN_PERIOD_TICKS / cantap_firmware::TICKS_PER_US;
    assert_eq!(cantap::periodic::SHORTEST_PERIOD_US, u64::from(firmware_us));
}

#[test]
fn a_crystal_that_is_off_shows_against_usb_frames() {
    let device = open(Options { crystal_ppm: -80.0, ..options(0.0, Frames::Std0) });
    let deadline = Instant::now() + Duration::from_secs(10);
    let map = loop {
        let now = Ticks(device.time().unwrap());
        let map = device.clock_map();
        if map.frames().trust(now).is_ok() && map.frames().marks().count() > 5 {
            break map;
        }
        assert!(Instant::now() < deadline, "{:?}", map.frames().trust(now));
        std::thread::sleep(Duration::from_millis(1));
    };
    // A frame is a millisecond of real time, in which a crystal that is 80 ppm slow has fewer ticks by this number.
    let (mut ticks, mut frames) = (Vec::new(), Vec::new());
    for (at, frame) in map.frames().marks() {
        ticks.push(at.0);
        frames.push(frame.0 / 1_000_000);
    }
    let ticks_per_frame = (ticks[5] - ticks[0]) as f64 / (frames[5] - frames[0]) as f64;
    assert!((ticks_per_frame / 12_000.0 - 1.0 + 80e-6).abs() < 1e-7, "{ticks_per_frame}");
}
