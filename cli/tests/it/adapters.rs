//! What commands say of an adapter that does not count its losses: never zero.

use std::io::Write;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::sync::mpsc;

use serde_json::Value;

use crate::served::server::Server;

/// A pipe into which another program writes a trace: nobody knows what that program lost. It stays open until the sender is dropped.
pub fn pipe(test: &str, text: String) -> (String, mpsc::Sender<()>) {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("adapters");
    std::fs::create_dir_all(&folder).unwrap();
    let pipe = folder.join(test);
    let _ = std::fs::remove_file(&pipe);
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let (done, ends) = mpsc::channel::<()>();
    let device = format!("candump:{}", pipe.display());
    std::thread::spawn(move || {
        let mut writer = std::fs::File::options().write(true).open(pipe).unwrap();
        let _ = writer.write_all(text.as_bytes());
        let _ = ends.recv();
    });
    (device, done)
}

/// Runs a command on such a pipe. Standard output and standard error.
fn on_pipe(test: &str, line: &str) -> (String, String) {
    // It does not go back to zero.
    let row = |at| format!("(1700000000.{:06}) can0 123#{at:04X}\n", at * 500);
    on_pipe_of(test, line, (0..100).map(row).collect())
}

/// The same with this trace.
fn on_pipe_of(test: &str, line: &str, text: String) -> (String, String) {
    let (device, done) = pipe(test, text);
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let args = line.split(' ').map(|arg| if arg == "PIPE" { device.as_str() } else { arg });
    let Output { status, stdout, stderr } = command.args(args).stdin(Stdio::null()).output().unwrap();
    drop(done);
    let text = |bytes| String::from_utf8(bytes).unwrap();
    let (out, err) = (text(stdout), text(stderr));
    assert!(status.success(), "{line}: {out}{err}");
    (out, err)
}

/// CAN FD frames of all lengths among classical ones, a millisecond apart, with each flag.
pub fn fd_rows() -> String {
    let lengths = [0, 1, 8, 12, 16, 20, 24, 32, 48, 64];
    let rows = lengths.iter().flat_map(|len| [format!("123##1{}", "5A".repeat(*len)), "7FF#11".to_owned()]);
    let rows = rows.chain(["18DAF110##2AA".to_owned(), "124##3".to_owned(), "125##0BB".to_owned()]);
    let lines: Vec<_> =
        rows.enumerate().map(|(at, text)| format!("(1700000000.{:06}) can0 {text}\n", at * 1000)).collect();
    lines.concat()
}

/// What a candump log has in its third column.
pub fn frames_of(log: &str) -> Vec<&str> {
    log.lines().filter_map(|line| line.split(' ').nth(2)).filter(|frame| !frame.starts_with('2')).collect()
}

#[test]
fn fd_frames_reach_files_as_they_are_and_those_without_a_place_for_them_say_so() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("adapters");
    let log = folder.join("fd.log");
    let (_, err) = on_pipe_of(
        "fd-log",
        &format!("capture -d PIPE -c 1 -b 500k -n 23 --force -o {}", log.display()),
        fd_rows(),
    );
    assert!(err.contains("23 frames") && err.contains("a data bit rate that is not known"), "{err}");
    let (written, wanted) = (std::fs::read_to_string(&log).unwrap(), fd_rows());
    assert_eq!(frames_of(&written), frames_of(&wanted));
    let table = folder.join("fd.csv");
    let line =
        format!("capture -d PIPE -c 1 -b 500k -n 23 --force --format csv-analyser -o {}", table.display());
    let (_, err) = on_pipe_of("fd-table", &line, fd_rows());
    assert!(err.contains("CAN FD frames, which the analyser's table has no row for"), "{err}");
}

