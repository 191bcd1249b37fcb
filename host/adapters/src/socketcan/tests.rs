//! The driver against an interface in memory. The kernel's own are tested in `sim/kernel/guest/parts/socketcan.sh`.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use cantap_trace::socketcan::ERROR_FLAG;
use cantap_wire::record::Stamp;

use super::*;
use crate::raw_can::{RawFdFrame, RawFrame};

/// What the kernel has, and what was sent.
#[derive(Default)]
struct State {
    link: Link,
    is_gone: bool,
    /// The next thing that a read returns: a message, or an error.
    arrived: VecDeque<Result<Message, i32>>,
    sent: Vec<RawFrame>,
    sent_fd: Vec<RawFdFrame>,
    /// What the next attempts to send return.
    refusals: VecDeque<i32>,
    dropped: u32,
    /// How long a read takes, and how many messages it gives.
    pace: Option<(Duration, usize)>,
}

#[derive(Clone, Default)]
struct Fake(Arc<Mutex<State>>);

impl Fake {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Interface for Fake {
    fn look(&mut self) -> io::Result<Link> {
        let state = self.lock();
        if state.is_gone { Err(io::Error::from_raw_os_error(ENODEV)) } else { Ok(state.link.clone()) }
    }

    fn open(&mut self) -> io::Result<()> {
        Ok(())
    }

    fn close(&mut self) {}

    fn wait(&mut self, _wait: Duration) {}

    fn receive(&mut self, messages: &mut Vec<Message>) -> io::Result<()> {
        let mut state = self.lock();
        if let Some(Err(code)) = state.arrived.front().copied() {
            state.arrived.pop_front();
            return Err(io::Error::from_raw_os_error(code));
        }
        let (takes, most) = state.pace.unwrap_or((Duration::ZERO, usize::MAX));
        std::thread::sleep(takes);
        while messages.len() < most
            && let Some(Ok(message)) = state.arrived.front().copied()
        {
            state.arrived.pop_front();
            messages.push(message);
        }
        Ok(())
    }

    fn send(&mut self, frame: &RawFrame) -> io::Result<()> {
        let mut state = self.lock();
        if let Some(code) = state.refusals.pop_front() {
            return Err(io::Error::from_raw_os_error(code));
        }
        state.sent.push(*frame);
        Ok(())
    }

    fn send_fd(&mut self, frame: &RawFdFrame) -> io::Result<()> {
        let mut state = self.lock();
        if let Some(code) = state.refusals.pop_front() {
            return Err(io::Error::from_raw_os_error(code));
        }
        state.sent_fd.push(*frame);
        Ok(())
    }

