//! Devices that fall silent, lose their session, repeat themselves or vanish: what a capture reports, counts and
//! does.

use crate::fake_device;

use std::collections::VecDeque;
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use cantap::device::{ChannelCounters, Happening, Reconnecting, Return};
use cantap::wire::message::{ChannelConfig, Mode};
use cantap::wire::record::LossStage;
use cantap::wire::{BitTiming, Hello};
use cantap::{Channel, Device, DeviceError, TraceEvent, TraceRecord};
use fake_device::{FakeDevice, Fault, Log, hello};

/// Nothing here takes this long, however busy the machine is.
const PATIENCE: Duration = Duration::from_mins(1);
/// Frames on a channel before a device misbehaves.
const BEFORE: u32 = 60;
const WAIT: Duration = Duration::from_millis(50);

type Line = Reconnecting<Device, DeviceError>;

fn start(fault: Fault, serial: &str, log: &Arc<Mutex<Log>>) -> (Device, JoinHandle<()>) {
    let (link, fake) = FakeDevice::new();
    let mut fake = fake.log_to(log);
    serial.clone_into(&mut fake.serial);
    let thread = std::thread::spawn(move || fake.run(fault, BEFORE));
    (Device::over(link, "fake").unwrap(), thread)
}

fn config(device: &Device, mode: Mode) -> ChannelConfig {
    ChannelConfig { mode, ..ChannelConfig::listen_only(device.timing(500_000).unwrap()) }
}

