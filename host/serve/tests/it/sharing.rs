//! Several clients on one board: each gets what the board has, each loss is where it belongs, and nobody may do more than
//! allowed.

use std::collections::HashMap;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use cantap::device::{Device, Link};
use cantap::wire::message::{
    ChannelConfig, DEVICE_TAG, Filter, FrameKind, Mode, OTHERS_TAG, Periodic, Role, TxFrame,
};
use cantap::wire::{Command, Frame, Refusal};
use cantap::{Channel, DeviceError, Direction, TraceEvent, TraceRecord};
use cantap_serve::{Board, News, Settings};
use cantap_testing::process::wait_until;

const BITRATE_BPS: u32 = 500_000;
const FAST_BPS: u32 = 1_000_000;

pub fn board_at(options: &str, settings: Settings) -> (Board, Receiver<News>) {
    let options: cantap_virtual::Options = options.parse().unwrap();
    let connect = Box::new(move |_: Option<&str>| Ok(cantap_virtual::start(options.clone())?.into_link()));
    let (news, told) = channel();
    let board = Board::start("board", connect, settings, move |of| drop(news.send(of))).unwrap();
    (board, told)
}

fn board(options: &str) -> Board {
    board_at(options, Settings::at(BITRATE_BPS)).0
}

fn client(board: &Board, name: &str, role: Role) -> Device {
    Device::over(board.link(name, role).unwrap(), name).unwrap()
}

/// What a device captured until it was stopped.
fn drain(device: &Device) -> Vec<TraceRecord> {
    device.stop().unwrap();
    device.records().map(Result::unwrap).collect()
}

fn frames(records: &[TraceRecord]) -> Vec<(u8, String)> {
    records.iter().filter_map(|record| Some((record.channel, record.frame()?.to_string()))).collect()
}

fn refusal<T: std::fmt::Debug>(result: Result<T, DeviceError>) -> Refusal {
    match result {
        Err(DeviceError::Refused { refusal }) => refusal,
        other => panic!("{other:?}"),
    }
}

fn normal(device: &Device) -> ChannelConfig {
    ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(device.timing(BITRATE_BPS).unwrap()) }
}

/// The board's time of each record is the same for all clients, to the tick; UTC is each client's own.
#[test]
fn two_clients_have_the_same_frames_in_the_same_order_and_nothing_is_lost() {
    let _turn = cantap_testing::process::turn();
    let board = board("load=90");
    let (first, second) = (client(&board, "first", Role::Listen), client(&board, "second", Role::Listen));
    for device in [&first, &second] {
        for channel in Channel::ALL {
            device.listen(channel, BITRATE_BPS).unwrap();
        }
    }
    std::thread::sleep(Duration::from_millis(600));
    let (one, other) = (drain(&first), drain(&second));
    for device in [&first, &second] {
        let counters = device.counters();
        assert!(counters.channels.iter().all(|channel| channel.lost() == 0), "{counters:?}");
    }
    let (one, other) = (frames(&one), frames(&other));
    // The first began and ended a little earlier; compare per channel, because the two are closed one after the other.
    for channel in [1, 2] {
        let of = |all: &[(u8, String)]| {
            all.iter()
                .filter(|(number, _)| *number == channel)
                .map(|(_, frame)| frame.clone())
                .collect::<Vec<_>>()
        };
        let (one, other) = (of(&one), of(&other));
        let at = one.windows(8).position(|window| window == &other[..8]).expect("the second's first frames");
        let common = (one.len() - at).min(other.len());
        assert!(common > 300, "{common}");
        assert_eq!(one[at..at + common], other[..common]);
    }
}

