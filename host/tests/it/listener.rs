//! Sessions that only listen, without threads: over devices that behave, and over those that do not.

use crate::fake_device;

use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use cantap::device::{Link, UtcClock, is_idle};
use cantap::listener::{Listener, Stage};
use cantap::wire::message::{ChannelConfig, Mode, capability};
use cantap::wire::record::LossStage;
use cantap::{Channel, TraceEvent, TraceRecord};
use fake_device::{Asked, FakeDevice, Fault, Log, hello};
use proptest::prelude::*;

/// Frames on a channel before a device misbehaves.
const BEFORE: u32 = 60;

/// A listener, and what carries its bytes.
struct Session {
    listener: Listener,
    link: Link,
    clock: UtcClock,
    records: Vec<TraceRecord>,
}

impl Session {
    fn new(link: Link, rates: [Option<u32>; 2]) -> Self {
        let clock = UtcClock::start();
        let listener = Listener::new("fake", rates, clock.at(Instant::now()));
        Self { listener, link, clock, records: Vec::new() }
    }

    /// Carries bytes until the session is as far as is asked for, or over.
    fn until(&mut self, mut enough: impl FnMut(&Self) -> bool) {
        let mut bytes = [0; 4096];
        loop {
            let output = self.listener.output();
            // If the other end has gone, reading says so.
            let _ = self.link.writer.write_all(&output);
            if self.listener.stage() == Stage::Over || enough(self) {
                return;
            }
            let len = match self.link.reader.read(&mut bytes) {
                Ok(0) => {
                    self.listener.vanished("the connection was closed");
                    0
                }
                Ok(len) => len,
                Err(error) if is_idle(&error) => 0,
                Err(error) => panic!("{error}"),
            };
            self.listener.take(&bytes[..len], self.clock.at(Instant::now()));
            self.records.append(self.listener.records());
        }
    }

    fn frames(&self, channel: u8) -> u64 {
        let of = |record: &&TraceRecord| record.frame().is_some() && record.channel == channel;
        self.records.iter().filter(of).count() as u64
    }

    fn lost(&self, channel: u8, of: LossStage) -> u64 {
        let count = |record: &TraceRecord| match record.event {
            TraceEvent::Lost { stage: Some(stage), count, .. } if stage == of => u64::from(count),
            _ => 0,
        };
        self.records.iter().filter(|record| record.channel == channel).map(count).sum()
    }

    fn gaps(&self) -> usize {
        self.records.iter().filter(|record| record.event == TraceEvent::GAP).count()
    }

    fn error(&self) -> String {
        self.listener.error().map(ToString::to_string).unwrap_or_default()
    }
}

/// A session with a device that misbehaves, until it is over or has brought four times as many frames, and then stopped.
fn with(fault: Fault) -> (Session, Log) {
    let log = Arc::<Mutex<Log>>::default();
    let (link, fake) = FakeDevice::new();
    let mut fake = fake.log_to(&log);
    let thread = std::thread::spawn(move || fake.run(fault, BEFORE));
    let mut session = Session::new(link, [Some(500_000), Some(250_000)]);
    session.until(|session| session.frames(2) >= u64::from(4 * BEFORE));
    session.listener.stop();
    session.until(|_| false);
    drop(std::mem::replace(&mut session.link, Link::new(std::io::empty(), std::io::sink())));
    thread.join().unwrap();
    let log = log.lock().unwrap().clone();
    (session, log)
}

#[test]
fn it_listens_and_accounts_for_every_frame() {
    let (session, log) = with(Fault::None);
    assert_eq!(session.error(), "");
    let status = session.listener.status().unwrap();
    for (channel, rate) in Channel::ALL.into_iter().zip([500_000, 250_000]) {
        let (number, index) = (channel.number(), channel.index());
        let config = log.opened[index];
        assert_eq!((config.0, config.1.mode), (channel, Mode::ListenOnly));
        assert_eq!(config.1.timing.bitrate_bps(36_000_000), rate);
        assert_eq!(session.frames(number), u64::from(status.channels[index].frames));
        assert_eq!(session.listener.counters().channels[index].received, session.frames(number));
    }
    assert_eq!((log.sent, session.gaps()), (0, 0));
    let in_order = session.records.is_sorted_by_key(|record| record.time_ns);
    assert!(in_order && session.listener.channels().count() == 2);
}

