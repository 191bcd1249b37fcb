//! Both directions over a virtual device, with an interface in memory: there are no CAN sockets where the tests run. The kernel's own
//! are tested in `sim/kernel/guest/parts/bridge.sh`.

use std::collections::VecDeque;
use std::io;
use std::os::fd::BorrowedFd;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cantap::device::Records;
use cantap::wire::message::{ChannelConfig, Mode, TxFrame};
use cantap::wire::record::{LossStage, TransmitFailure};
use cantap::{Channel, TraceEvent, TraceRecord};
use cantap_address::{Address, OpenDevice};
use cantap_trace::socketcan::{ERROR_FLAG, ErrorFrame};

use super::interface::{Known, Port};
use super::lane::Lane;
use super::places;
use super::raw::Raw;
use super::sender::Sender;

/// An interface in memory.
#[derive(Default)]
struct Memory {
    /// By programs.
    written: Mutex<VecDeque<Raw>>,
    /// To programs.
    told: Mutex<Vec<Raw>>,
    is_full: AtomicBool,
    /// The number of frames that it takes at once, if limited.
    takes: Option<usize>,
    thrown_away: AtomicU32,
}

impl Port for Arc<Memory> {
    fn receive(&self, most: usize, frames: &mut Vec<Raw>) -> io::Result<u32> {
        let mut written = self.written.lock().unwrap();
        let most = most.min(written.len());
        frames.extend(written.drain(..most));
        Ok(self.thrown_away.load(Ordering::Relaxed))
    }

    fn send(&self, frames: &[Raw]) -> io::Result<usize> {
        if self.is_full.load(Ordering::Relaxed) {
            return Err(io::ErrorKind::WouldBlock.into());
        }
        let taken = frames.len().min(self.takes.unwrap_or(usize::MAX));
        self.told.lock().unwrap().extend(&frames[..taken]);
        Ok(taken)
    }

    fn as_fd(&self) -> Option<BorrowedFd<'_>> {
        None
    }
}

impl Memory {
    fn write(&self, frame: &str) {
        self.written.lock().unwrap().push_back(Raw::of_frame(&frame.parse().unwrap()));
    }

    /// Frames as text, and errors as their meaning.
    fn written(&self) -> Vec<String> {
        let told = self.told.lock().unwrap();
        let text = |raw: &Raw| {
            if let Some(frame) = raw.frame() {
                return frame.to_string();
            }
            let raw = raw.bytes();
            let id = u32::from_ne_bytes([raw[0], raw[1], raw[2], raw[3]]);
            let frame = ErrorFrame { classes: id & !ERROR_FLAG, data: std::array::from_fn(|at| raw[8 + at]) };
            format!("{:?}", frame.events().0)
        };
        told.iter().map(text).collect()
    }
}

const BITRATE_BPS: u32 = 500_000;

struct Bridged {
    device: Arc<OpenDevice>,
    records: Records,
    lanes: Arc<[Lane]>,
    memories: [Arc<Memory>; 2],
    sender: Sender,
}

impl Bridged {
    fn new(options: &str, mode: Mode, echoes: bool) -> Self {
        Self::over(&format!("virtual:{options}"), mode, Known { echoes, has_fd: false })
    }

    fn over(address: &str, mode: Mode, known: Known) -> Self {
        let address: Address = address.parse().unwrap();
        let device = Arc::new(address.open().unwrap());
        for channel in Channel::ALL.into_iter().take(device.hello().channels.into()) {
            let config = ChannelConfig::listen_only(device.timing(BITRATE_BPS).unwrap());
            device.open_channel(channel, Some(ChannelConfig { mode, ..config })).unwrap();
        }
        let memories: [Arc<Memory>; 2] = Default::default();
        let lanes: Arc<[Lane]> = Channel::ALL
            .into_iter()
            .zip(&memories)
            .map(|(channel, memory)| {
                let name = format!("can{}", channel.number() - 1);
                Lane::new(channel, &name, Box::new(Arc::clone(memory)), known)
            })
            .collect();
        let sender = Sender::start(Arc::clone(&lanes)).unwrap();
        sender.use_device(Some(Arc::clone(&device)));
        Self { records: device.records(), device, lanes, memories, sender }
    }

    /// Passes records on until a condition holds.
    fn until(&mut self, what: &str, mut holds: impl FnMut(&[Arc<Memory>; 2]) -> bool) {
        let deadline = Instant::now() + Duration::from_secs(10);
        while !holds(&self.memories) {
            assert!(
                Instant::now() < deadline,
                "{what}: {:?}",
                self.memories.each_ref().map(|memory| memory.written())
            );
            let batch = self.records.next_batch(Duration::from_millis(10)).unwrap().unwrap();
            self.lanes.iter().for_each(|lane| lane.hear(&batch).unwrap());
        }
    }