#[test]
fn fd_frames_that_switch_have_a_load_only_with_their_data_bit_rate() {
    let stats = |test, rates: &str| {
        let line = format!("stats -d PIPE -c 1 {rates} -t 700ms --json");
        let (out, _) = on_pipe_of(test, &line, fd_rows());
        object(out.lines().last().unwrap())["channels"][0].clone()
    };
    let with = stats("fd-load", "-b 500k --data-bitrate 2M");
    assert_eq!((&with["fd"], &with["brs"], &with["esi"]), (&13.into(), &11.into(), &2.into()), "{with}");
    assert_eq!(with["data_bitrate_bps"], 2_000_000, "{with}");
    // Its figures are not known, since the trace arrived all at once; `work::Meter` and the statistics have tests of their own.
    assert!(with["load"].is_object(), "{with}");
    let without = stats("fd-no-load", "-b 500k");
    assert_eq!((&without["load"], &without["fd"]), (&Value::Null, &13.into()), "{without}");
}

/// Where somebody else has set the bit rate, only the load needs it.
#[test]
fn no_bit_rate_is_asked_for_where_only_the_load_needs_it() {
    let log = Path::new(env!("CARGO_TARGET_TMPDIR")).join("adapters/no-rate.log");
    let line = format!("capture -d PIPE -n 100 --force -o {}", log.display());
    let (out, _) = on_pipe("no-rate-json", &format!("{line} --json"));
    let channel = &object(&out)["channels"][0];
    assert_eq!((&channel["frames"], &channel["bus_load_pct"]), (&100.into(), &Value::Null), "{out}");
    let (_, err) = on_pipe("no-rate", &line);
    assert!(err.contains("the bit rate is not known: give it with -b"), "{err}");
    let (out, _) = on_pipe("no-rate-stats", "stats -d PIPE -t 700ms");
    assert!(out.contains("bit rate unknown: give it with -b"), "{out}");
    let (out, _) = on_pipe("no-rate-monitor", "monitor PIPE --once -t 700ms --view statistics");
    // The pipe is opened once: who opens it first has what was written so far.
    assert!(out.contains("Channel 1: bit rate unknown (-b)\nFrames           100 "), "{out}");
    // Through a server, too.
    let (device, _done) = pipe("no-rate-doctor", "(1700000000.5) can0 123#11\n".repeat(50));
    let (_, out, _) = run(&["doctor", "-d", &device, "--json"]);
    assert!(!out.contains("cannot find a bit rate"), "{out}");
    let (device, _done) = pipe("no-rate-serve", "(1700000000.5) can0 123#11\n".repeat(50));
    let socket = std::env::temp_dir().join(format!("cantap-no-rate-{}.sock", std::process::id()));
    let _server = Server::start(&format!("-d {device} --unix {}", socket.display()), 1);
    let (code, _, err) = run(&["status", "-d", &format!("unix:{}", socket.display())]);
    assert_eq!(code, Some(0), "{err}");
    let (code, _, err) = run(&[
        "capture",
        "-d",
        &format!("unix:{}", socket.display()),
        "-t",
        "300ms",
        "--force",
        "-o",
        log.to_str().unwrap(),
    ]);
    assert!(!err.contains("no bit rate") && code != Some(2), "{err}");
    // And to send, and to replay as a trace has it.
    let (code, _, err) = run(&["send", "-d", "cannelloni://127.0.0.1:9?listen=0", "1", "123#11"]);
    assert_eq!(code, Some(0), "{err}");
    let trace = "(1.0) can0 123#11\n(1.2) can0 123#12\n";
    std::fs::write(&log, trace).unwrap();
    let (code, _, err) = run(&["replay", "-d", "cannelloni://127.0.0.1:9?listen=0", log.to_str().unwrap()]);
    assert_eq!(code, Some(0), "{err}");
}

