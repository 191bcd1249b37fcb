//! Adapters through their makers' libraries: PCAN-Basic and CANlib as libraries of our own, in C after the makers' headers, and loaded as theirs
//! would be.

use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use cantap::wire::Refusal;
use cantap::{Channel, Device, DeviceError, TraceEvent};
use libloading::Library;
use tempfile::TempDir;

use crate::{frames, losses, send, send_fd, until, until_frame};

type Receive = unsafe extern "C" fn(u32, u32, u32, *const u8, u64);

/// A library in a folder of its own, so that no other test has its adapter.
struct StandIn {
    path: PathBuf,
    library: Library,
    _folder: TempDir,
}

/// What [`StandIn::set`] sets.
#[derive(Clone, Copy)]
enum Set {
    BusStatus = 0,
    ReadStatus = 1,
    Unplugged = 2,
    IgnoresListening = 3,
    KnowsEchoes = 4,
    Occupied = 5,
    Features = 6,
    Room = 7,
    Babbles = 8,
    Hangs = 9,
}

/// What [`StandIn::get`] reads.
#[derive(Clone, Copy)]
enum Get {
    SentCount = 0,
    BitRate = 1,
    IsOnBus = 2,
    Output = 3,
    LastSent = 4,
    DataBitRate = 5,
    LastKind = 6,
    LastLength = 7,
}