/// Delivered frames and frames counted as lost add up to all there were; the other client has all of them.
#[test]
fn a_slow_client_loses_counted_frames_at_stage_host_and_holds_up_nobody() {
    let _turn = cantap_testing::process::turn();
    let settings = Settings { most_records: 2000, ..Settings::at(FAST_BPS) };
    let (board, _told) = board_at("load=100,frames=std8", settings);
    let good = client(&board, "good", Role::Listen);
    // A link that stops reading on demand, but not long enough for the device to be given up as silent.
    let gate = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(false));
    let Link { reader, writer, keep_alive } = board.link("slow", Role::Listen).unwrap();
    let gated = Gated { reader, gate: gate.clone() };
    let slow = Device::over(Link { reader: Box::new(gated), writer, keep_alive }, "slow").unwrap();
    for device in [&good, &slow] {
        for channel in Channel::ALL {
            device.listen(channel, FAST_BPS).unwrap();
        }
    }
    let before = slow.counters().channels[0];
    gate.store(true, std::sync::atomic::Ordering::Relaxed);
    std::thread::sleep(Duration::from_millis(1100));
    gate.store(false, std::sync::atomic::Ordering::Relaxed);
    wait_until("the slow one reads again", || slow.counters().channels[0].received > before.received + 2000);
    std::thread::sleep(Duration::from_millis(100));
    let (all, some) = (drain(&good), drain(&slow));
    let (of_good, of_slow) = (good.counters().channels[0], slow.counters().channels[0]);
    assert_eq!(of_good.lost(), 0, "{of_good:?}");
    assert!(of_slow.lost_host > 1000, "{of_slow:?}");
    assert_eq!(of_slow.lost(), of_slow.lost_host, "{of_slow:?}");
    // In place: the frames around a loss are in the other client's trace, that far apart.
    let on_first = |(channel, frame): (u8, String)| (channel == 1).then_some(frame);
    let all: Vec<String> = frames(&all).into_iter().filter_map(on_first).collect();
    let mut at = None;
    let mut lost = 0;
    let mut seen = 0;
    for record in some.iter().filter(|record| record.channel == 1) {
        match (&record.event, record.frame()) {
            (TraceEvent::Lost { count, .. }, _) => lost += *count as usize,
            (_, Some(frame)) => {
                let frame = frame.to_string();
                match &mut at {
                    None => at = all.iter().position(|of| *of == frame),
                    Some(at) => {
                        *at += 1 + lost;
                        if let Some(of) = all.get(*at) {
                            assert_eq!(*of, frame, "after {seen} frames and {lost} lost");
                        }
                    }
                }
                lost = 0;
                seen += 1;
            }
            _ => {}
        }
    }
    assert_eq!(seen, of_slow.delivered());
}

struct Gated {
    reader: Box<dyn std::io::Read + Send>,
    gate: std::sync::Arc<std::sync::atomic::AtomicBool>,
}

impl std::io::Read for Gated {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        if self.gate.load(std::sync::atomic::Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(10));
            return Err(std::io::ErrorKind::TimedOut.into());
        }
        self.reader.read(out)
    }
}

#[test]
fn a_listener_changes_nothing_and_learns_what_it_would_take() {
    let board = board("load=20");
    let device = client(&board, "listener", Role::Listen);
    let not_granted = |needs| Refusal::NotGranted { needs };
    assert_eq!(refusal(device.open_channel(Channel::Can1, Some(normal(&device)))), not_granted(Role::Send));
    assert_eq!(refusal(device.listen(Channel::Can1, 250_000)), Refusal::OtherSettings);
    assert_eq!(refusal(device.save_defaults()), not_granted(Role::Configure));
    assert_eq!(refusal(device.identify(1)), not_granted(Role::Configure));
    assert_eq!(refusal(device.reset()), not_granted(Role::Configure));
    assert_eq!(refusal(device.bootloader()), Refusal::Unsupported);
    let config = device.listen(Channel::Can1, BITRATE_BPS).unwrap();
    assert_eq!(config.mode, Mode::ListenOnly);
    let frame = TxFrame { tag: 1, frame: "123#11".parse().unwrap(), at_ticks: None };
    assert_eq!(refusal(device.send(Channel::Can1, &[frame])), not_granted(Role::Send));
    assert_eq!(refusal(device.recover(Channel::Can1)), not_granted(Role::Send));
    let periodic =
        Periodic { frame: frame.frame, period_ticks: 100_000, count: 0, modifiers: heapless_none() };
    assert_eq!(refusal(device.set_periodic(Channel::Can1, 0, Some(periodic))), not_granted(Role::Send));
    // The refusal says what was refused.
    let said = device.send(Channel::Can1, &[frame]).unwrap_err().to_string();
    assert_eq!(
        said,
        "the device refused: its server does not let this client do that, which needs the right to send"
    );
}

