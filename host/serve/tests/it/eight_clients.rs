//! Eight clients on two saturated channels, two of them slow on purpose: each gets every frame, or its loss, counted where the frames
//! are missing. `cargo xtask bench serve` is the long version.

use std::io::Read;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use cantap::device::{Device, Link};
use cantap::wire::message::Role;
use cantap::{Channel, TraceEvent, TraceRecord};
use cantap_serve::{Board, Settings};

const BITRATE_BPS: u32 = 1_000_000;
const CLIENTS: usize = 8;
const SLOW: usize = 2;
/// The limit for records waiting for a client: less than a second of two saturated channels, shorter than a
/// slow client's pauses.
const MOST_RECORDS: usize = 30_000;
/// Shorter than the time after which a client gives up its server.
const PAUSE: Duration = Duration::from_millis(1600);
const LONGEST_PAUSE: Duration = Duration::from_millis(2600);

/// Each is longer than the one before, until the longest; on a busy computer it takes several.
const MOST_PAUSES: usize = 100;
/// Enough to read everything that is waiting.
const CATCH_UP: Duration = Duration::from_millis(600);

/// A reader that pauses on demand.
struct Gated {
    reader: Box<dyn Read + Send>,
    is_closed: Arc<AtomicBool>,
}

impl Read for Gated {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        if self.is_closed.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(10));
            return Err(std::io::ErrorKind::TimedOut.into());
        }
        self.reader.read(out)
    }
}

/// However busy the computer is: whoever runs the tests has a limit for one that hangs.
fn wait_for(what: &str, mut holds: impl FnMut() -> bool) {
    eprintln!("waiting: {what}");
    while !holds() {
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// A channel's frames, each with the number of frames lost before it.
fn frames_of(records: &[TraceRecord], channel: Channel) -> Vec<(u32, cantap::Frame)> {
    let mut frames = Vec::new();
    let mut lost = 0;
    for record in records.iter().filter(|record| record.channel == channel.number()) {
        match &record.event {
            TraceEvent::Lost { count, at_least, .. } => {
                assert!(!at_least, "{record:?}");
                lost += count;
            }
            TraceEvent::Frame { frame, .. } => {
                frames.push((std::mem::take(&mut lost), *frame.classic().expect("a classic frame")));
            }
            _ => {}
        }
    }
    frames
}

#[test]
fn eight_clients_each_have_every_frame_or_its_loss_in_place() {
    let _turn = cantap_testing::process::turn();
    let settings = Settings { most_records: MOST_RECORDS, ..Settings::at(BITRATE_BPS) };
    let connect =
        Box::new(|_: Option<&str>| Ok(cantap_virtual::start("load=100,frames=std0".parse()?)?.into_link()));
    let board = Board::start("board", connect, settings, |_| {}).unwrap();
    let is_closed = Arc::new(AtomicBool::new(false));
    let devices: Vec<Device> = (0..CLIENTS)
        .map(|number| {
            let name = format!("client {number}");
            let Link { reader, writer, keep_alive } = board.link(&name, Role::Listen).unwrap();
            let reader: Box<dyn Read + Send> = if number < SLOW {
                Box::new(Gated { reader, is_closed: Arc::clone(&is_closed) })
            } else {
                reader
            };
            let device = Device::over(Link { reader, writer, keep_alive }, &name).unwrap();
            for channel in Channel::ALL {
                device.listen(channel, BITRATE_BPS).unwrap();
            }
            device
        })
        .collect();
    let has_received = |device: &Device, frames: u64| {
        device.counters().channels.iter().all(|channel| channel.received >= frames)
    };
    wait_for("the stream has begun", || devices.iter().all(|device| has_received(device, 1)));
    // Wait until they have caught up, which shows what comes after the loss. On a busy computer the board is slower,
    // too.
    let mut pause = PAUSE;
    let mut pauses = 0;
    while devices[..SLOW].iter().any(|device| device.counters().channels.iter().any(|of| of.lost_host == 0)) {
        assert!(pauses < MOST_PAUSES, "the slow ones lose");
        pauses += 1;
        is_closed.store(true, Ordering::Relaxed);
        std::thread::sleep(pause);
        // A slower board takes longer to fill what waits for them.
        pause = (pause * 5 / 4).min(LONGEST_PAUSE);
        is_closed.store(false, Ordering::Relaxed);
        std::thread::sleep(CATCH_UP);
    }
    // What comes after the loss.
    let received: Vec<u64> = devices.iter().map(|device| device.counters().channels[0].received).collect();
    wait_for("enough to compare", || {
        devices
            .iter()
            .zip(&received)
            .all(|(device, before)| has_received(device, (before + 6000).max(25_000)))
    });
    let traces: Vec<Vec<TraceRecord>> = devices
        .iter()
        .map(|device| {
            device.stop().unwrap();
            device.records().map(Result::unwrap).collect()
        })
        .collect();
    for (number, device) in devices.iter().enumerate() {
        for counters in device.counters().channels {
            assert_eq!(counters.lost(), counters.lost_host, "client {number}: {counters:?}");
            assert_eq!(counters.lost_host > 0, number < SLOW, "client {number}: {counters:?}");
        }
    }
    for channel in Channel::ALL {
        // The last of the fast ones began last and lost nothing.
        let whole: Vec<cantap::Frame> =
            frames_of(&traces[CLIENTS - 1], channel).into_iter().map(|(_, frame)| frame).collect();
        assert!(whole.len() > 20_000, "{}", whole.len());
        for (number, trace) in traces.iter().enumerate() {
            let frames = frames_of(trace, channel);
            let begins =
                |at: usize| frames[at..].iter().zip(&whole[..16]).all(|((_, one), other)| one == other);
            let first = (0..frames.len().saturating_sub(16)).find(|at| begins(*at)).expect("common frames");
            let mut at = 0;
            let mut compared = 0;
            for (nth, (lost, frame)) in frames[first..].iter().enumerate() {
                at += if nth == 0 { 0 } else { 1 + *lost as usize };
                let Some(expected) = whole.get(at) else { break };
                assert_eq!(frame, expected, "client {number}, {channel:?}, frame {nth}");
                compared += 1;
            }
            assert!(compared > 5000, "client {number}: {compared}");
        }
    }
}