/// A port with one device after the other, each with its fault, the last one without.
fn line(faults: &[(Fault, &'static str)], mode: Mode, log: &Arc<Mutex<Log>>) -> Line {
    let mut devices = VecDeque::from(faults.to_vec());
    let log = Arc::clone(log);
    let connect = move |_: Option<&str>| {
        let (fault, serial) = devices.pop_front().unwrap_or((Fault::None, "1"));
        Ok(start(fault, serial, &log).0)
    };
    Line::new("fake", connect, move |device| {
        for channel in Channel::ALL {
            device.open_channel(channel, Some(config(device, mode)))?;
        }
        Ok(())
    })
}

/// Everything that happened until this many records had arrived after the last return, and the result of
/// stopping.
#[derive(Default)]
struct Seen {
    records: Vec<TraceRecord>,
    gone: Vec<String>,
    back: Vec<Return>,
}

impl Seen {
    fn until(line: &mut Line, enough: impl Fn(&Self) -> bool) -> Self {
        let mut seen = Self::default();
        let started = Instant::now();
        while !enough(&seen) {
            assert!(started.elapsed() < PATIENCE, "gone {:?}, back {:?}", seen.gone, seen.back);
            seen.take(line.next(WAIT));
        }
        line.stop().unwrap();
        while seen.take(line.next(WAIT)) {}
        seen
    }

    fn take(&mut self, happening: Happening<DeviceError>) -> bool {
        match happening {
            Happening::Records(mut records) => self.records.append(&mut records),
            Happening::Gone(error) => self.gone.push(error.to_string()),
            Happening::Back(back) => self.back.push(back),
            Happening::Ended => return false,
        }
        true
    }

    /// Numbers of a channel's frames, in one list per stretch between gaps.
    fn numbers(&self, channel: Channel) -> Vec<Vec<u32>> {
        let mut parts = vec![Vec::new()];
        for record in self.records.iter().filter(|record| record.channel == channel.number()) {
            match record.event {
                TraceEvent::Frame { frame, .. } => {
                    let number = u32::from_be_bytes(frame.data().try_into().unwrap());
                    parts.last_mut().unwrap().push(number);
                }
                TraceEvent::GAP => parts.push(Vec::new()),
                // Counted as far as possible.
                TraceEvent::Lost { stage: Some(LossStage::Link), at_least: false, .. } => {}
                event => panic!("{event:?}"),
            }
        }
        parts
    }
}

fn in_order(numbers: &[u32]) -> bool {
    numbers.iter().zip(0..).all(|(number, expected)| *number == expected)
}

#[test]
fn whatever_ends_a_session_is_reported_and_the_capture_goes_on_with_the_gap_in_place() {
    for (fault, words) in [
        (Fault::Deaf, "the device at 'fake' has answered nothing for 1."),
        (Fault::Mute, "the device at 'fake' has answered nothing for 1."),
        (Fault::Suspended, "this computer put the device to sleep"),
        (Fault::Configured, "this computer configured the device again"),
        (Fault::SessionLost, "this computer slept, or the device was restarted"),
        (Fault::Stolen, "another program took it over; close that program"),
        (Fault::GoesBack, "its stream started over"),
        (Fault::SetBack, "its times contradict one another"),
        (Fault::TimeBehind, "its times contradict one another"),
        (Fault::Vanishes, "the device at 'fake' vanished (the connection was closed)"),
    ] {
        let log = Arc::default();
        let mut line = line(&[(fault, "1")], Mode::Normal, &log);
        let seen = Seen::until(&mut line, |seen| {
            seen.numbers(Channel::Can2).get(1).is_some_and(|part| part.len() > 20)
        });
        assert_eq!(seen.gone.len(), 1, "{fault:?}: {:?}", seen.gone);
        assert!(seen.gone[0].contains(words), "{fault:?}: {:?}", seen.gone);
        assert!(seen.back.len() == 2 && seen.back[0].after.is_none(), "{fault:?}: {:?}", seen.back);
        assert!(seen.back[1].after.is_some() && line.gaps().count == 1, "{fault:?}: {:?}", seen.back);
        assert!(seen.records.is_sorted_by_key(|record| record.time_ns), "{fault:?}");
        let mut frames = 0;
        for channel in Channel::ALL {
            let parts = seen.numbers(channel);
            assert_eq!(parts.len(), 2, "{fault:?}: one gap");
            assert!(
                parts[0].len() as u32 >= BEFORE - 25 && parts.iter().all(|part| in_order(part)),
                "{fault:?}: {parts:?}"
            );
            frames += parts.iter().map(Vec::len).sum::<usize>();
        }
        // Nothing that arrived is lost, and all sessions count.
        let counted = line.counters().channels;
        assert_eq!(counted.iter().map(ChannelCounters::delivered).sum::<u64>(), frames as u64, "{fault:?}");
        // What the device could report is counted: the batch that was lost before it ended the session.
        let lost: Vec<u64> = counted.iter().map(|channel| channel.lost_link).collect();
        if fault == Fault::SetBack {
            // Frames that arrived with an impossible time.
            assert!(lost.iter().all(|lost| (1..50).contains(lost)), "{lost:?}");
        } else {
            let says_so = matches!(fault, Fault::Suspended | Fault::Configured);
            assert_eq!(lost, [u64::from(says_so); 2], "{fault:?}");
        }
        // Both channels were opened as before, in the requested mode.
        let opened = log.lock().unwrap().opened.clone();
        assert_eq!((opened.len(), &opened[..2]), (4, &opened[2..]), "{fault:?}");
        assert!(opened.iter().all(|(_, config)| config.mode == Mode::Normal), "{fault:?}");
    }
}

#[test]
fn what_only_looks_bad_ends_no_session_and_loses_nothing() {
    for fault in [Fault::Repeats, Fault::Garbage, Fault::Slow, Fault::Overtaken] {
        let mut line = line(&[(fault, "1")], Mode::ListenOnly, &Arc::default());
        let many = 4 * BEFORE as usize;
        let seen = Seen::until(&mut line, |seen| seen.numbers(Channel::Can1)[0].len() > many);
        assert!(seen.gone.is_empty() && seen.back.len() == 1, "{fault:?}: {:?}", seen.gone);
        for channel in Channel::ALL {
            assert!(in_order(&seen.numbers(channel)[0]), "{fault:?}");
            assert_eq!(line.counters().channels[channel.index()].lost(), 0, "{fault:?}");
        }
        let is_damaged = matches!(fault, Fault::Repeats | Fault::Garbage);
        assert_eq!(line.counters().corrupt > 0, is_damaged, "{fault:?}");
    }
}

/// Otherwise stamps, loads and bit rates would all be wrong, and a mode might disturb the bus.
#[test]
fn what_a_device_says_of_itself_and_cannot_be_is_refused() {
    for (says, words) in [
        (Hello { tick_hz: 0, ..hello() }, "its clock ticks at 0 Hz"),
        (Hello { tick_hz: 999_999, ..hello() }, "its clock ticks at 999999 Hz"),
        (Hello { can_clock_hz: 0, ..hello() }, "its CAN controllers' clock is 0 Hz"),
    ] {
        let (link, mut fake) = FakeDevice::new();
        fake.says = says;
        let thread = std::thread::spawn(move || fake.run(Fault::None, BEFORE));
        let Err(error) = Device::over(link, "fake") else { panic!("{words}: accepted") };
        assert!(error.to_string().contains(words), "{error}");
        thread.join().unwrap();
    }
    let listening = ChannelConfig::listen_only(BitTiming::choose(36_000_000, 500_000, None).unwrap());
    let slower = ChannelConfig::listen_only(BitTiming::choose(36_000_000, 250_000, None).unwrap());
    let none = BitTiming { prescaler: 0, ..listening.timing };
    for (opens, words) in [
        (slower, "channel 1 at 250000 bit/s in the mode ListenOnly"),
        (ChannelConfig { mode: Mode::Normal, ..listening }, "channel 1 at 500000 bit/s in the mode Normal"),
        (ChannelConfig { timing: none, ..listening }, "a bit timing that is out of its controller's range"),
    ] {
        let (link, mut fake) = FakeDevice::new();
        fake.opens = Some(opens);
        let thread = std::thread::spawn(move || {
            fake.run(Fault::None, BEFORE);
            fake
        });
        let device = Device::over(link, "fake").unwrap();
        let error = device.open_channel(Channel::Can1, Some(listening)).unwrap_err();
        assert!(error.to_string().contains(words), "{error}");
        assert!(device.open_channels().is_empty());
        drop(device);
        assert_eq!(thread.join().unwrap().status.channels[0].open, None, "it was closed again");
    }
}

#[test]
fn on_another_board_channels_only_listen() {
    let log = Arc::default();
    let mut line = line(&[(Fault::Vanishes, "1"), (Fault::None, "2")], Mode::Normal, &log);
    let seen = Seen::until(&mut line, |seen| seen.back.len() == 2);
    let back = &seen.back[1];
    assert_eq!(back.other_board.as_deref(), Some("fake 2"));
    assert_eq!(back.only_listening, Channel::ALL);
    let modes: Vec<Mode> = log.lock().unwrap().opened.iter().map(|(_, config)| config.mode).collect();
    assert_eq!(modes, [Mode::Normal, Mode::Normal, Mode::ListenOnly, Mode::ListenOnly]);
    assert_eq!(log.lock().unwrap().sent, 0);
}

#[test]
fn a_device_that_is_gone_at_the_end_is_reported_and_the_gap_stands_there() {
    for fault in [Fault::Deaf, Fault::SessionLost, Fault::Vanishes] {
        let log = Arc::default();
        let (device, _) = start(fault, "1", &log);
        let mut device = Some(device);
        let connect = move |_: Option<&str>| {
            device.take().ok_or_else(|| DeviceError::NotFound { address: "fake".to_owned() })
        };
        let mut line = Line::new("fake", connect, |device| device.listen(Channel::Can1, 500_000).map(|_| ()));
        let mut seen = Seen::default();
        let started = Instant::now();
        // Before the fault is noticed.
        while seen.numbers(Channel::Can1)[0].len() < BEFORE as usize - 30 {
            assert!(started.elapsed() < PATIENCE);
            seen.take(line.next(WAIT));
        }
        std::thread::sleep(Duration::from_millis(200));
        let error = line.stop().unwrap_err();
        assert!(error.to_string().contains("frames may be missing at its end"), "{fault:?}: {error}");
        while seen.take(line.next(WAIT)) {
            assert!(started.elapsed() < PATIENCE);
        }
        assert_eq!(seen.records.last().unwrap().event, TraceEvent::GAP, "{fault:?}");
        assert!(in_order(&seen.numbers(Channel::Can1)[0]), "{fault:?}");
        assert!(seen.gone.is_empty(), "{fault:?}: {:?}", seen.gone);
    }
}

#[test]
fn a_lost_end_of_a_channel_does_not_hang_the_end_of_the_capture() {
    let (device, _) = start(Fault::NeverStops, "1", &Arc::default());
    for channel in Channel::ALL {
        device.listen(channel, 500_000).unwrap();
    }
    let mut records = device.records();
    let mut frames = 0;
    while frames < 2 * BEFORE as usize {
        frames += records.next_batch(WAIT).unwrap().unwrap().len();
    }
    let (ended, end) = channel();
    let thread = std::thread::spawn(move || {
        let status = device.stop();
        let _ = ended.send(());
        (status, device)
    });
    assert_ne!(end.recv_timeout(PATIENCE), Err(RecvTimeoutError::Timeout), "it hangs");
    let (status, device) = thread.join().unwrap();
    // The buffered tail is there, and nothing is missing.
    let frames = frames + records.filter(|record| record.as_ref().unwrap().frame().is_some()).count();
    let captured: u32 = status.unwrap().channels.iter().map(|channel| channel.frames).sum();
    assert_eq!(frames as u32, captured);
    assert!(device.counters().channels.iter().all(|channel| channel.lost() == 0));
}

#[test]
fn requests_to_a_device_that_is_gone_say_why() {
    for (fault, words) in [(Fault::Deaf, "answered nothing"), (Fault::SessionLost, "this computer slept")] {
        let (device, _) = start(fault, "1", &Arc::default());
        device.listen(Channel::Can1, 500_000).unwrap();
        let mut records = device.records();
        let started = Instant::now();
        let error = loop {
            assert!(started.elapsed() < PATIENCE, "{fault:?}: nothing was noticed");
            match records.next_batch(WAIT) {
                Ok(_) => {}
                Err(error) => break error.to_string(),
            }
        };
        assert!(error.contains(words), "{fault:?}: {error}");
        // A sender learns about it, too.
        let told = device.send(Channel::Can1, &[]).unwrap_err().to_string();
        assert_eq!(told, error);
    }
}