/// Runs `cantap` and returns its exit code, standard output and standard error.
fn run(arguments: &[&str]) -> (Option<i32>, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_cantap")).args(arguments).output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

#[test]
fn an_fd_frame_is_refused_where_none_can_be_sent_before_anything_of_the_list_is() {
    let (code, out, err) = run(&["send", "-d", "virtual:load=0", "-b", "500k", "1", "123#11", "123##1AA"]);
    assert_eq!((code, out.as_str()), (Some(1), ""), "{err}");
    assert!(err.contains("'123##1AA' is a CAN FD frame: this device is a classical CAN controller"), "{err}");
    // A pipe only receives.
    let (device, _done) = pipe("fd-send", fd_rows());
    let (code, _, err) = run(&["send", "-d", &device, "-b", "500k", "1", "123##1AA"]);
    assert!(code == Some(1) && err.contains("use one with CAN FD"), "{err}");
    // Lengths and flags that nothing has, and a remote frame.
    for (frame, reason) in [
        (format!("123##1{}", "AA".repeat(9)), "--pad"),
        (format!("123##1{}", "AA".repeat(65)), "0 to 8, 12"),
        ("123##8".to_owned(), "flags"),
        ("123##1R".to_owned(), "not a frame"),
    ] {
        let (code, _, err) = run(&["send", "-d", "virtual", "1", &frame]);
        assert!(code == Some(2) && err.contains(reason), "{frame}: {err}");
    }
    let (code, _, err) = run(&["gen", "-d", "virtual:load=0", "1", "--fd", "-n", "1"]);
    assert!(code == Some(1) && err.contains("classical CAN controller"), "{err}");
}

/// The other end of a tunnel, and its address.
fn tunnel() -> (std::net::UdpSocket, String) {
    let peer = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    peer.set_read_timeout(Some(std::time::Duration::from_secs(20))).unwrap();
    let listen = std::net::UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let address = format!("cannelloni://{}?listen={listen}", peer.local_addr().unwrap());
    (peer, address)
}

/// What follows a datagram's header, of so many datagrams.
fn datagrams(peer: &std::net::UdpSocket, count: usize) -> Vec<Vec<u8>> {
    let mut bytes = [0; 200];
    (0..count).map(|_| peer.recv(&mut bytes).map(|len| bytes[5..len].to_vec()).unwrap()).collect()
}

#[test]
fn info_says_whether_there_is_can_fd_and_who_says_so() {
    let (_, out, err) = run(&["info", "-d", "virtual"]);
    assert!(out.contains("CAN FD          none (its controllers, which are classical)\n"), "{out}{err}");
    let (_peer, address) = tunnel();
    let (_, out, err) = run(&["info", "-d", &address, "--json"]);
    let can_fd = &object(&out)["can_fd"];
    let said = ["receives", "sends", "data_bitrate_bps"].map(|key| can_fd[key].clone());
    assert_eq!(said, [true.into(), true.into(), Value::Null], "{out}{err}");
}

#[test]
fn fd_frames_are_sent_confirmed_with_their_flags_and_padded_only_on_request() {
    let (peer, address) = tunnel();
    let (code, out, err) =
        run(&["send", "-d", &address, "-b", "500k", "1", "123##1AA", "7FF#11", "1##201.02", "--count", "2"]);
    assert_eq!(code, Some(0), "{err}");
    let printed: Vec<&str> = out.lines().filter_map(|line| line.split(' ').nth(2)).collect();
    assert_eq!(printed, ["123##1AA", "7FF#11", "001##20102", "123##1AA", "7FF#11", "001##20102"]);
    let sent = datagrams(&peer, 6);
    assert_eq!(sent[..2], [vec![0, 0, 1, 0x23, 0x81, 1, 0xAA], vec![0, 0, 7, 0xFF, 1, 0x11]]);
    // Nine bytes become twelve.
    let (code, out, err) =
        run(&["send", "-d", &address, "-b", "500k", "1", "--pad", "123##1112233445566778899"]);
    assert!(code == Some(0) && out.contains("123##1112233445566778899000000 T"), "{out}{err}");
    // Repeated, in turns; that none leaves before its time is tested on the device.
    let line =
        ["send", "-d", &address, "-b", "500k", "1", "123##1AA", "123#11", "--period", "20ms", "--count", "5"];
    let (code, out, err) = run(&line);
    let printed: Vec<&str> = out.lines().filter_map(|line| line.split(' ').nth(2)).collect();
    assert_eq!((code, printed), (Some(0), ["123##1AA", "123#11"].repeat(5)), "{err}");
}

#[test]
fn fd_frames_of_a_trace_and_made_up_ones_are_sent() {
    let (peer, address) = tunnel();
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("adapters");
    std::fs::create_dir_all(&folder).unwrap();
    let log = folder.join("fd-replay.log");
    std::fs::write(&log, fd_rows()).unwrap();
    let (code, out, err) = run(&["replay", "-d", &address, "-b", "500k", "-v", log.to_str().unwrap()]);
    assert!(code == Some(0) && err.contains("23 frames"), "{err}");
    let printed: Vec<&str> = out.lines().filter_map(|line| line.split(' ').nth(2)).collect();
    assert_eq!(printed, frames_of(&fd_rows()));
    datagrams(&peer, 23);
    let (code, out, err) = run(&[
        "gen", "-d", &address, "-b", "500k", "1", "--brs", "-g", "0", "-L", "64", "-I", "1", "-n", "3", "-v",
    ]);
    assert!(code == Some(0) && out.lines().filter(|line| line.contains("001##1")).count() == 3, "{out}{err}");
    assert!(datagrams(&peer, 3).iter().all(|frame| frame[..6] == [0, 0, 0, 1, 0xC0, 1] && frame.len() == 70));
    // A message of twelve bytes, whose length CAN FD has; one of ten is filled up on request.
    let database = folder.join("fd.dbc");
    let text = "BO_ 256 Twelve: 12 A\n SG_ S : 88|8@1+ (1,0) [0|0] \"\" A\nBO_ 257 Ten: 10 A\n SG_ T : 72|8@1+ (1,0) [0|0] \"\" A\n";
    std::fs::write(&database, text).unwrap();
    let database = database.to_str().unwrap();
    let (code, out, err) = run(&["send", "-d", &address, "-b", "500k", "1", "Twelve:S=7", "--db", database]);
    assert!(code == Some(0) && out.contains(&format!("100##0{}07 T", "00".repeat(11))), "{out}{err}");
    let (code, _, err) = run(&["send", "-d", &address, "-b", "500k", "1", "Ten:T=7", "--db", database]);
    assert!(code != Some(0) && err.contains("--pad"), "{err}");
    let (code, out, err) =
        run(&["send", "-d", &address, "-b", "500k", "1", "Ten:T=7", "--db", database, "--pad", "--brs"]);
    assert!(code == Some(0) && out.contains(&format!("101##1{}070000 T", "00".repeat(9))), "{out}{err}");
}

/// A server whose device is one tunnel and whose listener is another: what is on one side of both comes out on the other, with its flags.
#[test]
fn a_server_s_tunnel_carries_fd_frames_both_ways() {
    let (bus, device) = tunnel();
    let peer = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let folder = tempfile::tempdir().unwrap();
    let (socket, at) = (folder.path().join("socket"), peer.local_addr().unwrap());
    let line = format!(
        "-d {device} -b 500k --unix {} --cannelloni 1:127.0.0.1:0,{at} --allow cannelloni:send",
        socket.display()
    );
    let server = Server::start(&line, 2);
    let door = server.at[1].strip_prefix("cannelloni://").unwrap().split('?').next().unwrap();
    peer.connect(door).unwrap();
    // Until the server has the bus, it sends nothing, and says so.
    bus.set_read_timeout(Some(std::time::Duration::from_millis(100))).unwrap();
    let frames = [&[0x98, 0xDA, 0xF1, 0x10, 0x82, 0x02, 0xA5, 0x5A][..], &[0, 0, 1, 0x23, 1, 0x77]].concat();
    let mut bytes = [0; 200];
    let len = (0..).find_map(|number: u8| {
        peer.send(&[&[2, 0, number, 0, 2][..], &frames].concat()).unwrap();
        bus.recv(&mut bytes).ok()
    });
    // One datagram for each frame, or one for both.
    let first = &bytes[5..len.unwrap()];
    assert!(frames.starts_with(first) && first.len() >= 8, "{first:X?}");
    let answer = [&[2, 0, 0, 0, 1][..], &[0, 0, 7, 0xFF, 0x8C, 0x01], &[0x3C; 12]].concat();
    let listens = device.rsplit('=').next().unwrap();
    bus.send_to(&answer, format!("127.0.0.1:{listens}")).unwrap();
    peer.set_read_timeout(Some(std::time::Duration::from_secs(20))).unwrap();
    // What the tunnel says first is that the bus was left for a moment.
    let mut hears = || peer.recv(&mut bytes).map(|len| bytes[..len].ends_with(&answer[5..])).unwrap();
    while !hears() {}
}

fn object(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|_| panic!("{text}"))
}