fn heapless_none<T, const N: usize>() -> heapless::Vec<T, N> {
    heapless::Vec::new()
}

#[test]
fn one_client_configures_at_a_time_and_nobody_changes_what_others_hear() {
    let (board, _told) = board_at("load=20", Settings::default());
    let (first, second) =
        (client(&board, "first", Role::Configure), client(&board, "second", Role::Configure));
    let third = client(&board, "third", Role::Listen);
    // The bit rate of the buses is unknown: somebody has to give it.
    assert_eq!(
        refusal(third.listen(Channel::Can1, BITRATE_BPS)),
        Refusal::NotGranted { needs: Role::Configure }
    );
    first.listen(Channel::Can1, BITRATE_BPS).unwrap();
    second.listen(Channel::Can2, 250_000).unwrap();
    third.listen(Channel::Can1, BITRATE_BPS).unwrap();
    first.close_channel(Channel::Can1).unwrap();
    assert_eq!(refusal(first.listen(Channel::Can1, 125_000)), Refusal::OtherSettings);
    third.close_channel(Channel::Can1).unwrap();
    assert_eq!(refusal(second.listen(Channel::Can1, 125_000)), Refusal::Held);
    first.listen(Channel::Can1, 125_000).unwrap();
    drop(first);
    wait_until("the right is free", || second.listen(Channel::Can1, BITRATE_BPS).is_ok());
}

/// The sender gets the confirmation with its own tag, others the frame as sent by the board; the board acknowledges only while
/// somebody may send.
#[test]
fn a_sender_is_confirmed_others_see_the_frame_and_the_board_listens_again_when_it_leaves() {
    let settings = Settings { keep_mode: Duration::from_millis(20), ..Settings::at(BITRATE_BPS) };
    let (board, told) = board_at("load=0", settings);
    let listener = client(&board, "listener", Role::Listen);
    listener.listen(Channel::Can1, BITRATE_BPS).unwrap();
    let sender = client(&board, "sender", Role::Send);
    let ends = sender.transmissions();
    sender.open_channel(Channel::Can1, Some(normal(&sender))).unwrap();
    let frame: Frame = "123#11".parse().unwrap();
    sender.send(Channel::Can1, &[TxFrame { tag: 77, frame, at_ticks: None }]).unwrap();
    let end = ends.recv_timeout(Duration::from_secs(2)).unwrap();
    assert_eq!((end.tag, end.result), (77, Ok(frame.into())));
    // The same entry number for two clients; each has its own entry.
    let other = client(&board, "other", Role::Send);
    let other_ends = other.transmissions();
    other.open_channel(Channel::Can1, Some(normal(&other))).unwrap();
    for (device, data) in [(&sender, "200#01"), (&other, "200#02")] {
        let frame = data.parse().unwrap();
        let entry = Periodic { frame, period_ticks: 120_000, count: 3, modifiers: heapless_none() };
        device.set_periodic(Channel::Can1, 5, Some(entry)).unwrap();
    }
    for (ends, data) in [(&ends, "200#01"), (&other_ends, "200#02")] {
        let expected: Frame = data.parse().unwrap();
        let mut own = 0;
        while own < 3 {
            let end = ends.recv_timeout(Duration::from_secs(2)).unwrap();
            match end.tag {
                OTHERS_TAG => assert_ne!(end.result, Ok(expected.into())),
                tag => {
                    assert_eq!((tag, end.result), (DEVICE_TAG + 5, Ok(expected.into())));
                    own += 1;
                }
            }
        }
    }
    // Each client has its own filters.
    other.close_channel(Channel::Can1).unwrap();
    drop(sender);
    wait_until("the board only listens", || {
        let status = listener.request(Command::Registers { channel: Channel::Can1 });
        // SILM, bit 31 of BTR (RM0090 Rev 21, 32.9.2).
        matches!(status, Ok(cantap::wire::Reply::Registers(registers)) if registers.now.btr >> 31 == 1)
    });
    let heard = drain(&listener);
    let sent = heard
        .iter()
        .filter(|record| matches!(record.event, TraceEvent::Frame { direction: Direction::Tx, .. }));
    assert_eq!(sent.count(), 7);
    // It was off the bus for a moment, twice: when the first sender came and when the last one had left.
    assert_eq!(heard.iter().filter(|record| record.event == TraceEvent::GAP).count(), 2, "{heard:?}");
    assert_eq!(listener.counters().channels[0].off_bus, 2);
    let said: Vec<String> =
        told.try_iter().map(|news| news.to_string()).filter(|said| said.contains("gap")).collect();
    assert_eq!(
        said,
        [
            "channel 1 was off its bus for a moment, because sender may send on it; 1 other client sees a gap",
            "channel 1 was off its bus for a moment, and only listens again; 1 client sees a gap",
        ]
    );
}

