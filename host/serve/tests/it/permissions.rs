//! What the owner of a server permits to each certificate, and the record of who did what.
#![cfg(feature = "tls")]

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use cantap::wire::Refusal;
use cantap::wire::message::{
    ChannelConfig, Filter, FrameKind, MAX_SEND, Mode, Modifier, Periodic, Role, Trigger, TxFrame,
};
use cantap::{Channel, Device, DeviceError};
use cantap_serve::audit::Audit;
use cantap_serve::listen::Listening;
use cantap_serve::permissions::Permissions;
use cantap_serve::tls::{self, Files, Keys, Server};
use cantap_serve::{Board, News, Settings};
use std::sync::mpsc::Receiver;

use crate::strangers::{BITRATE_BPS, any_port, board_at};

struct Served {
    board: Arc<Board>,
    server: Server,
    listening: Listening,
    told: Receiver<News>,
}

fn serve(folder: &Path) -> Served {
    serve_at(folder, Settings::at(BITRATE_BPS))
}

fn serve_at(folder: &Path, settings: Settings) -> Served {
    let (board, told) = board_at(settings);
    let files = Keys::in_folder(folder).unwrap().add_server(&["localhost".to_owned()]).unwrap();
    // An empty list, as it is before anybody is revoked, is none.
    let list = folder.join(tls::REVOKED);
    let server = Server::new(&files, list.exists().then_some(list.as_path())).unwrap();
    let listening = tls::listen(&board, any_port(), Role::Send, &server).unwrap();
    Served { board, server, listening, told }
}

impl Served {
    fn connect(&self, files: &Files) -> Result<Device, String> {
        let address = format!("localhost:{}", self.listening.address().unwrap().port());
        let link = tls::connect(&address, files).map_err(|error| error.to_string())?;
        Device::over(link, "far").map_err(|error| error.to_string())
    }

    fn permit(&self, text: &str) {
        self.board.permit_only(Arc::new(Permissions::parse(text).unwrap()), 0);
    }

    /// Waits for a message of the server that contains this.
    fn tells(&self, wanted: &str) {
        let mut others = Vec::new();
        let is_it = |news: News| {
            others.push(news.to_string());
            news.to_string().contains(wanted)
        };
        assert!(self.told.iter().any(is_it), "{wanted}: {others:?}");
    }
}

fn in_mode(device: &Device, mode: Mode) -> ChannelConfig {
    ChannelConfig { mode, ..ChannelConfig::listen_only(device.timing(BITRATE_BPS).unwrap()) }
}

fn frame(text: &str) -> TxFrame {
    TxFrame { tag: 1, frame: text.parse().unwrap(), at_ticks: None }
}

fn is_refused<T: std::fmt::Debug>(result: &Result<T, DeviceError>, why: &str) {
    let is_it = matches!(&result, Err(DeviceError::Refused { refusal: Refusal::NotGranted { .. } }));
    assert!(is_it, "{why}: {result:?}");
}