/// By the account of the simulated bus itself.
#[test]
fn everything_on_the_bus_is_heard_and_nothing_is_ever_put_on_it() {
    let options = "load=60,frames=mix,errors=2,seed=3".parse().unwrap();
    let connection = cantap_virtual::start(options).unwrap();
    let witness = Arc::clone(&connection.witness);
    let mut session = Session::new(connection.into_link(), [Some(500_000), Some(500_000)]);
    session.until(|session| session.records.len() > 3000);
    session.listener.stop();
    session.until(|_| false);
    assert_eq!(session.error(), "");
    let heard = witness.activity();
    assert_eq!([session.frames(1), session.frames(2)], heard.frames);
    assert_eq!(heard.driven, [0, 0]);
    let errors = session.records.iter().filter(|record| matches!(record.event, TraceEvent::BusError { .. }));
    assert!(errors.count() > 10);
}

#[test]
fn each_way_of_losing_a_device_has_its_words_and_leaves_a_gap() {
    for (fault, says) in [
        (Fault::Vanishes, "vanished (the connection was closed)"),
        (Fault::Deaf, "has answered nothing for"),
        (Fault::Mute, "has answered nothing for"),
        (
            Fault::SessionLost,
            "this computer slept, or the device was restarted, or another program took it over",
        ),
        (Fault::Stolen, "another program took it over"),
        (Fault::GoesBack, "its stream started over"),
        (Fault::SetBack, "its times contradict one another"),
        (Fault::TimeBehind, "its times contradict one another"),
        (Fault::Suspended, "put the device to sleep"),
        (Fault::Configured, "configured the device again"),
    ] {
        let (session, log) = with(fault);
        assert!(session.error().contains(says), "{fault:?}: {}", session.error());
        assert!(session.frames(1) >= u64::from(BEFORE) && session.gaps() == 2, "{fault:?}");
        assert!(session.records.is_sorted_by_key(|record| record.time_ns), "{fault:?}");
        assert_eq!(log.sent, 0);
        if matches!(fault, Fault::Suspended | Fault::Configured) {
            // The end names what its last batch had.
            assert_eq!(
                (session.lost(1, LossStage::Link), session.lost(2, LossStage::Link)),
                (1, 1),
                "{fault:?}"
            );
        }
    }
}

#[test]
fn what_does_not_end_a_session_does_not() {
    for fault in [Fault::Repeats, Fault::Garbage, Fault::Slow, Fault::Overtaken, Fault::NeverStops] {
        let (session, _) = with(fault);
        assert_eq!(session.error(), "", "{fault:?}");
        let status = session.listener.status().unwrap();
        let counted = session.frames(1) + session.lost(1, LossStage::Link);
        assert_eq!(counted, u64::from(status.channels[0].frames), "{fault:?}");
        let damaged = session.listener.counters().corrupt;
        assert_eq!(damaged > 0, matches!(fault, Fault::Repeats | Fault::Garbage), "{fault:?}: {damaged}");
    }
}

/// A session with a device that answers, but not as it should; the session is over before it listens.
fn refused(change: impl FnOnce(&mut FakeDevice), rates: [Option<u32>; 2]) -> (Session, Log) {
    let log = Arc::<Mutex<Log>>::default();
    let (link, fake) = FakeDevice::new();
    let mut fake = fake.log_to(&log);
    change(&mut fake);
    let thread = std::thread::spawn(move || fake.run(Fault::None, u32::MAX));
    let mut session = Session::new(link, rates);
    session.until(|session| session.listener.stage() == Stage::Listening);
    assert_eq!(session.listener.stage(), Stage::Over);
    drop(std::mem::replace(&mut session.link, Link::new(std::io::empty(), std::io::sink())));
    thread.join().unwrap();
    let log = log.lock().unwrap().clone();
    (session, log)
}