    fn sent(&self) -> [u32; 2] {
        self.device.status().unwrap().channels.each_ref().map(|channel| channel.transmitted)
    }
}

fn not_sent() -> String {
    format!("{:?}", TraceEvent::TransmitFailed { tag: 0, reason: TransmitFailure::Aborted })
}

#[test]
fn programs_hear_both_buses_and_errors_as_error_frames() {
    let mut bridged = Bridged::new("load=60,errors=5", Mode::ListenOnly, false);
    bridged.until("frames and errors", |memories| {
        memories.iter().all(|memory| {
            let told = memory.written();
            told.len() > 200 && told.iter().any(|text| text.starts_with("BusError"))
        })
    });
    // They come as the bus had them, and nothing twice: programs have exactly what the lanes got.
    let heard: u64 = bridged.lanes.iter().map(|lane| lane.counts.heard.load(Ordering::Relaxed)).sum();
    let frames =
        bridged.memories.iter().flat_map(|memory| memory.written()).filter(|text| text.contains('#')).count();
    assert_eq!(heard, frames as u64);
}

#[test]
fn what_programs_write_is_sent_in_order_on_both_channels_and_not_shown_twice() {
    const FRAMES: u32 = 1500;
    let mut bridged = Bridged::new("load=0", Mode::Normal, false);
    for number in 0..FRAMES {
        bridged.memories[0].write(&format!("123#{number:08X}"));
        bridged.memories[1].write(&format!("1ABBCCDD#{number:04X}"));
    }
    let lanes = Arc::clone(&bridged.lanes);
    bridged.until("all are sent", |_| {
        lanes.iter().all(|lane| lane.counts.sent.load(Ordering::Relaxed) == u64::from(FRAMES))
    });
    assert_eq!(bridged.sent(), [FRAMES; 2]);
    // Another sender's frame, through the same device, is passed on.
    let frame = TxFrame { tag: 1 << 30, frame: "321#99".parse().unwrap(), at_ticks: None };
    bridged.device.send(Channel::Can1, &[frame]).unwrap();
    bridged.until("the other's frame", |memories| !memories[0].written().is_empty());
    assert_eq!(bridged.memories[0].written(), ["321#99"]);
    assert!(bridged.memories[1].written().is_empty());
}

/// If the kernel shows a written frame to nobody, its confirmation does, in its place among the received frames.
#[test]
fn confirmations_are_the_echo_where_the_kernel_makes_none() {
    let mut bridged = Bridged::new("load=0", Mode::Normal, true);
    for frame in ["123#01", "123#02", "7FF#R3"] {
        bridged.memories[0].write(frame);
    }
    bridged.until("the echo", |memories| memories[0].written().len() == 3);
    assert_eq!(bridged.memories[0].written(), ["123#01", "123#02", "7FF#R3"]);
}

#[test]
fn a_channel_that_only_listens_sends_nothing_and_programs_are_told_of_each_frame() {
    let mut bridged = Bridged::new("load=0", Mode::ListenOnly, false);
    for _ in 0..3 {
        bridged.memories[0].write("123#11");
    }
    bridged.until("the refusals", |memories| memories[0].written().len() == 3);
    assert_eq!(bridged.memories[0].written(), vec![not_sent(); 3]);
    assert_eq!(bridged.sent(), [0, 0]);
}

/// Frames written while the device was away were meant for that time.
#[test]
fn frames_written_without_a_device_are_refused_and_never_sent_later() {
    let mut bridged = Bridged::new("load=0", Mode::Normal, false);
    bridged.sender.use_device(None);
    bridged.memories[0].write("123#11");
    bridged.until("the refusal", |memories| memories[0].written() == [not_sent()]);
    let device = Arc::clone(&bridged.device);
    bridged.sender.use_device(Some(device));
    bridged.memories[0].write("123#22");
    let lanes = Arc::clone(&bridged.lanes);
    bridged.until("the next is sent", |_| lanes[0].counts.sent.load(Ordering::Relaxed) == 1);
    assert_eq!(bridged.sent(), [1, 0]);
    assert_eq!(lanes[0].counts.not_sent.load(Ordering::Relaxed), 1);
}