#[test]
fn a_client_does_what_its_permissions_name_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let served = serve(folder.path());
    served.permit(
        "[clients.alice]\nchannels = [1]\nsend = [\"123\", \"700:7F0\"]\nmodes = [\"normal\"]\nframes_per_second = 50",
    );
    let keys = Keys::in_folder(folder.path()).unwrap();
    let alice = keys.add_client("alice", Role::Send).unwrap();
    let bob = keys.add_client("bob", Role::Send).unwrap();
    let refused = served.connect(&bob).err().unwrap();
    assert!(refused.contains("the permissions do not name its certificate"), "{refused}");
    let device = served.connect(&alice).unwrap();
    is_refused(&device.open_channel(Channel::Can2, Some(in_mode(&device, Mode::Normal))), "channel 2");
    is_refused(&device.open_channel(Channel::Can1, Some(in_mode(&device, Mode::Loopback))), "loopback");
    served.tells("the mode loopback is not permitted");
    device.open_channel(Channel::Can1, Some(in_mode(&device, Mode::Normal))).unwrap();
    device.send(Channel::Can1, &[frame("123#11"), frame("70F#")]).unwrap();
    is_refused(&device.send(Channel::Can1, &[frame("123#11"), frame("124#")]), "another identifier");
    served.tells("sending 124 is not permitted");
    is_refused(&device.send(Channel::Can1, &[frame("00000123#")]), "an extended identifier");
    let periodic = |text: &str, period_ticks| Periodic {
        frame: text.parse().unwrap(),
        period_ticks,
        count: 0,
        modifiers: [].into_iter().collect(),
    };
    let tick_hz = device.hello().tick_hz;
    is_refused(&device.set_periodic(Channel::Can1, 0, Some(periodic("124#", tick_hz))), "another identifier");
    is_refused(&device.set_periodic(Channel::Can1, 0, Some(periodic("123#", tick_hz / 51))), "51 frames/s");
    device.set_periodic(Channel::Can1, 0, Some(periodic("123#", tick_hz / 49))).unwrap();
    is_refused(&device.set_periodic(Channel::Can1, 1, Some(periodic("123#", tick_hz / 2))), "2 more");
    let filter = Filter { extended: false, kind: FrameKind::Any, id: 0x123, mask: 0x7FF };
    let reply = Trigger { filter, reply: "123#".parse().unwrap(), count: 1 };
    is_refused(&device.set_trigger(Channel::Can1, 0, Some(reply)), "replies cannot be limited");
    // Whoever has no certificate is not restricted by what is written of certificates.
    let local = crate::strangers::client(&served.board, "local", Role::Listen);
    local.listen(Channel::Can2, BITRATE_BPS).unwrap();
}

/// However a certificate's frames are sent: over several connections, by connecting again, by entries that are set again and again, or
/// that are replaced by one that the board refuses.
#[test]
fn so_many_frames_per_second_of_a_certificate_and_no_more() {
    let folder = tempfile::tempdir().unwrap();
    // What is sent periodically goes on while nothing is said, so that its share stays.
    let served = serve_at(folder.path(), Settings { dead_man: None, ..Settings::at(BITRATE_BPS) });
    served.permit("[clients.alice]\nframes_per_second = 50");
    let alice = Keys::in_folder(folder.path()).unwrap().add_client("alice", Role::Send).unwrap();
    let come = || {
        let device = served.connect(&alice).unwrap();
        device.open_channel(Channel::Can1, Some(in_mode(&device, Mode::Normal))).unwrap();
        device
    };
    let first = come();
    let tick_hz = first.hello().tick_hz;
    let periodic = |period_ticks| Periodic {
        frame: "123#".parse().unwrap(),
        period_ticks,
        count: 0,
        modifiers: [].into_iter().collect(),
    };
    let is_full = |result: Result<u16, DeviceError>, why: &str| {
        let is_it = matches!(&result, Err(DeviceError::Refused { refusal: Refusal::QueueFull { .. } }));
        assert!(is_it, "{why}: {result:?}");
    };
    first.set_periodic(Channel::Can1, 0, Some(periodic(tick_hz / 40))).unwrap();
    let second = come();
    is_refused(
        &second.set_periodic(Channel::Can1, 0, Some(periodic(tick_hz / 11))),
        "11 more by another connection",
    );
    // The board takes no modifier of a byte that is not there; the entry goes on.
    let bad =
        Periodic { modifiers: [Modifier::Random { byte: 7 }].into_iter().collect(), ..periodic(tick_hz) };
    assert!(first.set_periodic(Channel::Can1, 0, Some(bad)).is_err());
    is_refused(&first.set_periodic(Channel::Can1, 1, Some(periodic(tick_hz / 11))), "11 more beside it");
    first.set_periodic(Channel::Can1, 0, None).unwrap();
    // All that is there at once: then an entry's first frame has to wait as well, and a third connection brings none.
    first.set_periodic(Channel::Can1, 0, Some(periodic(tick_hz / 49))).unwrap();
    let many: Vec<TxFrame> = (0..MAX_SEND).map(|_| frame("123#")).collect();
    while first.send(Channel::Can1, &many).is_ok() {}
    first.time().unwrap();
    is_full(second.send(Channel::Can1, &many), "another connection");
    drop(second);
    let third = come();
    first.time().unwrap();
    is_full(third.send(Channel::Can1, &many), "one that comes again");
    // What was left of the last request is theirs, and the one frame in each second that the entry leaves, however long it takes.
    let (mut set, began) = (0, Instant::now());
    while third.set_periodic(Channel::Can1, 0, Some(periodic(u32::MAX))).is_ok() {
        set += 1;
        first.time().unwrap();
        let elapsed = began.elapsed().as_secs() as usize;
        assert!(set <= MAX_SEND + elapsed + 2, "entries that are set again and again: {set} in {elapsed} s");
        if elapsed > 20 {
            break;
        }
    }
}