#[test]
fn what_a_client_leaves_in_the_queue_is_withdrawn_and_the_others_frames_are_sent() {
    let board = board("load=0");
    let (leaves, stays) = (client(&board, "leaves", Role::Send), client(&board, "stays", Role::Send));
    let ends = stays.transmissions();
    for device in [&leaves, &stays] {
        device.open_channel(Channel::Can1, Some(normal(device))).unwrap();
    }
    let later = leaves.time().unwrap() + u64::from(leaves.hello().tick_hz) * 3600;
    let held = TxFrame { tag: 1, frame: "111#".parse().unwrap(), at_ticks: Some(later) };
    leaves.send(Channel::Can1, &[held]).unwrap();
    // Behind it in the board's queue.
    let frames: Vec<TxFrame> = (0..5)
        .map(|tag| TxFrame { tag, frame: format!("222#0{tag}").parse().unwrap(), at_ticks: None })
        .collect();
    stays.send(Channel::Can1, &frames).unwrap();
    assert!(ends.recv_timeout(Duration::from_millis(300)).is_err());
    drop(leaves);
    let mut ended = HashMap::new();
    while ended.len() < 5 {
        let end = ends.recv_timeout(Duration::from_secs(2)).unwrap();
        ended.insert(end.tag, end.result.unwrap());
    }
    assert!((0..5).all(|tag| ended.contains_key(&tag)), "{ended:?}");
}

/// A controller in loopback hears nothing of its bus: for whoever listens, that would be a silent bus without a loss.
#[test]
fn nobody_makes_a_listener_deaf_and_nobody_listens_to_a_deaf_channel() {
    let board = board("load=30");
    let listener = client(&board, "listener", Role::Listen);
    let sender = client(&board, "sender", Role::Send);
    let in_mode = |mode| ChannelConfig { mode, ..normal(&sender) };
    listener.listen(Channel::Can1, BITRATE_BPS).unwrap();
    for mode in [Mode::Loopback, Mode::SilentLoopback] {
        let opened = sender.open_channel(Channel::Can1, Some(in_mode(mode)));
        assert_eq!(refusal(opened), Refusal::OtherSettings, "{mode:?}");
        // Alone, it may.
        sender.open_channel(Channel::Can2, Some(in_mode(mode))).unwrap();
        assert_eq!(refusal(listener.listen(Channel::Can2, BITRATE_BPS)), Refusal::OtherSettings, "{mode:?}");
        sender.close_channel(Channel::Can2).unwrap();
    }
    listener.listen(Channel::Can2, BITRATE_BPS).unwrap();
    sender.open_channel(Channel::Can1, Some(in_mode(Mode::Normal))).unwrap();
}