/// A bus without another node, on which nothing leaves, beside one that carries everything.
#[test]
fn a_bus_on_which_nothing_leaves_does_not_hold_up_the_other() {
    let mut bridged = Bridged::new("load=0", Mode::Normal, false);
    // Channel 2's queue is full of frames that are due in an hour.
    let due = bridged.device.time().unwrap() + u64::from(bridged.device.hello().tick_hz) * 3600;
    let room = u32::from(bridged.device.hello().tx_queue);
    for tag in 0..room {
        let frame = TxFrame { tag: (1 << 30) + tag, frame: "111#".parse().unwrap(), at_ticks: Some(due) };
        bridged.device.send(Channel::Can2, &[frame]).unwrap();
    }
    for number in 0..500 {
        bridged.memories[0].write(&format!("123#{number:04X}"));
    }
    let lanes = Arc::clone(&bridged.lanes);
    bridged.until("the first channel's are sent", |_| lanes[0].counts.sent.load(Ordering::Relaxed) == 500);
    // On the full one, the device refuses a frame, and its program is informed.
    bridged.memories[1].write("222#");
    bridged.until("the refusal", |memories| memories[1].written().contains(&not_sent()));
}

fn received(frame: &str) -> TraceRecord {
    let frame = frame.parse().unwrap();
    let event = TraceEvent::Frame { frame, direction: cantap::Direction::Rx, late: false };
    TraceRecord { time_ns: 0, device_ns: None, channel: 1, event }
}

#[test]
fn what_an_interface_does_not_take_is_counted_and_told_in_place() {
    let memory = Arc::new(Memory::default());
    let lane = Lane::new(
        Channel::Can1,
        "can0",
        Box::new(Arc::clone(&memory)),
        Known { echoes: false, has_fd: false },
    );
    lane.hear(&[received("101#")]).unwrap();
    memory.is_full.store(true, Ordering::Relaxed);
    lane.hear(&[received("102#"), received("103#")]).unwrap();
    lane.hear(&[received("104#")]).unwrap();
    memory.is_full.store(false, Ordering::Relaxed);
    lane.hear(&[received("105#")]).unwrap();
    let lost = TraceEvent::Lost { stage: Some(LossStage::Host), count: 3, at_least: false };
    assert_eq!(memory.written(), ["101#".to_owned(), format!("{lost:?}"), "105#".to_owned()]);
    assert_eq!(lane.counts.heard.load(Ordering::Relaxed), 2);
    assert_eq!(lane.counts.undelivered.load(Ordering::Relaxed), 3);
}

#[test]
fn fd_frames_reach_an_interface_that_takes_them_and_are_missing_on_another() {
    let heard = ["123##1AABB", "18DAF110##2", "124#AA", "7FF##0112233445566778899AABBCC"];
    for has_fd in [true, false] {
        let memory = Arc::new(Memory::default());
        let lane =
            Lane::new(Channel::Can1, "can0", Box::new(Arc::clone(&memory)), Known { echoes: false, has_fd });
        lane.hear(&heard.map(received)).unwrap();
        let lost =
            format!("{:?}", TraceEvent::Lost { stage: Some(LossStage::Host), count: 1, at_least: false });
        let expected =
            heard.map(|text| if has_fd || !text.contains("##") { text.to_owned() } else { lost.clone() });
        assert_eq!(memory.written(), expected);
        let counts = [&lane.counts.heard, &lane.counts.lost].map(|count| count.load(Ordering::Relaxed));
        assert_eq!(counts, if has_fd { [4, 0] } else { [1, 3] });
    }
}

/// Through a cannelloni tunnel, whose bytes are those of its own document: version, operation, number, count; then identifier, length with the flag for
/// CAN FD, flags, data.
#[test]
fn fd_frames_cross_both_ways_with_their_flags() {
    let peer = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    peer.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
    let free = std::net::UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let address = format!("cannelloni://{}?listen={}", peer.local_addr().unwrap(), free.port());
    let mut bridged = Bridged::over(&address, Mode::Normal, Known { echoes: false, has_fd: true });
    bridged.memories[0].write("18DAF110##3112233445566778899AABBCC");
    let mut bytes = [0; 2048];
    let len = peer.recv(&mut bytes).unwrap();
    let data = [0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88, 0x99, 0xAA, 0xBB, 0xCC];
    let item = [&[0x98, 0xDA, 0xF1, 0x10, 0x8C, 0x03][..], &data].concat();
    assert_eq!((&bytes[..2], &bytes[3..5], &bytes[5..len]), (&[2, 0][..], &[0, 1][..], &item[..]));
    let frames =
        [&[2, 0, 0, 0, 2][..], &[0, 0, 1, 0x23, 0x81, 0x01, 0x5A], &[0, 0, 1, 0x24, 1, 0xA5]].concat();
    peer.send_to(&frames, free).unwrap();
    // What nobody counted before comes first.
    let frames =
        |memory: &Memory| memory.written().into_iter().filter(|text| text.contains('#')).collect::<Vec<_>>();
    bridged.until("both frames", |memories| frames(&memories[0]).len() == 2);
    assert_eq!(frames(&bridged.memories[0]), ["123##15A", "124#A5"]);
    let lanes = Arc::clone(&bridged.lanes);
    bridged.until("it is counted as sent", |_| lanes[0].counts.sent.load(Ordering::Relaxed) == 1);
}