/// Such as a cyclic frame whose data change: no more leaves than the rate, and no client has to clear it first.
#[test]
fn an_entry_that_takes_its_certificate_s_whole_rate_is_replaced() {
    let folder = tempfile::tempdir().unwrap();
    let served = serve_at(folder.path(), Settings { dead_man: None, ..Settings::at(BITRATE_BPS) });
    served.permit("[clients.alice]\nframes_per_second = 50");
    let alice = Keys::in_folder(folder.path()).unwrap().add_client("alice", Role::Send).unwrap();
    let device = served.connect(&alice).unwrap();
    device.open_channel(Channel::Can1, Some(in_mode(&device, Mode::Normal))).unwrap();
    let tick_hz = device.hello().tick_hz;
    let with = |text: &str| Periodic {
        frame: text.parse().unwrap(),
        period_ticks: tick_hz / 50,
        count: 0,
        modifiers: [].into_iter().collect(),
    };
    for data in 0..20 {
        device.set_periodic(Channel::Can1, 0, Some(with(&format!("123#{data:02X}")))).unwrap();
    }
    // Nothing is left for its first frame.
    let second = device.set_periodic(Channel::Can1, 1, Some(with("123#")));
    assert!(matches!(second, Err(DeviceError::Refused { refusal: Refusal::QueueFull { .. } })), "{second:?}");
    // By the device's stamps: none came earlier than the rate allows, over all of the replacements.
    let is_own = |record: &cantap::TraceRecord| record.frame().is_some_and(|frame| frame.data_len() == 1);
    let records = device.records().map_while(Result::ok).filter(is_own);
    let times: Vec<i64> = records.take(40).map(|record| record.time_ns).collect();
    assert!(times.len() == 40 && times[39] - times[0] >= 39 * 20_000_000 - 20_000_000, "{times:?}");
}

/// Configuring reaches further than listening: what is stored, a measurement and a restart concern channels that need not be open.
#[test]
fn who_has_one_channel_configures_no_other() {
    let folder = tempfile::tempdir().unwrap();
    let served = serve(folder.path());
    served.permit("[clients.carol]\nchannels = [1]");
    let carol = Keys::in_folder(folder.path()).unwrap().add_client("carol", Role::Configure).unwrap();
    let device = served.connect(&carol).unwrap();
    let config = in_mode(&device, Mode::ListenOnly);
    device.configure(Channel::Can1, config).unwrap();
    is_refused(&device.configure(Channel::Can2, config), "channel 2's settings");
    served.tells("channel 2 is not permitted");
    is_refused(&device.measure_edges(Some(Channel::Can2)), "a measurement of channel 2");
    is_refused(&device.save_defaults(), "both channels' settings");
    is_refused(&device.clear_defaults(), "both channels' settings");
    is_refused(&device.reset(), "a restart, which both channels see");
}