#[test]
fn each_client_has_its_own_filters_and_leaves_out_what_it_wants() {
    let board = board("load=0");
    let sender = client(&board, "sender", Role::Send);
    let loopback = ChannelConfig { mode: Mode::Loopback, ..normal(&sender) };
    sender.open_channel(Channel::Can1, Some(loopback)).unwrap();
    // Who shares a bus that only the sender's own frames are on has to ask for that.
    let filtered = client(&board, "filtered", Role::Send);
    let filter = Filter { extended: false, kind: FrameKind::Data, id: 0x123, mask: 0x7FF };
    assert_eq!(filtered.set_filters(Channel::Can1, &[filter]).unwrap(), (1, 28));
    let timing = filtered.timing(BITRATE_BPS).unwrap();
    let bare = ChannelConfig { omit_data: true, mode: Mode::Loopback, ..ChannelConfig::listen_only(timing) };
    filtered.open_channel(Channel::Can1, Some(bare)).unwrap();
    for (tag, frame) in ["123#11", "124#22", "123#R"].into_iter().enumerate() {
        let frame = TxFrame { tag: tag as u32, frame: frame.parse().unwrap(), at_ticks: None };
        sender.send(Channel::Can1, &[frame]).unwrap();
    }
    std::thread::sleep(Duration::from_millis(100));
    let heard = drain(&filtered);
    let received: Vec<String> = heard
        .iter()
        .filter(|record| matches!(record.event, TraceEvent::Frame { direction: Direction::Rx, .. }))
        .filter_map(|record| Some(record.frame()?.to_string()))
        .collect();
    // Data that was left out reads zero.
    assert_eq!(received, ["123#00"]);
    assert_eq!(filtered.counters().channels[0].lost(), 0);
}

#[test]
fn when_the_board_goes_clients_learn_it_and_find_it_again() {
    let (board, told) = board_at("load=30", Settings::at(BITRATE_BPS));
    let manager = client(&board, "manager", Role::Configure);
    let device = client(&board, "listener", Role::Listen);
    device.listen(Channel::Can1, BITRATE_BPS).unwrap();
    let mut records = device.records();
    std::thread::sleep(Duration::from_millis(100));
    // Not while others use the channels.
    assert_eq!(refusal(manager.reset()), Refusal::OtherSettings);
    device.close_channel(Channel::Can1).unwrap();
    manager.reset().unwrap();
    let error = records.find_map(Result::err).expect("an end");
    assert_eq!(
        error.to_string(),
        "the session with the device at 'listener' has ended: its server has lost the board"
    );
    assert_eq!(
        refusal_of_gone(&device),
        "the session with the device at 'listener' has ended: its server has lost the board"
    );
    wait_until("the board is back", || told.try_iter().any(|news| matches!(news, News::BoardBack { .. })));
    let again = client(&board, "again", Role::Listen);
    again.listen(Channel::Can1, BITRATE_BPS).unwrap();
    assert!(again.records().next().unwrap().is_ok());
    // The server ends.
    drop(board);
    let error = again.records().find_map(Result::err).expect("an end");
    assert!(error.to_string().ends_with("its server has ended"), "{error}");
}

fn refusal_of_gone(device: &Device) -> String {
    device.time().unwrap_err().to_string()
}

#[test]
fn clients_are_bounded_and_places_become_free() {
    let (board, told) = board_at("load=0", Settings { most_clients: 2, ..Settings::at(BITRATE_BPS) });
    let first = client(&board, "first", Role::Listen);
    let _second = client(&board, "second", Role::Listen);
    assert_eq!(board.link("third", Role::Listen).err().unwrap().to_string(), "there are 2 clients already");
    drop(first);
    wait_until("a place is free", || board.link("third", Role::Listen).is_ok());
    wait_until("it is told", || told.try_iter().any(|news| news.to_string() == "first has left"));
}