#[test]
fn a_capture_from_one_has_an_unknown_number_of_losses() {
    let (_, err) = on_pipe("text", "capture -d PIPE -c 1 -b 500k -n 100");
    assert!(err.contains("100 frames") && err.contains(", an unknown number lost,"), "{err}");
    assert!(err.contains("lost: controller 0, queue 0, link 0, host 0, and an unknown number\n"), "{err}");
    assert!(err.contains("as far as the trace reports them") && !err.contains(" 0 lost"), "{err}");
    let (out, _) = on_pipe("json", "capture -d PIPE -c 1 -b 500k -n 100 --json");
    let summary = object(&out);
    assert_eq!(summary["lost"]["unknown"], 1, "{out}");
    assert_eq!(summary["channels"][0]["lost_at_least"], true, "{out}");
    // Nobody counted the losses of a file that came from there, either.
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("adapters");
    let file = folder.join("kept.pcapng");
    on_pipe("file", &format!("capture -d PIPE -c 1 -b 500k -n 100 --force -o {}", file.display()));
    let stats = Command::new(env!("CARGO_BIN_EXE_cantap")).arg("stats").arg(&file).output().unwrap();
    let text = String::from_utf8(stats.stdout).unwrap();
    assert!(text.contains("an unknown number lost") && !text.contains(" 0 lost"), "{text}");
}