#[test]
fn permissions_that_change_let_those_go_whom_they_concern() {
    let folder = tempfile::tempdir().unwrap();
    let served = serve(folder.path());
    served.permit("[clients.alice]\n[clients.bob]");
    let keys = Keys::in_folder(folder.path()).unwrap();
    let [alice, bob] = ["alice", "bob"].map(|name| keys.add_client(name, Role::Listen).unwrap());
    let (_alice, bob) = (served.connect(&alice).unwrap(), served.connect(&bob).unwrap());
    served.permit("[clients.alice]\nchannels = [2]\n[clients.bob]");
    served.tells("was let go: its permissions have changed");
    bob.status().unwrap();
    let again = served.connect(&alice).unwrap();
    is_refused(&again.listen(Channel::Can1, BITRATE_BPS), "channel 1");
}

#[test]
fn a_revoked_client_is_let_go_and_does_not_get_in_again() {
    let folder = tempfile::tempdir().unwrap();
    let served = serve(folder.path());
    let keys = Keys::in_folder(folder.path()).unwrap();
    let [alice, bob, carol] =
        ["alice", "bob", "carol"].map(|name| keys.add_client(name, Role::Listen).unwrap());
    let list = keys.revoke_client("alice").unwrap();
    keys.revoke_client("carol").unwrap();
    assert!(keys.revoke_client("server").is_err() && keys.revoke_client("nobody").is_err());
    // As the server is started with it.
    let server = Server::new(&Keys::files(folder.path(), "server"), Some(&list)).unwrap();
    let listening = tls::listen(&served.board, any_port(), Role::Send, &server).unwrap();
    let at = |files: &Files| {
        let address = format!("localhost:{}", listening.address().unwrap().port());
        let link = tls::connect(&address, files).map_err(|error| error.to_string())?;
        Device::over(link, "far").map_err(|error| error.to_string())
    };
    assert!(at(&alice).is_err() && at(&carol).is_err());
    let connected = at(&bob).unwrap();
    // The server reads it again.
    keys.revoke_client("bob").unwrap();
    server.reload().unwrap();
    served.tells("was let go: its certificate is no longer trusted");
    assert!(at(&bob).is_err());
    drop(connected);
    // A new certificate of the same name is another one.
    let renewed = keys.renew_client("bob").unwrap();
    at(&renewed).unwrap();
    // A list that cannot be read changes nothing; that of another authority lets nobody in.
    std::fs::write(&list, "nothing").unwrap();
    assert!(server.reload().is_err());
    at(&renewed).unwrap();
    let other = tempfile::tempdir().unwrap();
    let others = Keys::in_folder(other.path()).unwrap();
    others.add_client("bob", Role::Listen).unwrap();
    std::fs::copy(others.revoke_client("bob").unwrap(), &list).unwrap();
    server.reload().unwrap();
    assert!(at(&renewed).is_err());
    // The first server has no list.
    drop(served.connect(&renewed).unwrap());
    served.server.reload().unwrap();
}