#[test]
fn a_device_that_answers_otherwise_is_left_before_anything_is_captured() {
    let both = [Some(500_000), Some(500_000)];
    let normal = |fake: &mut FakeDevice| {
        let timing = cantap::wire::BitTiming::choose(36_000_000, 500_000, None).unwrap();
        fake.opens = Some(ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing) });
    };
    let (session, log) = refused(normal, both);
    assert!(
        session.error().contains("in the mode Normal, which is not what it was asked for"),
        "{}",
        session.error()
    );
    assert_eq!((log.opened.len(), session.frames(1)), (1, 0));
    let acknowledges = |fake: &mut FakeDevice| fake.says.capabilities = capability::ALWAYS_ACKNOWLEDGES;
    let (session, log) = refused(acknowledges, both);
    assert!(session.error().contains("it acknowledges every frame") && log.opened.is_empty());
    let (session, log) = refused(|fake| fake.says.tick_hz = 3, both);
    assert!(session.error().contains("its clock ticks at 3 Hz") && log.opened.is_empty());
    let (session, log) = refused(|fake| fake.says.channels = 1, both);
    assert!(session.error().contains("has no channel 2") && log.opened.len() == 1);
    let (session, log) = refused(|_| {}, [Some(500_001), None]);
    assert!(session.error().contains("cannot be divided to 500001 bit/s") && log.opened.is_empty());
    let other = |fake: &mut FakeDevice| fake.says = cantap::wire::Hello { protocol: 99, ..hello() };
    let (session, log) = refused(other, both);
    assert!(session.error().contains("the device speaks protocol version 99"), "{}", session.error());
    assert!(log.opened.is_empty());
}

/// Nothing answers: the time is the caller's, so this takes none.
#[test]
fn a_port_that_never_answers_is_given_up_after_three_greetings() {
    let ms = |ms: i64| cantap::device::UtcNs(1_700_000_000_000_000_000 + ms * 1_000_000);
    let mut listener = Listener::new("port", [Some(500_000), None], ms(0));
    let mut greetings = 0;
    let mut at = 0;
    while listener.stage() != Stage::Over {
        greetings += usize::from(!listener.output().is_empty());
        at += 50;
        // Another program's text, as from a modem.
        listener.take(b"ERROR\r\n", ms(at));
    }
    assert_eq!((greetings, at), (3, 2100));
    assert_eq!(listener.error().unwrap().to_string(), "'port' does not answer as a cantap device");
    assert!(listener.records().is_empty());
    // A page that slept for a minute blames nobody.
    let mut listener = Listener::new("port", [Some(500_000), None], ms(0));
    listener.take(&[], ms(60_000));
    assert_eq!(listener.stage(), Stage::Greeting);
}

/// One direction of a line on which nobody waits.
#[derive(Clone, Default)]
struct Queue(Arc<Mutex<VecDeque<u8>>>);

impl Read for Queue {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        match self.0.lock().unwrap().read(out)? {
            0 => Err(io::ErrorKind::TimedOut.into()),
            len => Ok(len),
        }
    }
}

impl Write for Queue {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

proptest! {
    /// Whatever comes, whenever the caller says that it is, and whatever the device answers before it.
    #[test]
    fn any_bytes_at_any_time_are_survived(
        pieces in prop::collection::vec((prop::collection::vec(any::<u8>(), 0..200), any::<i64>(), 0_u8..8), 0..20),
    ) {
        let mut listener = Listener::new("any", [Some(500_000), None], cantap::device::UtcNs(0));
        let (mut to_device, mut from_device) = (Queue::default(), Queue::default());
        let mut fake = FakeDevice::over(to_device.clone(), from_device.clone());
        for (bytes, at, answers) in pieces {
            for _ in 0..answers {
                to_device.write_all(&listener.output()).unwrap();
                while let Asked::Request(request) = fake.asked() {
                    fake.handle(request.id, &request.command, true);
                }
                fake.flush();
                let mut answer = [0; 4096];
                let len = from_device.read(&mut answer).unwrap_or_default();
                listener.take(&answer[..len], cantap::device::UtcNs(at));
            }
            listener.take(&bytes, cantap::device::UtcNs(at));
        }
        listener.stop();
        listener.vanished("the end");
        prop_assert_eq!(listener.stage(), Stage::Over);
        prop_assert!(listener.records().is_sorted_by_key(|record| record.time_ns));
    }
}