    fn dropped(&mut self) -> Option<u32> {
        Some(self.lock().dropped)
    }
}

/// An interface with a controller, as `ip link` shows it.
fn controller() -> Link {
    Link {
        is_can: true,
        is_up: true,
        echoes: true,
        kind: "can".to_owned(),
        bitrate_bps: Some(500_000),
        state: Some(ErrorState::Active),
        counters: Some((0, 0)),
        overruns: 70,
        dropped: 30,
        ..Link::default()
    }
}

const NORMAL: Opening = Opening { bitrate_bps: 500_000, sample_point_permille: 875, listen_only: false };
const LISTEN: Opening = Opening { listen_only: true, ..NORMAL };

/// A driver with its channel open.
fn opened(link: Link) -> (Fake, SocketCan) {
    let (fake, mut driver) = connected(link).unwrap();
    driver.open(Channel::Can1, NORMAL).unwrap();
    (fake, driver)
}

fn connected(link: Link) -> Result<(Fake, SocketCan), OpenError> {
    let fake = Fake::default();
    fake.lock().link = link;
    let driver = SocketCan::over(Box::new(fake.clone()), false, "can0", "can0")?;
    Ok((fake, driver))
}

fn message(frame: &str) -> Message {
    Message::new(&raw_frame(&frame.parse().unwrap()))
}

/// A CAN FD frame of these bytes.
fn fd_message(id: u32, flags: u8, data: &[u8]) -> Message {
    let mut raw = [0; 72];
    raw[..4].copy_from_slice(&id.to_ne_bytes());
    (raw[4], raw[5]) = (data.len() as u8, flags);
    raw[8..8 + data.len()].copy_from_slice(data);
    Message::new(&raw)
}

fn error(classes: u32, data: [u8; 8]) -> Message {
    let mut raw = [0; 16];
    raw[..4].copy_from_slice(&(ERROR_FLAG | classes).to_ne_bytes());
    raw[4] = 8;
    raw[8..].copy_from_slice(&data);
    Message::new(&raw)
}

/// What is reported next, shortly: without its time.
fn reports(driver: &mut SocketCan) -> Vec<String> {
    // As much as one call takes.
    let mut reports = Vec::new();
    let ended = driver.poll(Duration::ZERO, &mut reports).err();
    reports.iter().map(short).chain(ended).collect()
}

fn short(incoming: &Incoming) -> String {
    match incoming {
        Incoming::Received { frame, .. } => frame.to_string(),
        Incoming::Sent { mailbox, .. } => format!("sent {mailbox}"),
        Incoming::NotSent { mailbox, .. } => format!("not sent {mailbox}"),
        Incoming::BusError { kind, .. } => format!("error {kind:?}"),
        Incoming::BusErrors { count, .. } => format!("{count} errors"),
        Incoming::State { state, counters, .. } => format!("{state:?} {counters:?}"),
        Incoming::Lost { stage, count, at_least, .. } => {
            format!("{} {count}{}", stage.name(), if *at_least { "+" } else { "" })
        }
    }
}

/// Makes the next poll read the kernel's figures.
fn look_now(driver: &mut SocketCan) {
    driver.look();
}

#[test]
fn frames_of_all_kinds_arrive_and_what_has_no_place_here_is_counted() {
    let (fake, mut driver) = opened(controller());
    fake.lock().arrived = [
        Ok(message("123#1122")),
        Ok(message("1ABCDEF0#R3")),
        Ok(fd_message(0x124, 5, &[0xAA])),
        Ok(fd_message(0x9ABC_DEF0, 2, &[0x55; 64])),
        Ok(fd_message(0x124, 0, &[0; 9])),
        Ok(Message::new(&[0; 12])),
        Ok(message("7FF#")),
    ]
    .into();
    let long = format!("1ABCDEF0##2{}", "55".repeat(64));
    let wanted = ["123#1122", "1ABCDEF0#R3", "124##1AA", &long, "link 1+", "link 1+", "7FF#"];
    assert_eq!(reports(&mut driver), wanted);
    let (count, text) = driver.oddities();
    assert!(count == 2 && text.contains("unknown form"), "{text}");
}

#[test]
fn each_message_that_the_socket_drops_is_counted_once_where_it_is_missing() {
    let (fake, mut driver) = opened(Link { bitrate_bps: None, state: None, ..controller() });
    let after = |dropped| Message { dropped: Some(dropped), ..message("123#") };
    fake.lock().arrived = [Ok(message("001#")), Ok(after(7)), Ok(after(7)), Ok(after(10))].into();
    assert_eq!(reports(&mut driver), ["001#", "queue 7", "123#", "123#", "queue 3", "123#"]);
    // After the last message there is nothing that could say so.
    fake.lock().dropped = 12;
    look_now(&mut driver);
    assert_eq!(reports(&mut driver), ["queue 2"]);
    fake.lock().dropped = 13;
    driver.close(Channel::Can1);
    assert_eq!(reports(&mut driver), ["queue 1"]);
}

#[test]
fn the_kernel_s_figures_count_from_the_opening_and_an_overrun_is_not_counted_twice() {
    const OVERFLOW: [u8; 8] = [0, 1, 0, 0, 0, 0, 0, 0];
    let (fake, mut driver) = opened(controller());
    fake.lock().arrived = [Ok(error(4, OVERFLOW))].into();
    assert_eq!(reports(&mut driver), ["controller 1+"]);
    fake.lock().link = Link { overruns: 71, dropped: 35, ..controller() };
    look_now(&mut driver);
    assert_eq!(reports(&mut driver), ["link 5", "Active (0, 0)"]);
    fake.lock().link.overruns = 74;
    look_now(&mut driver);
    assert_eq!(reports(&mut driver), ["controller 3+"]);
}

#[test]
fn error_frames_are_errors_states_and_counters() {
    let (fake, mut driver) = opened(controller());
    fake.lock().arrived = [
        Ok(error(0x88, [0, 0, 4, 0, 0, 0, 0, 0])),
        Ok(error(0x20, [0; 8])),
        Ok(error(0x204, [0, 0x10, 0, 0, 0, 0, 3, 130])),
        // A stuff error that says how far the counters are.
        Ok(error(0x288, [0, 0, 4, 0, 0, 0, 3, 135])),
        Ok(error(0x02, [5, 0, 0, 0, 0, 0, 0, 0])),
        Ok(error(0x40, [0; 8])),
        Ok(error(0x100, [0; 8])),
    ]
    .into();
    assert_eq!(
        reports(&mut driver),
        [
            "error Stuff",
            "error Acknowledgment",
            "Passive (3, 130)",
            "Passive (3, 135)",
            "error Stuff",
            "BusOff (3, 135)",
            "Active (3, 135)",
        ]
    );
    let kinds = driver.oddities().1;
    assert!(kinds.contains("1 attempts to send that failed"), "{kinds}");
}

#[test]
fn a_frame_is_confirmed_by_its_echo_and_those_of_other_programs_are_received() {
    let (fake, mut driver) = opened(controller());
    let send = |driver: &mut SocketCan, mailbox, frame: &str| {
        driver.send(Channel::Can1, mailbox, &frame.parse().unwrap())
    };
    fake.lock().refusals = [ENOBUFS].into();
    assert!(!send(&mut driver, 0, "123#11"), "the queue is full");
    assert!(send(&mut driver, 0, "123#11") && send(&mut driver, 1, "100#"));
    assert_eq!(
        fake.lock().sent,
        [raw_frame(&"123#11".parse().unwrap()), raw_frame(&"100#".parse().unwrap())]
    );
    let own = |frame| Message { is_own: true, ..message(frame) };
    // The controller sends the lower identifier first.
    fake.lock().arrived =
        [Ok(message("123#11")), Ok(own("100#")), Ok(own("123#11")), Ok(own("123#11"))].into();
    assert_eq!(reports(&mut driver), ["123#11", "sent 1", "sent 0"]);
    assert_eq!(driver.oddities().0, 1);
    fake.lock().refusals = [nix::libc::EINVAL].into();
    assert!(send(&mut driver, 2, "101#"));
    assert_eq!(reports(&mut driver), ["not sent 2"]);
    assert!(send(&mut driver, 2, "102#"));
    fake.lock().arrived = [Ok(error(0x40, [0; 8]))].into();
    assert_eq!(reports(&mut driver), ["BusOff (0, 0)", "not sent 2"]);
}

#[test]
fn a_confirmation_that_was_dropped_is_not_waited_for_without_an_end() {
    let (fake, mut driver) = opened(controller());
    assert!(driver.send(Channel::Can1, 0, &"123#".parse().unwrap()));
    fake.lock().arrived = [Ok(Message { dropped: Some(1), ..message("001#") })].into();
    assert_eq!(reports(&mut driver), ["queue 1", "001#"]);
    driver.uncertain_since = Instant::now().checked_sub(2 * UNCONFIRMED);
    assert_eq!(reports(&mut driver), ["sent 0"]);
    assert!(driver.oddities().1.contains("whose confirmation was lost"));
}

#[test]
fn an_interface_that_goes_down_or_is_gone_ends_the_session_after_everything_it_had_received() {
    // A deletion begins with the first, and ends with the second.
    for (code, is_gone, words) in [
        (ENETDOWN, false, "ip link set can0 up"),
        (ENETDOWN, true, "can0 is gone"),
        (ENODEV, true, "can0 is gone"),
    ] {
        let (fake, mut driver) = opened(controller());
        {
            let mut state = fake.lock();
            state.arrived = [Ok(message("001#")), Err(code), Ok(message("002#"))].into();
            state.is_gone = is_gone;
            state.dropped = 4;
        }
        let all = reports(&mut driver);
        assert_eq!(all[..2], ["001#", "002#"], "{all:?}");
        assert!(all.contains(&"queue 4".to_owned()) && all.last().unwrap().contains(words), "{all:?}");
    }
    // Seen by the kernel's answer alone.
    let (fake, mut driver) = opened(controller());
    fake.lock().is_gone = true;
    look_now(&mut driver);
    assert!(reports(&mut driver).last().unwrap().contains("can0 is gone"));
}

#[test]
fn rate_and_mode_are_the_owner_s() {
    let (_, mut driver) = connected(controller()).unwrap();
    let other = Opening { bitrate_bps: 250_000, ..LISTEN };
    assert_eq!(driver.open(Channel::Can1, other), Err(Refusal::BadTiming));
    assert_eq!(driver.open(Channel::Can1, LISTEN), Ok(()));
    let (_, mut driver) = connected(Link { listen_only: true, ..controller() }).unwrap();
    assert_eq!(driver.open(Channel::Can1, NORMAL), Err(Refusal::Unsupported));
    // A virtual one has no rate, so any will do.
    let (_, mut driver) = connected(Link { bitrate_bps: None, ..controller() }).unwrap();
    assert_eq!(driver.open(Channel::Can1, other), Ok(()));
}

#[test]
fn the_row_is_that_of_the_interface() {
    let board = |link: &Link, hardware| row_of(link, hardware).board;
    let silent = Link { listen_only: true, ..controller() };
    assert_eq!(board(&controller(), false), "socketcan");
    assert_eq!(board(&controller(), true), "socketcan-hw");
    assert_eq!(board(&silent, false), "socketcan-silent");
    assert_eq!(board(&silent, true), "socketcan-hw-silent");
    assert_eq!(board(&Link { echoes: false, ..controller() }, false), "socketcan-no-echo");
    assert_eq!(board(&Link { echoes: false, ..controller() }, true), "socketcan-hw-no-echo");
    assert_eq!(board(&Link { bitrate_bps: None, ..controller() }, false), "socketcan-virtual");
}

#[test]
fn an_interface_that_is_down_or_no_can_interface_is_not_opened() {
    let down = connected(Link { is_up: false, bitrate_bps: None, ..controller() }).map(|_| ()).unwrap_err();
    assert!(down.to_string().contains("ip link set can0 up type can bitrate 500000"), "{down}");
    let other = connected(Link { is_can: false, ..controller() }).map(|_| ()).unwrap_err();
    assert!(matches!(other, OpenError::NoInterface { .. }), "{other}");
}

/// A container, a kernel without CAN: each says what to do.
#[test]
fn an_interface_that_the_system_does_not_give_says_what_to_do() {
    for (code, words) in [
        (EAFNOSUPPORT, "modprobe can-raw"),
        (EPERM, "a container or a sandbox forbids it"),
        (nix::libc::EIO, "dmesg"),
    ] {
        let error = unusable("can0", io::Error::from_raw_os_error(code)).to_string();
        assert!(error.contains(words) && error.contains("'can0'"), "{error}");
    }
}

#[test]
fn a_frame_s_time_is_the_driver_s_and_the_interval_of_two_is_the_controller_s() {
    let (fake, mut driver) = opened(controller());
    let ms = Duration::from_millis;
    let now = SystemTime::UNIX_EPOCH.elapsed().unwrap();
    let ago = |milliseconds| now.checked_sub(ms(milliseconds));
    let stamped = |software, hardware| Message { software, hardware, ..message("123#") };
    fake.lock().arrived = [
        Ok(stamped(ago(50), None)),
        Ok(stamped(ago(20), None)),
        Ok(stamped(ago(10), Some(ms(5_000)))),
        Ok(stamped(Some(now), Some(ms(5_003)))),
        // Of a clock that was set.
        Ok(stamped(Some(now + ms(100_000)), None)),
    ]
    .into();
    let before = Instant::now();
    driver.clock = AdapterClock::new(1, 1 << 62).starting(before.checked_sub(ms(1_000)).unwrap());
    let mut all = Vec::new();
    driver.poll(Duration::ZERO, &mut all).unwrap();
    let times: Vec<At> = all
        .iter()
        .filter_map(|incoming| match incoming {
            Incoming::Received { at, .. } => Some(*at),
            _ => None,
        })
        .collect();
    let apart = |a: usize, b: usize| times[b].instant - times[a].instant;
    assert_eq!((apart(0, 1), times[1].stamp), (ms(30), Stamp::UpperBound));
    assert_eq!((apart(2, 3), times[3].stamp), (ms(3), Stamp::Exact));
    assert!(times[4].instant >= before && times[4].stamp == Stamp::UpperBound);
}

/// Ctrl-C while more is waiting than the firmware's queue holds, on a computer so slow that it takes longer than a controller may take to leave
/// its bus.
#[test]
fn what_waits_in_the_socket_when_a_channel_is_closed_is_delivered() {
    let (fake, driver) = connected(controller()).unwrap();
    let device = cantap::Device::over(crate::engine::start(Box::new(driver)).unwrap(), "can0").unwrap();
    fake.lock().pace = Some((Duration::from_millis(2), 64));
    fake.lock().arrived = (0..20_000).map(|_| Ok(message("123#0102030405060708"))).collect();
    device.listen(Channel::Can1, 500_000).unwrap();
    let records = device.records();
    device.stop().unwrap();
    drop(device);
    let count = records.filter(|record| record.as_ref().is_ok_and(|record| record.frame().is_some())).count();
    assert_eq!(count, 20_000);
}

#[test]
fn fd_frames_are_sent_where_the_interface_takes_them_and_confirmed_as_they_come_back() {
    let (fake, mut driver) = opened(Link { takes_fd: true, ..controller() });
    assert!(driver.sends_fd());
    let id = cantap_wire::Id::extended(0x18DA_F110).unwrap();
    let frame = FdFrame::new(id, true, false, &[0xA5; 64]).unwrap();
    assert!(driver.send_fd(Channel::Can1, 1, &frame));
    let sent = fake.lock().sent_fd[0];
    assert_eq!((sent[4], sent[5], sent[71]), (64, 5, 0xA5));
    // The driver has found that its controller is error passive.
    let mut back = fd_message(0x98DA_F110, 7, &[0xA5; 64]);
    back.is_own = true;
    fake.lock().arrived = [Ok(fd_message(0x98DA_F110, 5, &[0xA5; 64])), Ok(back)].into();
    assert_eq!(reports(&mut driver), [format!("18DAF110##1{}", "A5".repeat(64)), "sent 1".to_owned()]);
    // The queue is full, then the owner has switched CAN FD off.
    fake.lock().refusals = [ENOBUFS, nix::libc::EINVAL].into();
    assert!(!driver.send_fd(Channel::Can1, 2, &frame));
    assert!(driver.send_fd(Channel::Can1, 2, &frame));
    assert_eq!(reports(&mut driver), ["not sent 2"]);
    let (_, driver) = opened(controller());
    assert!(!driver.sends_fd());
}
