//! Several devices in one stream: in one order, on one clock, and none waits for one that is gone.

use crate::fake_device;

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use cantap::device::{FollowerReport, FrameDoubt, Happening, NotCommon, Reconnecting, Several};
use cantap::{Channel, Device, DeviceError, TraceEvent, TraceRecord};
use fake_device::{FakeDevice, Fault};

/// Nothing here takes this long, however busy the machine is.
const PATIENCE: Duration = Duration::from_mins(1);
const WAIT: Duration = Duration::from_millis(50);

type Line = Reconnecting<Device, DeviceError>;

fn listen(device: &Device) -> Result<(), DeviceError> {
    Channel::ALL.into_iter().try_for_each(|channel| device.listen(channel, 500_000).map(|_| ()))
}

fn virtual_board(options: &'static str) -> Line {
    Line::new(options, move |_| cantap_virtual::open(options.parse().unwrap()), listen)
}

/// Devices one after the other, each with its fault; after the last there is none for as long as the port is silent.
fn fake_board(faults: &[Fault], silent: Duration) -> Line {
    let mut faults = VecDeque::from(faults.to_vec());
    Line::new(
        "fake",
        move |_| {
            let Some(fault) = faults.pop_front() else {
                std::thread::sleep(silent);
                return Err(DeviceError::NotFound { address: "fake".to_owned() });
            };
            let (link, mut fake) = FakeDevice::new();
            std::thread::spawn(move || fake.run(fault, 40));
            Device::over(link, "fake")
        },
        listen,
    )
}

/// All records until there are enough, and what happened.
fn collect(
    devices: &mut Several<Device, DeviceError>,
    mut enough: impl FnMut(&[TraceRecord], &[usize]) -> bool,
) -> (Vec<TraceRecord>, Vec<usize>) {
    let (mut records, mut gone) = (Vec::new(), Vec::new());
    let started = Instant::now();
    while !enough(&records, &gone) {
        assert!(started.elapsed() < PATIENCE, "{} records, gone {gone:?}", records.len());
        match devices.next(WAIT) {
            (_, Happening::Records(mut batch)) => records.append(&mut batch),
            (board, Happening::Gone(_)) => gone.push(board),
            (_, Happening::Back(_)) => {}
            (_, Happening::Ended) => panic!("nobody has stopped it"),
        }
    }
    devices.stop();
    loop {
        match devices.next(WAIT) {
            (_, Happening::Records(mut batch)) => records.append(&mut batch),
            (_, Happening::Ended) => return (records, gone),
            other => panic!("{other:?}"),
        }
    }
}

fn frames(records: &[TraceRecord], channel: u8) -> u64 {
    records.iter().filter(|record| record.channel == channel && record.frame().is_some()).count() as u64
}

/// Runs two virtual devices for some seconds; returns how well they were on one clock.
fn two_devices() -> FollowerReport {
    let mut devices =
        Several::new(vec![virtual_board("load=20,ppm=40,seed=1"), virtual_board("load=20,ppm=-40,seed=2")]);
    devices.connect().unwrap();
    let started = Instant::now();
    let (records, _) = collect(&mut devices, |_, _| started.elapsed() > Duration::from_secs(8));
    let late = records.windows(2).filter(|pair| pair[0].time_ns > pair[1].time_ns).count();
    // A thread that was held up for long may have sent its records late; that is rare.
    assert!(late <= records.len() / 1000, "{late} of {} are out of order", records.len());
    for (line, board) in devices.lines().zip([0_u8, 1]) {
        for channel in Channel::ALL {
            let counted = line.counters().channels[channel.index()];
            assert!(counted.received > 500 && counted.lost() == 0, "{counted:?}");
            assert_eq!(frames(&records, 2 * board + channel.number()), counted.received);
        }
    }
    devices.clocks().next().unwrap()
}

/// How well they match is measured where the emulator defines time (`cli/tests/it/emulated_clock`): a virtual device's milliseconds are the
/// computer's, and on a busy one they are later than a clock allows. In that case the report must say so.
#[test]
fn two_devices_are_one_stream_of_four_channels_in_order_and_are_on_one_clock_or_the_report_says_why_not() {
    let clock = two_devices();
    match clock.common {
        Ok(()) => {}
        Err(NotCommon::Controllers { off_us, known_us }) => {
            assert!(off_us > known_us && clock.since_ns.is_none(), "{clock:?}");
        }
        Err(doubt) => {
            assert!(doubt != NotCommon::Doubt(FrameDoubt::NoMarks) && clock.since_ns.is_none(), "{clock:?}");
        }
    }
}

#[test]
fn a_device_without_usb_frames_is_there_by_utc_and_that_is_reported() {
    let mut devices =
        Several::new(vec![virtual_board("load=20"), fake_board(&[Fault::None], Duration::ZERO)]);
    devices.connect().unwrap();
    let (records, _) = collect(&mut devices, |records, _| frames(records, 3) > 200);
    assert!(frames(&records, 1) > 0 && frames(&records, 4) > 100);
    let clock = devices.clocks().next().unwrap();
    assert!(matches!(clock.common, Err(NotCommon::Doubt(_))), "{clock:?}");
    assert_eq!((clock.since_ns, clock.moved_ns), (None, 0));
}

#[test]
fn one_device_that_goes_leaves_its_gap_and_the_other_goes_on() {
    let silent = Duration::from_secs(2);
    let mut devices = Several::new(vec![virtual_board("load=5"), fake_board(&[Fault::Vanishes], silent)]);
    devices.connect().unwrap();
    let mut lost_at = None;
    let (records, gone) = collect(&mut devices, |records, gone| {
        if gone.is_empty() {
            return false;
        }
        let (when, before) = *lost_at.get_or_insert_with(|| (Instant::now(), frames(records, 1)));
        when.elapsed() > Duration::from_secs(1) && frames(records, 1) > before + 100
    });
    assert_eq!(gone.first(), Some(&1));
    for channel in [3, 4] {
        let last = records.iter().rfind(|record| record.channel == channel).unwrap();
        assert_eq!(last.event, TraceEvent::GAP, "channel {channel}");
    }
    assert!(records.iter().all(|record| record.channel > 2 || record.event != TraceEvent::GAP));
}

/// A port that takes twelve seconds to refuse delays nobody: neither records nor the end.
#[test]
fn a_port_that_does_not_answer_holds_up_nothing() {
    let silent = Duration::from_secs(12);
    let mut line = fake_board(&[Fault::Vanishes], silent);
    line.connect().unwrap();
    let started = Instant::now();
    while !matches!(line.next(WAIT), Happening::Gone(_)) {
        assert!(started.elapsed() < PATIENCE);
    }
    // At this point it is being tried.
    let tried = Instant::now();
    while tried.elapsed() < Duration::from_secs(1) {
        let asked = Instant::now();
        line.next(WAIT);
        assert!(asked.elapsed() < Duration::from_secs(6), "waited {:?}", asked.elapsed());
    }
    assert!(line.away_for().is_some_and(|away| away >= Duration::from_secs(1)));
    let stopping = Instant::now();
    assert!(line.stop().is_err());
    assert!(matches!(line.next(WAIT), Happening::Ended));
    assert!(stopping.elapsed() < Duration::from_secs(6), "the end took {:?}", stopping.elapsed());
}