#[test]
fn figures_of_one_that_are_not_counted_are_left_out() {
    let (out, _) = on_pipe("stats", "stats -d PIPE -c 1 -b 500k -t 500ms --json");
    let last = object(out.lines().last().unwrap());
    assert_eq!(last["lost_at_least"], true, "{out}");
    let (out, _) = on_pipe("status", "status -d PIPE");
    assert!(out.contains("lost: controller not counted by this adapter, queue 0"), "{out}");
    let (out, _) = on_pipe("status-json", "status -d PIPE --json");
    assert_eq!(object(&out)["channels"][0]["lost_controller"], Value::Null, "{out}");
    let (out, _) = on_pipe("info", "info -d PIPE --json");
    assert_eq!(object(&out)["adapter"]["counts_losses"], false, "{out}");
    let can_fd = &object(&out)["can_fd"];
    assert_eq!((&can_fd["receives"], &can_fd["sends"]), (&true.into(), &false.into()), "{out}");
}

/// A trigger on losses is for frames that are missing, not for an adapter that does not know.
#[test]
fn a_trigger_on_losses_does_not_take_it_for_one() {
    let (out, _) = on_pipe("trigger", "capture -d PIPE -c 1 -b 500k -t 500ms --trigger lost --json");
    assert_eq!(object(&out)["trigger"]["events"], 0, "{out}");
}
