//! A thousand clients that come and go, in a process of their own, whose threads and files are counted.
#![cfg(target_os = "linux")]

use std::io::Write;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use cantap::Channel;
use cantap::device::{Device, Link, encode};
use cantap::wire::message::Role;
use cantap::wire::{Command, PROTOCOL_VERSION, Request};
use cantap_serve::{Board, Settings, connect, listen};
use cantap_testing::process::wait_until;

const BITRATE_BPS: u32 = 500_000;

/// Tasks and open files of this process.
fn held() -> [usize; 2] {
    ["/proc/self/task", "/proc/self/fd"].map(|folder| std::fs::read_dir(folder).unwrap().count())
}

/// Some leave politely, some are cut off at any point; nothing of them remains, and a listener beside them loses nothing.
#[test]
fn a_thousand_clients_come_and_go_and_nothing_of_them_stays() {
    let test = "reconnects::a_thousand_clients_come_and_go_and_nothing_of_them_stays";
    cantap_testing::process::alone(test, come_and_go);
}

fn come_and_go() {
    const THREADS: usize = 16;
    const EACH: usize = 63;
    // Clients that only connected are noticed a moment later.
    let settings = Settings { most_clients: 400, ..Settings::at(BITRATE_BPS) };
    let connect = Box::new(|_: Option<&str>| Ok(cantap_virtual::start("load=50".parse()?)?.into_link()));
    let board = Arc::new(Board::start("board", connect, settings, |_| {}).unwrap());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cantap.sock");
    let socket = listen::unix(&board, &path, Role::Send).unwrap();
    let tcp = listen::tcp(&board, "127.0.0.1:0".parse().unwrap(), Role::Send).unwrap();
    let address = tcp.address().unwrap();
    // The server's session with its board begins in a thread of its own.
    let mut stays = None;
    wait_until("the board is there", || {
        stays = Device::over(board.link("stays", Role::Listen).unwrap(), "stays").ok();
        stays.is_some()
    });
    let stays = stays.unwrap();
    for channel in Channel::ALL {
        stays.listen(channel, BITRATE_BPS).unwrap();
    }
    let before = held();
    let came = AtomicUsize::new(0);
    std::thread::scope(|scope| {
        for thread in 0..THREADS {
            let (path, came) = (&path, &came);
            scope.spawn(move || {
                for number in 0..EACH {
                    let link = || {
                        if (thread + number) % 2 == 0 {
                            connect::unix(path)
                        } else {
                            connect::tcp(&address.to_string())
                        }
                    };
                    match number % 3 {
                        // A whole session.
                        0 => {
                            let device = Device::over(link().unwrap(), "one of many").unwrap();
                            device.listen(Channel::Can1, BITRATE_BPS).unwrap();
                        }
                        // Greeted, opened, and cut off with answers in flight.
                        1 => {
                            let Link { mut writer, .. } = link().unwrap();
                            let commands = [
                                Command::Hello { protocol: PROTOCOL_VERSION },
                                Command::Open { channel: Channel::Can2, config: None },
                                Command::Status,
                            ];
                            for (id, command) in (1..).zip(commands) {
                                let request = Request { id, command };
                                writer.write_all(&encode(&request).unwrap()).unwrap();
                            }
                        }
                        // Only connected.
                        _ => drop(link().unwrap()),
                    }
                    came.fetch_add(1, Ordering::Relaxed);
                }
            });
        }
    });
    assert!(came.into_inner() >= 1000);
    wait_until("all of them have left", || board.clients() == 1);
    wait_until("nothing of them stays", || held() <= before);
    stays.stop().unwrap();
    let counters = stays.counters();
    assert!(
        counters.channels.iter().all(|channel| channel.lost() == 0 && channel.received > 100),
        "{counters:?}"
    );
    drop(socket);
}
