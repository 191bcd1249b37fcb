//! A client on a line that carries less than its buses do: it loses frames, counted, and its requests are still answered in time.
#![cfg(unix)]

mod line;

use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::time::Duration;

use cantap::Channel;
use cantap::device::{Device, Link};
use cantap::wire::message::Role;
use cantap_serve::{Board, Settings, listen};
use line::SlowLine;

const BITRATE_BPS: u32 = 1_000_000;
/// Two saturated channels need 210 000.
const BYTES_PER_S: usize = 80_000;
const SOCKET_TIMEOUT: Duration = Duration::from_millis(50);

/// Answers go before waiting records, unless the system already has those.
#[test]
fn requests_over_a_slow_line_are_answered_in_time() {
    let connect =
        Box::new(|_: Option<&str>| Ok(cantap_virtual::start("load=100,frames=std0".parse()?)?.into_link()));
    let board = Arc::new(Board::start("board", connect, Settings::at(BITRATE_BPS), |_| {}).unwrap());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("board.sock");
    let _listening = listen::unix(&board, &path, Role::Listen).unwrap();
    let stream = UnixStream::connect(&path).unwrap();
    stream.set_read_timeout(Some(SOCKET_TIMEOUT)).unwrap();
    stream.set_write_timeout(Some(SOCKET_TIMEOUT)).unwrap();
    let writer = stream.try_clone().unwrap();
    let device = Device::over(Link::new(SlowLine::new(stream, BYTES_PER_S), writer), "slow").unwrap();
    for channel in Channel::ALL {
        device.listen(channel, BITRATE_BPS).unwrap();
    }
    // Until everything on the way is full.
    std::thread::sleep(Duration::from_secs(3));
    for _ in 0..3 {
        device.status().unwrap();
    }
}
