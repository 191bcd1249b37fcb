//! A client on a line that carries less than its buses do: it loses frames, counted, and its requests are still answered in time.
#![cfg(unix)]

use crate::line;

use std::io::{Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use cantap::device::{ChannelCounters, Device, Link};
use cantap::wire::message::Role;
use cantap::{Channel, TraceEvent};
use cantap_serve::{Board, Settings, connect, listen};
use line::SlowLine;

const BITRATE_BPS: u32 = 1_000_000;
/// Two saturated channels need 210 000.
const BYTES_PER_S: usize = 80_000;
const SOCKET_TIMEOUT: Duration = Duration::from_millis(50);

const BOARD: &str = "load=100,frames=std0";
/// Both channels' frames in a second: 48 bits each.
const FRAMES_PER_S: u64 = 41_600;

fn share(folder: &Path) -> (Arc<Board>, PathBuf, listen::Listening) {
    let connect = Box::new(|_: Option<&str>| Ok(cantap_virtual::start(BOARD.parse()?)?.into_link()));
    let board = Arc::new(Board::start("board", connect, Settings::at(BITRATE_BPS), |_| {}).unwrap());
    let path = folder.join("board.sock");
    let listening = listen::unix(&board, &path, Role::Listen).unwrap();
    (board, path, listening)
}

fn listen_to_both(device: &Device) {
    for channel in Channel::ALL {
        device.listen(channel, BITRATE_BPS).unwrap();
    }
}

/// Ends the capture, which must not last; the server's count of frames is made up of those that came and those that were lost on the way.
fn end_promptly(device: &Device, patience: Duration) {
    let records = device.records();
    let began = Instant::now();
    let status = device.stop().unwrap();
    let took = began.elapsed();
    assert!(took < patience, "{took:?} for the end");
    let counters = device.counters();
    for (of_server, ours) in status.channels.iter().zip(counters.channels) {
        assert_eq!(u64::from(of_server.frames), ours.received, "{ours:?}");
        assert_eq!(ours.lost(), ours.lost_host, "{ours:?}");
        assert!(ours.lost_host > FRAMES_PER_S / 4, "a line that was not slow shows nothing: {ours:?}");
    }
    let (mut frames, mut lost) = (0, 0);
    for record in records.map(Result::unwrap) {
        match record.event {
            TraceEvent::Frame { .. } => frames += 1,
            TraceEvent::Lost { count, .. } => lost += u64::from(count),
            _ => {}
        }
    }
    let sum = |of: fn(&ChannelCounters) -> u64| counters.channels.iter().map(of).sum::<u64>();
    assert_eq!((frames, lost), (sum(ChannelCounters::delivered), sum(ChannelCounters::lost)));
}

/// Answers go before records that wait, unless the system has those already. Who ends the capture is not kept waiting for what is behind.
#[test]
fn requests_over_a_slow_line_are_answered_in_time_and_its_end_is_prompt() {
    let folder = tempfile::tempdir().unwrap();
    let (_board, path, _listening) = share(folder.path());
    let stream = UnixStream::connect(path).unwrap();
    stream.set_read_timeout(Some(SOCKET_TIMEOUT)).unwrap();
    stream.set_write_timeout(Some(SOCKET_TIMEOUT)).unwrap();
    let writer = stream.try_clone().unwrap();
    let line = SlowLine::new(stream, BYTES_PER_S);
    let device = Device::over(Link::new(line, writer), "slow").unwrap();
    listen_to_both(&device);
    // Until all that can wait on the way waits.
    std::thread::sleep(Duration::from_secs(3));
    for _ in 0..3 {
        device.status().unwrap();
    }
    end_promptly(&device, Duration::from_secs(15));
}

/// What holds megabytes and carries little, as ssh over a modem does.
fn modem(from: UnixStream, mut to: UnixStream) {
    const HOLDS: usize = 2_000_000;
    let (held, taken) = std::sync::mpsc::sync_channel::<Vec<u8>>(HOLDS / 1000);
    std::thread::spawn(move || {
        let mut from = from;
        let mut bytes = [0; 1000];
        while let Ok(len @ 1..) = from.read(&mut bytes) {
            if held.send(bytes[..len].to_vec()).is_err() {
                return;
            }
        }
    });
    let mut due = Instant::now();
    for bytes in taken {
        due = due.max(Instant::now()) + Duration::from_secs_f64(bytes.len() as f64 / BYTES_PER_S as f64);
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        if to.write_all(&bytes).is_err() {
            return;
        }
    }
}

/// Half a minute of records would stand in front of each answer, and the client would give the board up.
#[test]
fn a_line_that_holds_megabytes_is_not_filled() {
    let folder = tempfile::tempdir().unwrap();
    let (_board, server, _listening) = share(folder.path());
    let path = folder.path().join("modem.sock");
    let socket = UnixListener::bind(&path).unwrap();
    std::thread::spawn(move || {
        let (client, _) = socket.accept().unwrap();
        let server = UnixStream::connect(server).unwrap();
        let (mut up, mut to) = (client.try_clone().unwrap(), server.try_clone().unwrap());
        std::thread::spawn(move || {
            let _ = std::io::copy(&mut up, &mut to);
            let _ = to.shutdown(std::net::Shutdown::Write);
        });
        modem(server, client);
    });
    let device = Device::over(connect::unix(&path).unwrap(), "far away").unwrap();
    listen_to_both(&device);
    let mut slowest = Duration::ZERO;
    for _ in 0..8 {
        std::thread::sleep(Duration::from_millis(600));
        let asked = Instant::now();
        device.status().unwrap();
        slowest = slowest.max(asked.elapsed());
    }
    assert!(slowest < Duration::from_secs(5), "{slowest:?} for an answer");
    let carried = device.counters().bytes;
    assert!(carried > 3 * BYTES_PER_S as u64, "{carried} bytes in 5 s: the line was left empty");
    end_promptly(&device, Duration::from_secs(15));
}