/// A board of ours sends none: classical frames before and after it are sent all the same.
#[test]
fn a_program_s_fd_frame_is_refused_where_the_device_sends_none() {
    let mut bridged = Bridged::new("load=0", Mode::Normal, false);
    for frame in ["123#01", "123##0AABB", "123#02"] {
        bridged.memories[0].write(frame);
    }
    let lanes = Arc::clone(&bridged.lanes);
    bridged.until("the refusal", |memories| {
        memories[0].written() == [not_sent()] && lanes[0].counts.sent.load(Ordering::Relaxed) == 2
    });
    assert_eq!(bridged.sent(), [2, 0]);
    assert_eq!(lanes[0].counts.not_sent.load(Ordering::Relaxed), 1);
}

/// Of the received frames, those not passed to programs are counted: at the interface, or as lost before.
#[test]
fn frames_heard_and_frames_counted_are_all_there_were() {
    let memory = Arc::new(Memory { takes: Some(3), ..Memory::default() });
    let lane = Lane::new(
        Channel::Can1,
        "can0",
        Box::new(Arc::clone(&memory)),
        Known { echoes: false, has_fd: false },
    );
    let of_frames = |event| TraceRecord { time_ns: 0, device_ns: None, channel: 1, event };
    let error = of_frames(TraceEvent::BusError { kind: None, counters: None });
    let lost = of_frames(TraceEvent::Lost { stage: Some(LossStage::Queue), count: 10, at_least: false });
    lane.hear(&[received("101#"), lost, received("102#"), received("103#"), error, received("104#")])
        .unwrap();
    let counts = || {
        [&lane.counts.heard, &lane.counts.lost, &lane.counts.undelivered]
            .map(|count| count.load(Ordering::Relaxed))
    };
    assert_eq!(counts(), [2, 10, 2]);
    // What was not taken, including the error, is reported first.
    lane.hear(&[received("105#")]).unwrap();
    let told = TraceEvent::Lost { stage: Some(LossStage::Host), count: 3, at_least: false };
    assert_eq!(memory.written()[3..], [format!("{told:?}"), "105#".to_owned()]);
    assert_eq!(counts(), [3, 10, 2]);
    assert!(!lane.counts.lost_more.load(Ordering::Relaxed));
    lane.hear(&[of_frames(TraceEvent::GAP)]).unwrap();
    assert!(lane.counts.lost_more.load(Ordering::Relaxed));
}

#[test]
fn what_the_kernel_throws_away_of_programs_frames_is_counted() {
    let mut bridged = Bridged::new("load=0", Mode::Normal, false);
    bridged.memories[0].thrown_away.store(7, Ordering::Relaxed);
    bridged.memories[0].write("123#");
    let lanes = Arc::clone(&bridged.lanes);
    bridged.until("it is told", |memories| {
        memories[0].written() == [not_sent()] && lanes[0].counts.sent.load(Ordering::Relaxed) == 1
    });
    assert_eq!(lanes[0].counts.not_sent.load(Ordering::Relaxed), 7);
}

#[test]
fn interfaces_are_the_channels_in_turn_unless_they_say_which() {
    let of = |names: &[&str]| {
        let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
        places(&names).map(|places| {
            places.iter().map(|(channel, name)| format!("{} {name}", channel.number())).collect()
        })
    };
    assert_eq!(of(&["can0"]).unwrap(), vec!["1 can0"]);
    assert_eq!(of(&["can0", "can1"]).unwrap(), vec!["1 can0", "2 can1"]);
    assert_eq!(of(&["2:can1"]).unwrap(), vec!["2 can1"]);
    assert_eq!(of(&["2:a", "1:b"]).unwrap(), vec!["2 a", "1 b"]);
    for wrong in [&["can0", "can0"][..], &["2:a", "b"], &["3:a"], &["x:a"]] {
        let places: anyhow::Result<Vec<String>> = of(wrong);
        assert!(places.is_err(), "{wrong:?}");
    }
}