#[test]
fn the_record_has_who_did_what() {
    let folder = tempfile::tempdir().unwrap();
    let served = serve(folder.path());
    let path = folder.path().join("audit");
    let audit = Arc::new(Audit::open(&path, |text| panic!("{text}")).unwrap());
    served.board.record_to(Arc::clone(&audit));
    served.permit("[clients.alice]\nsend = [\"123\"]\n[clients.bob]\n");
    let keys = Keys::in_folder(folder.path()).unwrap();
    let alice = keys.add_client("alice", Role::Send).unwrap();
    let bob = keys.add_client("bob", Role::Listen).unwrap();
    let device = served.connect(&alice).unwrap();
    device.open_channel(Channel::Can1, Some(in_mode(&device, Mode::Normal))).unwrap();
    for _ in 0..5 {
        device.send(Channel::Can1, &[frame("123#11")]).unwrap();
    }
    is_refused(&device.send(Channel::Can1, &[frame("124#")]), "another identifier");
    // Whose role does not allow something is recorded, too.
    let listener = served.connect(&bob).unwrap();
    let normal = in_mode(&listener, Mode::Normal);
    assert!(listener.open_channel(Channel::Can1, Some(normal)).is_err());
    drop(listener);
    device.stop().unwrap();
    drop(device);
    served.tells("has left");
    served.tells("has left");
    let Served { board, listening, .. } = served;
    drop((listening, board, audit));
    let text = std::fs::read_to_string(&path).unwrap();
    let events: Vec<serde_json::Value> =
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let of = |name: &str| {
        let mut own = events.iter().filter(|event| event["certificate"] == "alice");
        own.find(|event| event["event"] == name).unwrap_or_else(|| panic!("{name} in {text}"))
    };
    for name in ["came", "opened", "sent", "not_permitted", "closed", "left"] {
        let event = of(name);
        assert!(event["address"].as_str().unwrap().starts_with("127.0.0.1:"), "{event}");
    }
    let refused = events.iter().filter(|event| event["event"] == "not_permitted");
    let refused: Vec<_> =
        refused.map(|event| (&event["certificate"], event["text"].as_str().unwrap())).collect();
    assert!(
        refused.iter().any(|(name, text)| *name == "bob" && text.contains("needs the right to send")),
        "{refused:?}"
    );
    assert_eq!(
        (&of("opened")["mode"], &of("opened")["bitrate_bps"]),
        (&"normal".into(), &BITRATE_BPS.into())
    );
    let sent = events.iter().filter(|event| event["event"] == "sent");
    assert_eq!(sent.filter_map(|event| event["frames"].as_u64()).sum::<u64>(), 5);
}

/// A pipe to which nobody writes would keep the server waiting, at its start and at each hang-up.
#[cfg(unix)]
#[test]
fn files_that_never_end_are_refused_by_every_option() {
    let folder = tempfile::tempdir().unwrap();
    let files = Keys::in_folder(folder.path()).unwrap().add_server(&["localhost".to_owned()]).unwrap();
    let pipe = folder.path().join("pipe");
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    for bad in [pipe.as_path(), Path::new("/dev/zero")] {
        let server =
            |files: Files, revoked| Server::new(&files, revoked).err().map(|error| error.to_string());
        let at = |path: &Path| path.to_owned();
        let reasons = [
            Permissions::read(bad).err().map(|error| error.to_string()),
            Audit::open(bad, |_| {}).err().map(|error| error.to_string()),
            server(Files { certificate: at(bad), ..files.clone() }, None),
            server(Files { authority: at(bad), ..files.clone() }, None),
            server(files.clone(), Some(bad)),
        ];
        for reason in reasons {
            assert!(
                reason.as_ref().is_some_and(|reason| reason.contains("give a regular file")),
                "{reason:?}"
            );
        }
    }
    let reason = Server::new(&Files { key: pipe, ..files }, None).err().map(|error| error.to_string());
    assert!(
        reason.as_ref().is_some_and(|reason| reason.contains("regular file") || reason.contains("chmod")),
        "{reason:?}"
    );
}

/// Programs close both channels to be sure; the record is of what they had.
#[test]
fn a_channel_that_was_never_open_is_not_recorded_as_closed() {
    let (board, _told) = board_at(Settings::at(BITRATE_BPS));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("audit");
    let audit = Arc::new(Audit::open(&path, |trouble| panic!("{trouble}")).unwrap());
    board.record_to(Arc::clone(&audit));
    let device = Device::over(board.link("client", Role::Listen).unwrap(), "client").unwrap();
    device.listen(Channel::Can1, BITRATE_BPS).unwrap();
    for channel in Channel::ALL {
        let _ = device.close_channel(channel);
        let _ = device.request(cantap::wire::Command::Close { channel });
    }
    drop(device);
    cantap_testing::process::wait_until("the client is still there", || board.clients() == 0);
    audit.finish();
    let text = std::fs::read_to_string(&path).unwrap();
    let closed: Vec<&str> = text.lines().filter(|line| line.contains("\"event\":\"closed\"")).collect();
    assert!(closed.len() == 1 && closed[0].contains("\"channel\":1"), "{text}");
}