impl StandIn {
    /// Compiles and loads it; `None` where there is no compiler for C, which is said.
    fn new(name: &str) -> Option<Self> {
        if Command::new("cc").arg("--version").output().is_err() {
            println!("not tested: there is no cc");
            return None;
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(format!("lib{name}.so"));
        let source =
            PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/stand_in").join(name).with_extension("c");
        let compiled = Command::new("cc")
            .args(["-shared", "-fPIC", "-Wall", "-Wextra", "-Werror", "-O1", "-pthread", "-o"])
            .args([&path, &source])
            .output()
            .unwrap();
        assert!(compiled.status.success(), "{}", String::from_utf8_lossy(&compiled.stderr));
        // SAFETY: compiled a moment ago from the file beside this one, which does nothing when it is loaded.
        let library = unsafe { Library::new(&path) }.unwrap();
        Some(Self { path, library, _folder: folder })
    }

    fn address(&self, channel: &str, more: &str) -> String {
        format!("{channel}?library={}{more}", self.path.display())
    }

    fn set(&self, what: Set, value: u32) {
        // SAFETY: the type is that of the file in C.
        unsafe {
            let set = self.library.get::<unsafe extern "C" fn(u32, u32)>(b"standin_set").unwrap();
            set(what as u32, value);
        }
    }

    fn get(&self, what: Get) -> u32 {
        // SAFETY: the type is that of the file in C.
        unsafe { self.library.get::<unsafe extern "C" fn(u32) -> u32>(b"standin_get").unwrap()(what as u32) }
    }

    fn receive(&self, id: u32, kind: u32, len: u32, data: &[u8], us: u64) {
        let mut bytes = [0; 64];
        bytes[..data.len()].copy_from_slice(data);
        // SAFETY: the type is that of the file in C, which reads 64 bytes; its numbers of eight bits are passed as those of 32 are.
        unsafe {
            self.library.get::<Receive>(b"standin_receive").unwrap()(id, kind, len, bytes.as_ptr(), us);
        }
    }
}

fn open_error(address: &str) -> String {
    let place = address.parse::<cantap_adapters::Place>().unwrap();
    cantap_adapters::open(&place).map(|_| ()).unwrap_err().to_string()
}

fn refusal(error: &DeviceError) -> Option<Refusal> {
    match error {
        DeviceError::Refused { refusal } => Some(*refusal),
        _ => None,
    }
}

#[test]
fn a_library_that_is_not_there_is_named_with_who_has_it() {
    for (address, maker) in [("pcan:", "peak-system.com"), ("kvaser:0", "kvaser.com")] {
        let error = open_error(address);
        assert!(error.contains("cannot be loaded") && error.contains(maker), "{error}");
    }
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("libtext.so");
    // One of 32 bits, as far as the loader looks, and a text.
    let elf32 = [b"\x7FELF\x01\x01\x01".as_slice(), &[0; 9], &[3, 0, 3, 0, 1, 0, 0, 0], &[0; 4096]].concat();
    for content in [elf32, b"no library".repeat(100)] {
        std::fs::write(&file, content).unwrap();
        let error = open_error(&format!("pcan:?library={}", file.display()));
        assert!(error.contains("cannot be loaded") && error.contains("is no library for"), "{error}");
    }
    assert!(open_error("pcan:?library=libpcanbasic.so").contains("must begin with the root"));
}

#[test]
fn one_maker_s_library_is_not_the_other_s() {
    let Some(library) = StandIn::new("canlib") else { return };
    let error = open_error(&library.address("pcan:", ""));
    assert!(error.contains("has no function CAN_Initialize"), "{error}");
}

#[test]
fn pcan_frames_arrive_with_the_adapter_s_intervals() {
    let Some(library) = StandIn::new("pcanbasic") else { return };
    let device = crate::open(&library.address("pcan:", ""));
    assert_eq!(device.hello().board, "pcan");
    device.listen(Channel::Can1, 500_000).unwrap();
    assert_eq!((library.get(Get::IsOnBus), library.get(Get::Output)), (1, 1), "on the bus, and silent");
    assert_eq!(library.get(Get::BitRate) & 0x3FFF, 0x001C);
    library.receive(0x123, 0, 2, &[0x11, 0x22], 1_000_000);
    let first = until_frame(&device, "123#1122");
    // No sooner than it was stamped: nothing arrives before that.
    std::thread::sleep(Duration::from_millis(5));
    library.receive(0x1ABC_DEF0, 2, 8, &[1, 2, 3, 4, 5, 6, 7, 8], 1_000_777);
    library.receive(0x7FF, 1, 3, &[], 1_002_000);
    // No frame has such an identifier, or such a length.
    library.receive(0x800, 0, 1, &[1], 1_003_000);
    library.receive(0x100, 0, 200, &[1], 1_003_500);
    library.receive(0x200, 0, 0, &[], 1_004_000);
    let rest = until_frame(&device, "200#");
    let records = [first, rest].concat();
    assert_eq!(frames(&records), ["123#1122", "1ABCDEF0#0102030405060708", "7FF#R3", "200#"]);
    assert_eq!(losses(&records), [("link", 1), ("link", 1)]);
    let times: Vec<i64> =
        records.iter().filter(|record| record.frame().is_some()).map(|record| record.time_ns).collect();
    let interval_us = (times[1] - times[0] + 500) / 1000;
    assert!((interval_us - 777).abs() <= 1, "{interval_us}");
}

#[test]
fn pcan_losses_states_and_errors_are_reported_once_each() {
    let Some(library) = StandIn::new("pcanbasic") else { return };
    let device = crate::open(&library.address("pcan:PCAN_USBBUS1", ""));
    device.listen(Channel::Can1, 250_000).unwrap();
    // The queue was read too late: said by a read, and in the status for as long as anybody asks.
    library.set(Set::BusStatus, 0x40 | 0x4_0000);
    library.set(Set::ReadStatus, 0x40);
    let records = until(&device, |record| matches!(record.event, TraceEvent::State { .. }));
    assert_eq!(losses(&records), [("queue", 1)]);
    library.receive(4, 0x40, 4, &[1, 0x88, 9, 7], 1_000_000);
    library.receive(1, 0x40, 4, &[1, 0x88, 9, 7], 1_000_100);
    let status = 0x10_u32.to_be_bytes();
    library.receive(0, 0x80, 4, &status, 1_001_000);
    library.receive(0x42, 0, 0, &[], 1_002_000);
    let records = until_frame(&device, "042#");
    assert_eq!(losses(&records), [] as [(&str, u32); 0]);
    let names = |record: &cantap::TraceRecord| match record.event {
        TraceEvent::BusError { kind, .. } => Some(kind.map_or("bus error", |kind| kind.name())),
        TraceEvent::ErrorsSuppressed { .. } => Some("errors"),
        TraceEvent::State { state, .. } => Some(state.name()),
        _ => None,
    };
    let seen: Vec<&str> = records.iter().filter_map(names).collect();
    assert!(seen.contains(&"stuff") && seen.contains(&"bus-off"), "{seen:?}");
}

#[test]
fn pcan_sends_only_in_normal_mode_and_confirms_what_was_on_the_bus() {
    let Some(library) = StandIn::new("pcanbasic") else { return };
    let device = crate::open(&library.address("pcan:", ""));
    device.join(Channel::Can1, 500_000).unwrap();
    assert_eq!(library.get(Get::Output), 0);
    assert_eq!(send(&device, "123#AABB").result.unwrap().to_string(), "123#AABB");
    assert_eq!((library.get(Get::SentCount), library.get(Get::LastSent)), (1, 0x123));
    // A queue that is full makes the frame wait, and it is sent once there is room.
    library.set(Set::Room, 1);
    let ends = device.transmissions();
    let frame = cantap::wire::message::TxFrame { tag: 9, frame: "124#".parse().unwrap(), at_ticks: None };
    device.send(Channel::Can1, &[frame]).unwrap();
    library.set(Set::Room, 2);
    assert!(ends.recv().unwrap().result.is_ok());
    drop(device);
    assert_eq!(library.get(Get::IsOnBus), 0);
}

#[test]
fn an_old_pcan_library_confirms_that_it_has_accepted_a_frame() {
    let Some(library) = StandIn::new("pcanbasic") else { return };
    library.set(Set::KnowsEchoes, 0);
    let device = crate::open(&library.address("pcan:", ""));
    device.join(Channel::Can1, 500_000).unwrap();
    assert_eq!(send(&device, "7DF#02010C").result.unwrap().to_string(), "7DF#02010C");
}

#[test]
fn a_pcan_adapter_that_will_not_be_silent_leaves_the_bus_again() {
    let Some(library) = StandIn::new("pcanbasic") else { return };
    library.set(Set::IgnoresListening, 1);
    let device = crate::open(&library.address("pcan:", ""));
    let error = device.listen(Channel::Can1, 500_000).unwrap_err();
    assert_eq!(refusal(&error), Some(Refusal::Unsupported), "{error}");
    assert_eq!(library.get(Get::IsOnBus), 0);
}

#[test]
fn a_pcan_channel_that_another_program_has_is_left_to_it() {
    let Some(library) = StandIn::new("pcanbasic") else { return };
    library.set(Set::Occupied, 1);
    assert!(open_error(&library.address("pcan:", "")).contains("another program has it"));
    assert!(open_error(&library.address("pcan:PCAN_USBBUS2", "")).contains("there are PCAN_USBBUS1"));
    // It was free a moment ago.
    library.set(Set::Occupied, 2);
    let device = crate::open(&library.address("pcan:", ""));
    assert_eq!(refusal(&device.listen(Channel::Can1, 500_000).unwrap_err()), Some(Refusal::Held));
}

#[test]
fn pcan_fd_needs_an_adapter_with_it() {
    let Some(library) = StandIn::new("pcanbasic") else { return };
    let address = library.address("pcan:", "&data-bitrate=2M");
    assert!(open_error(&address).contains("no CAN FD"));
    library.set(Set::Features, 1);
    let device = crate::open(&address);
    device.listen(Channel::Can1, 500_000).unwrap();
    // FD with a switched bit rate, 12 bytes; then a remote frame that claims to be FD.
    library.receive(0x123, 4 | 8, 9, &[7; 12], 1_000_000);
    library.receive(0x124, 4 | 1, 9, &[7; 12], 1_001_000);
    library.receive(0x125, 0, 1, &[1], 1_002_000);
    let records = until_frame(&device, "125#01");
    assert_eq!(frames(&records), ["123##1070707070707070707070707", "125#01"]);
    assert_eq!(losses(&records), [("link", 1)]);
}

#[test]
fn a_pcan_adapter_that_is_pulled_out_ends_the_session_with_its_driver_s_words() {
    let Some(library) = StandIn::new("pcanbasic") else { return };
    let device = crate::open(&library.address("pcan:", ""));
    device.listen(Channel::Can1, 500_000).unwrap();
    library.receive(0x123, 0, 0, &[], 1_000_000);
    until_frame(&device, "123#");
    library.set(Set::Unplugged, 1);
    let end = device.records().find_map(Result::err).unwrap().to_string();
    assert!(end.contains("A hardware handle is invalid"), "{end}");
}

#[test]
fn kvaser_frames_losses_and_errors_arrive() {
    let Some(library) = StandIn::new("canlib") else { return };
    // The only channel that is not virtual.
    let device = crate::open(&library.address("kvaser:", ""));
    assert_eq!(device.hello().board, "kvaser");
    device.listen(Channel::Can1, 500_000).unwrap();
    assert_eq!((library.get(Get::IsOnBus), library.get(Get::Output)), (1, 1), "on the bus, and silent");
    assert_eq!(library.get(Get::BitRate), 500_000);
    library.receive(0x123, 2, 2, &[0x11, 0x22], 1_000_000);
    library.receive(0x1ABC_DEF0, 4 | 0x200, 1, &[9], 1_000_500);
    library.receive(0, 0x20 | 0x2000, 0, &[], 1_001_000);
    library.receive(0x100, 2, 77, &[], 1_002_000);
    library.receive(0x200, 2 | 1, 4, &[], 1_003_000);
    let records = until_frame(&device, "200#R4");
    assert_eq!(frames(&records), ["123#1122", "1ABCDEF0#09", "200#R4"]);
    assert_eq!(losses(&records), [("controller", 1), ("link", 1)]);
    assert!(records.iter().any(|record| matches!(record.event, TraceEvent::BusError { .. })));
    // The status tells of the same loss once more.
    library.set(Set::BusStatus, 0x200 | 1);
    let records = until(&device, |record| {
        matches!(record.event, TraceEvent::State { state: cantap::wire::record::ErrorState::Passive, .. })
    });
    assert_eq!(losses(&records), []);
    // A counter beyond what a controller has is not wrapped round.
    assert!(matches!(records.last().unwrap().event, TraceEvent::State { counters: Some((130, 255)), .. }));
}

#[test]
fn kvaser_sends_with_confirmation_and_leaves_the_bus() {
    let Some(library) = StandIn::new("canlib") else { return };
    let device = crate::open(&library.address("kvaser:0", ""));
    device.join(Channel::Can1, 250_000).unwrap();
    assert_eq!(library.get(Get::Output), 4);
    assert_eq!(send(&device, "18FEF100#0102").result.unwrap().to_string(), "18FEF100#0102");
    assert_eq!(library.get(Get::LastSent), 0x18FE_F100);
    drop(device);
    assert_eq!(library.get(Get::IsOnBus), 0);
}

#[test]
fn a_kvaser_channel_that_is_busy_deaf_or_absent_is_refused() {
    let Some(library) = StandIn::new("canlib") else { return };
    let error = open_error(&library.address("kvaser:5", ""));
    assert!(error.contains("0 (Kvaser Leaf Light v2 (channel 0)), 1 (Kvaser Virtual"), "{error}");
    let listen = |library: &StandIn| -> DeviceError {
        let device: Device = crate::open(&library.address("kvaser:1", ""));
        device.listen(Channel::Can1, 500_000).unwrap_err()
    };
    library.set(Set::Occupied, 1);
    assert_eq!(refusal(&listen(&library)), Some(Refusal::Held));
    library.set(Set::Occupied, 0);
    library.set(Set::IgnoresListening, 1);
    assert_eq!(refusal(&listen(&library)), Some(Refusal::Unsupported));
    assert_eq!(library.get(Get::IsOnBus), 0);
}

#[test]
fn kvaser_fd_and_a_pulled_adapter() {
    let Some(library) = StandIn::new("canlib") else { return };
    let device = crate::open(&library.address("kvaser:0", "&data-bitrate=2M"));
    device.listen(Channel::Can1, 500_000).unwrap();
    assert_eq!(library.get(Get::DataBitRate), 2_000_000);
    library.receive(0x123, 2 | 0x1_0000 | 0x2_0000, 12, &[7; 12], 1_000_000);
    // A length that CAN FD does not have.
    library.receive(0x123, 2 | 0x1_0000, 11, &[7; 12], 1_001_000);
    library.receive(0x124, 2, 0, &[], 1_002_000);
    let records = until_frame(&device, "124#");
    assert_eq!(frames(&records), ["123##1070707070707070707070707", "124#"]);
    assert_eq!(losses(&records), [("link", 1)]);
    library.set(Set::Unplugged, 1);
    let end = device.records().find_map(Result::err).unwrap().to_string();
    assert!(end.contains("Hardware error"), "{end}");
}

/// Both makers' libraries, each with the address of its adapter.
fn both() -> impl Iterator<Item = (StandIn, String)> {
    [("pcanbasic", "pcan:"), ("canlib", "kvaser:0")].into_iter().filter_map(|(name, channel)| {
        let library = StandIn::new(name)?;
        let address = library.address(channel, "");
        Some((library, address))
    })
}

/// There is always another message, and every other one is no frame.
#[test]
fn libraries_that_never_run_out_of_messages_hold_up_no_request_and_what_has_no_room_is_counted() {
    for (library, address) in both() {
        let device = crate::open(&address);
        device.listen(Channel::Can1, 500_000).unwrap();
        library.set(Set::Babbles, 1);
        let mut count = 0;
        until(&device, |record| {
            count += u32::from(record.frame().is_some());
            count == 5000
        });
        for _ in 0..10 {
            device.status().unwrap();
        }
        assert!(device.failures().unwrap().last.contains("messages that are no frames"), "{address}");
        device.stop().unwrap();
        library.set(Set::Babbles, 0);
        assert_eq!(library.get(Get::IsOnBus), 0, "{address}");
        let counters = device.counters().channels[0];
        assert!(counters.lost_link + counters.lost_queue > 1000, "{address}: {counters:?}");
    }
}

/// A call that does not come back cannot be ended: whoever waits is told, and goes on once it has.
#[test]
fn libraries_that_hang_are_an_error_and_lose_nothing_that_was_captured() {
    for (library, address) in both() {
        let device = crate::open(&address);
        device.listen(Channel::Can1, 500_000).unwrap();
        library.receive(0x123, 2, 1, &[1], 1_000_000);
        until(&device, |record| record.frame().is_some());
        library.set(Set::Hangs, 1);
        let error = device.status().unwrap_err().to_string();
        assert!(error.contains("answered nothing"), "{error}");
        library.set(Set::Hangs, 0);
        assert_eq!(device.counters().channels[0].received, 1, "{address}");
        drop(device);
        assert_eq!(library.get(Get::IsOnBus), 0, "{address}");
    }
}

/// A classical frame beside it stays one, and without a data bit rate nothing of CAN FD is sent.
#[test]
fn pcan_and_kvaser_send_fd_frames_with_their_flags_and_confirm_them() {
    let long = format!("18DAF110##3{}", "A5".repeat(64));
    // As PCAN-Basic wants it: FD, extended, BRS and ESI, and a length code.
    if let Some(library) = StandIn::new("pcanbasic") {
        library.set(Set::Features, 1);
        let device = crate::open(&library.address("pcan:", "&data-bitrate=2M"));
        device.join(Channel::Can1, 500_000).unwrap();
        for (text, id, kind, dlc) in [
            (&*long, 0x18DA_F110, 4 | 2 | 8 | 16, 15),
            ("123##0112233445566778899AABBCC", 0x123, 4, 9),
            ("123##1", 0x123, 4 | 8, 0),
        ] {
            assert_eq!(send_fd(&device, text).result.unwrap().to_string(), text);
            let sent = [Get::LastSent, Get::LastKind, Get::LastLength].map(|what| library.get(what));
            assert_eq!(sent, [id, kind, dlc], "{text}");
        }
        assert_eq!(send(&device, "123#AABB").result.unwrap().to_string(), "123#AABB");
        assert_eq!([Get::LastKind, Get::LastLength].map(|what| library.get(what)), [0, 2]);
    }
    // As CANlib does: a number of bytes.
    if let Some(library) = StandIn::new("canlib") {
        let device = crate::open(&library.address("kvaser:0", "&data-bitrate=2M"));
        device.join(Channel::Can1, 500_000).unwrap();
        for (text, id, flags, len) in [
            (&*long, 0x18DA_F110, 0x7_0004, 64),
            ("123##0112233445566778899AABBCC", 0x123, 0x1_0002, 12),
            ("123##1", 0x123, 0x3_0002, 0),
        ] {
            assert_eq!(send_fd(&device, text).result.unwrap().to_string(), text);
            let sent = [Get::LastSent, Get::LastKind, Get::LastLength].map(|what| library.get(what));
            assert_eq!(sent, [id, flags, len], "{text}");
        }
        assert_eq!(send(&device, "123#AABB").result.unwrap().to_string(), "123#AABB");
        assert_eq!([Get::LastKind, Get::LastLength].map(|what| library.get(what)), [2, 2]);
        drop(device);
        let device = crate::open(&library.address("kvaser:0", ""));
        device.join(Channel::Can1, 500_000).unwrap();
        let count = library.get(Get::SentCount);
        let frame: cantap::TraceFrame = "123##1".parse().unwrap();
        let frame = cantap::wire::message::TxFdFrame { tag: 7, frame: *frame.fd().unwrap(), at_ticks: None };
        assert!(matches!(device.send_fd(Channel::Can1, &[frame]), Err(DeviceError::NoFd)));
        let frames = [frame].into_iter().collect();
        let asked = device.request(cantap::wire::Command::SendFd { channel: Channel::Can1, frames });
        assert_eq!(refusal(&asked.unwrap_err()), Some(Refusal::Unsupported), "not even if it is asked");
        assert_eq!(library.get(Get::SentCount), count);
    }
}
