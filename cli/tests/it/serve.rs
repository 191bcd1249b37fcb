//! `cantap serve`, and commands that use it: on a UNIX socket, over TCP, through ssh.
#![cfg(unix)]

use cantap_testing::peers;

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

const CANTAP: &str = env!("CARGO_BIN_EXE_cantap");

fn cantap(arguments: &str) -> Command {
    let mut command = Command::new(CANTAP);
    command
        .args(arguments.split_whitespace())
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    command
}

fn run(arguments: &str) -> (Option<i32>, String, String) {
    said(&cantap(arguments).output().unwrap())
}

fn said(output: &Output) -> (Option<i32>, String, String) {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code(), text(&output.stdout), text(&output.stderr))
}

/// A running server.
struct Server {
    child: Child,
    /// Its addresses, as printed.
    at: Vec<String>,
}

impl Server {
    fn start(arguments: &str, ways: usize) -> Self {
        let mut child = cantap(&format!("serve {arguments}")).stderr(Stdio::inherit()).spawn().unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let at = (0..ways).map(|_| lines.next().expect("it listens").unwrap()).collect();
        Self { child, at }
    }

    fn interrupt(&mut self) -> ExitStatus {
        signal(&self.child, Signal::INT);
        self.child.wait().unwrap()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn signal(child: &Child, signal: Signal) {
    kill_process(Pid::from_child(child), signal).unwrap();
}

fn socket(folder: &Path) -> String {
    folder.join("cantap.sock").display().to_string()
}

/// A candump log's lines as (seconds, channel and frame), without errors and losses.
fn log(path: &Path) -> Vec<(f64, String)> {
    let text = std::fs::read_to_string(path).unwrap();
    let line = |line: &str| {
        let (time, frame) = line.split_once(") ")?;
        Some((time.trim_start_matches('(').parse().ok()?, frame.to_owned()))
    };
    text.lines().filter_map(line).filter(|(_, frame)| !frame.contains(" 20000")).collect()
}

/// Checks two traces of one bus: the frames in both are the same, in the same order and at the same times.
fn agree(one: &[(f64, String)], other: &[(f64, String)]) {
    let of = |all: &[(f64, String)], channel: &str| {
        all.iter().filter(|(_, frame)| frame.starts_with(channel)).cloned().collect::<Vec<_>>()
    };
    for channel in ["can0", "can1"] {
        let (one, other) = (of(one, channel), of(other, channel));
        assert!(one.len() > 100 && other.len() > 100, "{channel}: {} and {}", one.len(), other.len());
        let frames = |of: &[(f64, String)], at: usize| {
            of[at..at + 12].iter().map(|(_, frame)| frame.clone()).collect::<Vec<_>>()
        };
        let find =
            |of: &[(f64, String)], what: &[String]| (0..of.len() - 12).find(|at| frames(of, *at) == what);
        // The one that began later starts within the other.
        let (from, to) = match find(&one, &frames(&other, 0)) {
            Some(at) => (at, 0),
            None => (0, find(&other, &frames(&one, 0)).expect("common frames")),
        };
        let common = (one.len() - from).min(other.len() - to);
        assert!(common > 100, "{channel}: {common}");
        for (a, b) in one[from..].iter().zip(&other[to..]) {
            assert_eq!(a.1, b.1);
            // Each has measured UTC by its own round trips, on a busy computer.
            assert!((a.0 - b.0).abs() < 0.02, "{a:?} {b:?}");
        }
    }
}

fn capture(at: &str, file: &Path, rest: &str) -> Command {
    cantap(&format!("capture -d {at} -o {} --json {rest}", file.display()))
}

fn nothing_lost(output: &Output) {
    let (code, out, err) = said(output);
    assert_eq!(code, Some(0), "{err}");
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    for stage in summary["lost"].as_object().unwrap() {
        assert_eq!(*stage.1, 0, "{summary}");
    }
}

#[test]
fn programs_share_a_device_each_with_all_of_its_frames() {
    let _turn = cantap_testing::process::turn();
    let folder = tempfile::tempdir().unwrap();
    let path = socket(folder.path());
    let mut server = Server::start(&format!("-d virtual:load=80 -b 500k --unix {path} --tcp 0"), 2);
    assert_eq!(server.at[0], format!("unix:{path}"));
    assert!(server.at[1].starts_with("tcp://127.0.0.1:"), "{:?}", server.at);
    assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
    let files: Vec<PathBuf> = (0..3).map(|number| folder.path().join(format!("{number}.log"))).collect();
    // Without a bit rate it uses the server's.
    let captures: Vec<Child> = [(&server.at[0], "-b 500k"), (&server.at[0], ""), (&server.at[1], "")]
        .iter()
        .zip(&files)
        .map(|((at, rate), file)| capture(at, file, &format!("{rate} -t 1s")).spawn().unwrap())
        .collect();
    for capture in captures {
        nothing_lost(&capture.wait_with_output().unwrap());
    }
    agree(&log(&files[0]), &log(&files[1]));
    agree(&log(&files[0]), &log(&files[2]));
    // Every command accepts the address.
    let (code, out, err) = run(&format!("info -d {} --json", server.at[0]));
    assert_eq!(code, Some(0), "{err}");
    assert!(out.contains("VIRTUAL"), "{out}");
    let (code, out, err) = run(&format!("stats -d {} -t 500ms", server.at[1]));
    assert_eq!(code, Some(0), "{out}{err}");
    // What is not allowed is refused, with the remedy.
    let (code, _, err) = run(&format!("send -d {} 1 123#11", server.at[0]));
    assert_eq!(code, Some(1));
    assert!(err.contains("the right to send") && err.contains("--allow send"), "{err}");
    let (code, _, err) =
        run(&format!("capture -d {} -b 125k -n 1 -o /dev/null --format candump", server.at[0]));
    assert_eq!(code, Some(1));
    assert!(err.contains("another bit rate"), "{err}");
    assert!(server.interrupt().success());
    assert!(!Path::new(&path).exists());
    let (code, _, err) =
        run(&format!("capture -d {} -b 500k -n 1 -o /dev/null --format candump", server.at[0]));
    assert_eq!(code, Some(1));
    assert!(err.contains("there is no server; start one with `cantap serve`"), "{err}");
}

#[test]
fn who_may_send_sends_and_others_see_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = socket(folder.path());
    let server = Server::start(&format!("-d virtual:load=0 -b 500k --unix {path} --allow send"), 1);
    let at = &server.at[0];
    let file = folder.path().join("heard.log");
    let listener = capture(at, &file, "-t 3s").spawn().unwrap();
    std::thread::sleep(Duration::from_millis(800));
    let (code, out, err) = run(&format!("send -d {at} -b 500k 1 123#112233"));
    assert_eq!(code, Some(0), "{out}{err}");
    let (code, out, err) = run(&format!("gen -d {at} -b 500k -n 50 -g 2 can1"));
    assert_eq!(code, Some(0), "{out}{err}");
    let (code, out, err) = said(&listener.wait_with_output().unwrap());
    assert_eq!(code, Some(0), "{err}");
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    for (stage, lost) in summary["lost"].as_object().unwrap() {
        // Each channel left its bus once, to join it as a node that sends.
        assert!(
            if stage == "off_bus" { *lost == 2 } else { stage == "off_bus_us" || *lost == 0 },
            "{summary}"
        );
    }
    let heard = log(&file);
    assert_eq!(
        heard.iter().filter(|(_, frame)| frame.starts_with("can0 123#112233")).count(),
        1,
        "{heard:?}"
    );
    assert_eq!(heard.iter().filter(|(_, frame)| frame.starts_with("can1 ")).count(), 50);
}

/// A stand-in for ssh: does on this computer what the other computer's shell would do.
fn ssh(folder: &Path) -> PathBuf {
    let program = folder.join("ssh");
    std::fs::write(
        &program,
        "#!/bin/sh\n[ \"$1 $2 $3\" = '-T -oBatchMode=yes --' ] || exit 255\nshift 4\nsleep ${FAR:-0}\nexec sh -c \"$*\"\n",
    )
    .unwrap();
    std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
    program
}

#[test]
fn a_capture_through_ssh_is_one_made_beside_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = socket(folder.path());
    let server = Server::start(&format!("-d virtual:load=70 -b 500k --unix {path}"), 1);
    let bin = Path::new(CANTAP).parent().unwrap().display().to_string();
    let search = format!("{bin}:{}", std::env::var("PATH").unwrap());
    let through = |command: &mut Command| {
        command.env("CANTAP_SSH", ssh(folder.path())).env("PATH", &search).spawn().unwrap()
    };
    let (near, far) = (folder.path().join("near.log"), folder.path().join("far.log"));
    let beside = capture(&server.at[0], &near, "-t 2500ms").spawn().unwrap();
    // A server's board is as good as any device.
    let remote = through(&mut capture(&format!("ssh://me@there/unix:{path}"), &far, "-b 500k -t 1s"));
    nothing_lost(&remote.wait_with_output().unwrap());
    nothing_lost(&beside.wait_with_output().unwrap());
    agree(&log(&near), &log(&far));
    // It listens unless the address says otherwise.
    let send = |at: &str| {
        said(&through(&mut cantap(&format!("send -d {at} -b 500k 1 123#11"))).wait_with_output().unwrap())
    };
    let (code, _, err) = send("ssh://there/virtual");
    assert_eq!(code, Some(1));
    assert!(err.contains("the right to send"), "{err}");
    let (code, _, err) = send("ssh://there/virtual?allow=send");
    assert_eq!(code, Some(0), "{err}");
    // A computer that takes a long time to reach.
    let far_away = through(cantap("info -d ssh://there/virtual").env("FAR", "4")).wait_with_output().unwrap();
    assert_eq!(far_away.status.code(), Some(0), "{}", String::from_utf8_lossy(&far_away.stderr));
    // Ctrl-C ends the capture, and then the other side: complete, with its summary.
    let mut interrupted =
        through(&mut capture("ssh://there/virtual:load=50", &folder.path().join("c.log"), "-b 500k"));
    std::thread::sleep(Duration::from_millis(1500));
    signal(&interrupted, Signal::INT);
    let started = Instant::now();
    while interrupted.try_wait().unwrap().is_none() {
        assert!(started.elapsed() < Duration::from_secs(5), "it does not end");
        std::thread::sleep(Duration::from_millis(20));
    }
    nothing_lost(&interrupted.wait_with_output().unwrap());
}

const SSHD: &str = "/usr/sbin/sshd";

/// A real ssh server on this computer, with its own keys, and the client's configuration for it.
struct Sshd {
    child: Child,
    /// The program used in place of ssh: ssh, with this server's settings.
    program: PathBuf,
}

impl Drop for Sshd {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Starts it, or returns the reason why that is impossible.
fn sshd(folder: &Path) -> Result<Sshd, String> {
    let has = |program: &str| Path::new(program).exists();
    if !has(SSHD) || !has("/usr/bin/ssh") {
        return Err("there is no ssh and sshd; on Debian run `apt-get install openssh-server`".to_owned());
    }
    let at = |name: &str| folder.join(name).display().to_string();
    for key in ["host", "user"] {
        let made =
            Command::new("ssh-keygen").args(["-q", "-t", "ed25519", "-N", "", "-f", &at(key)]).status();
        if !made.is_ok_and(|status| status.success()) {
            return Err("ssh-keygen makes no key".to_owned());
        }
    }
    std::fs::copy(at("user.pub"), at("authorized")).unwrap();
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let host_key = std::fs::read_to_string(at("host.pub")).unwrap();
    std::fs::write(at("known"), format!("[127.0.0.1]:{port} {host_key}")).unwrap();
    // The other computer has `cantap` in its path.
    let bin = Path::new(CANTAP).parent().unwrap().display().to_string();
    let server = format!(
        "Port {port}\nListenAddress 127.0.0.1\nHostKey {}\nPidFile none\nAuthorizedKeysFile {}\nStrictModes no\nUsePAM no\n\
         PasswordAuthentication no\nKbdInteractiveAuthentication no\nSetEnv PATH={bin}:/usr/bin:/bin\n",
        at("host"),
        at("authorized"),
    );
    std::fs::write(at("server"), server).unwrap();
    let client = format!(
        "Host localhost\n HostName 127.0.0.1\n Port {port}\n IdentityFile {}\n IdentitiesOnly yes\n UserKnownHostsFile {}\n \
         StrictHostKeyChecking yes\n",
        at("user"),
        at("known"),
    );
    std::fs::write(at("client"), client).unwrap();
    let program = folder.join("ssh");
    std::fs::write(&program, format!("#!/bin/sh\nexec /usr/bin/ssh -F {} \"$@\"\n", at("client"))).unwrap();
    std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
    if rustix::process::getuid().is_root() {
        // The folder to which it confines itself; a package's own start script creates it otherwise.
        std::fs::create_dir_all("/run/sshd").unwrap();
    }
    let log = std::fs::File::create(at("log")).unwrap();
    let child = Command::new(SSHD).args(["-D", "-e", "-f", &at("server")]).stderr(log).spawn().unwrap();
    let sshd = Sshd { child, program };
    let deadline = Instant::now() + Duration::from_secs(10);
    while Instant::now() < deadline {
        let reached =
            Command::new(&sshd.program).args(["-oBatchMode=yes", "localhost", "true"]).output().unwrap();
        if reached.status.success() {
            return Ok(sshd);
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    Err(format!("sshd lets nobody in: {}", std::fs::read_to_string(at("log")).unwrap_or_default()))
}

#[test]
fn a_capture_over_a_real_ssh_is_one_made_beside_it() {
    let folder = tempfile::tempdir().unwrap();
    let sshd = match sshd(folder.path()) {
        Ok(sshd) => sshd,
        Err(reason) => return peers::skip_without("ssh", &reason),
    };
    let path = socket(folder.path());
    let server = Server::start(&format!("-d virtual:load=70 -b 500k --unix {path} --allow send"), 1);
    let (near, far) = (folder.path().join("near.log"), folder.path().join("far.log"));
    let beside = capture(&server.at[0], &near, "-t 4s").spawn().unwrap();
    let through = |command: &mut Command| command.env("CANTAP_SSH", &sshd.program).output().unwrap();
    // A server's board is as good as any device.
    nothing_lost(&through(&mut capture(&format!("ssh://localhost/unix:{path}"), &far, "-b 500k -t 1s")));
    nothing_lost(&beside.wait_with_output().unwrap());
    agree(&log(&near), &log(&far));
    let send = |at: &str| said(&through(&mut cantap(&format!("send -d {at} -b 500k 1 123#11"))));
    let (code, _, err) = send(&format!("ssh://localhost/unix:{path}"));
    assert_eq!(code, Some(1));
    assert!(err.contains("the right to send"), "{err}");
    let (code, _, err) = send(&format!("ssh://localhost/unix:{path}?allow=send"));
    assert_eq!(code, Some(0), "{err}");
    // A client unknown to ssh gets no further.
    std::fs::write(folder.path().join("authorized"), "").unwrap();
    let (code, _, err) = send("ssh://localhost/virtual");
    assert_eq!(code, Some(1), "{err}");
    assert!(err.contains("Permission denied"), "{err}");
}

/// A relay between a client and its server that can be cut.
struct Cable {
    port: u16,
    ends: std::sync::Arc<std::sync::Mutex<Vec<TcpStream>>>,
}

impl Cable {
    fn new(to: &str) -> Self {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let ends: std::sync::Arc<std::sync::Mutex<Vec<TcpStream>>> = std::sync::Arc::default();
        let (kept, to) = (std::sync::Arc::clone(&ends), to.to_owned());
        std::thread::spawn(move || {
            for near in listener.incoming().map_while(Result::ok) {
                let Ok(far) = TcpStream::connect(&to) else { continue };
                let mut kept = kept.lock().unwrap();
                kept.extend([near.try_clone().unwrap(), far.try_clone().unwrap()]);
                for (mut from, mut to) in [(near.try_clone().unwrap(), far.try_clone().unwrap()), (far, near)]
                {
                    std::thread::spawn(move || std::io::copy(&mut from, &mut to));
                }
            }
        });
        Self { port, ends }
    }

    fn cut(&self) {
        for end in self.ends.lock().unwrap().drain(..) {
            let _ = end.shutdown(std::net::Shutdown::Both);
        }
    }
}

/// The client's trace has the gaps, and the frames around them; the server is unaffected.
#[test]
fn cut_connections_are_gaps_and_the_capture_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let path = socket(folder.path());
    let server = Server::start(&format!("-d virtual:load=40 -b 500k --unix {path} --tcp 0"), 2);
    let cable = Cable::new(server.at[1].strip_prefix("tcp://").unwrap());
    let (near, far) = (folder.path().join("near.log"), folder.path().join("far.log"));
    let beside = capture(&server.at[0], &near, "-t 8s").spawn().unwrap();
    // It begins before the other and ends after it, however busy the computer.
    let started = Instant::now();
    while std::fs::metadata(&near).map_or(0, |file| file.len()) < 1000 {
        assert!(started.elapsed() < Duration::from_secs(10), "nothing is captured");
        std::thread::sleep(Duration::from_millis(20));
    }
    let cut = capture(&format!("tcp://127.0.0.1:{}", cable.port), &far, "-t 4s").spawn().unwrap();
    for _ in 0..2 {
        std::thread::sleep(Duration::from_millis(1300));
        cable.cut();
    }
    let (code, out, err) = said(&cut.wait_with_output().unwrap());
    assert_eq!(code, Some(0), "{err}");
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(summary["gaps"]["count"], 2, "{summary} {err}");
    assert_eq!(err.matches("is back after").count(), 2, "{err}");
    nothing_lost(&beside.wait_with_output().unwrap());
    // Each stretch is in the other's trace.
    let (near, far) = (log(&near), log(&far));
    let of = |all: &[(f64, String)]| {
        let first = all.iter().filter(|(_, frame)| frame.starts_with("can0"));
        first.map(|(_, frame)| frame.clone()).collect::<Vec<_>>()
    };
    let (near, far) = (of(&near), of(&far));
    let mut stretches = 1;
    let mut at = near.windows(8).position(|window| *window == far[..8]).expect("common frames");
    for (number, frame) in far.iter().enumerate() {
        if near.get(at) != Some(frame) {
            let rest = &far[number..far.len().min(number + 8)];
            let next = near[at..].windows(rest.len()).position(|window| window == rest);
            at += next.unwrap_or_else(|| panic!("frame {number} is nobody's"));
            stretches += 1;
        }
        at += 1;
    }
    assert_eq!(stretches, 3);
}

#[test]
fn a_server_that_is_killed_leaves_a_gap_and_the_capture_goes_on_with_the_next() {
    let folder = tempfile::tempdir().unwrap();
    let path = socket(folder.path());
    let start = || Server::start(&format!("-d virtual:load=30 -b 500k --unix {path}"), 1);
    let server = start();
    let file = folder.path().join("all.log");
    let listener = capture(&server.at[0], &file, "-t 5s").spawn().unwrap();
    std::thread::sleep(Duration::from_millis(1200));
    // kill -9: its socket stays behind, and the next server replaces it.
    drop(server);
    assert!(Path::new(&path).exists());
    let _server = start();
    let (code, out, err) = said(&listener.wait_with_output().unwrap());
    assert_eq!(code, Some(0), "{err}");
    assert!(err.contains("vanished") && err.contains("is back after"), "{err}");
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(summary["gaps"]["count"], 1, "{summary}");
}

#[cfg(feature = "tls")]
#[test]
fn clients_of_other_computers_come_with_keys() {
    let folder = tempfile::tempdir().unwrap();
    let keys = folder.path().join("keys").display().to_string();
    let (code, _, err) = run(&format!("serve keygen {keys} --client alice:listen"));
    assert_eq!(code, Some(2), "{err}");
    assert!(err.contains("--host"), "{err}");
    let (code, out, err) = run(&format!("serve keygen {keys} --host 127.0.0.1 --client alice:listen"));
    assert_eq!(code, Some(0), "{err}");
    assert!(out.contains("alice-key.pem") && out.contains("server-key.pem"), "{out}");
    let files = format!("--tls {keys}/server.pem,{keys}/server-key.pem --clients {keys}/ca.pem");
    let server = Server::start(&format!("-d virtual:load=50 -b 500k --tcp 0 {files} --allow send"), 1);
    let at = &server.at[0];
    assert!(at.starts_with("tls://127.0.0.1:"), "{at}");
    let (code, _, err) = run(&format!("info -d {at}"));
    assert_eq!(code, Some(1));
    assert!(err.contains("CANTAP_KEYS"), "{err}");
    let file = folder.path().join("far.log");
    nothing_lost(&capture(&format!("{at}?keys={keys}/alice"), &file, "-t 500ms").output().unwrap());
    assert!(log(&file).len() > 100);
    let (code, _, err) = run(&format!("send -d {at}?keys={keys}/alice -b 500k 1 123#11"));
    assert_eq!(code, Some(1));
    assert!(err.contains("the right to send"), "{err}");
    // With another authority's keys, among them one named like the server's: refused immediately, with the
    // reason.
    let other = folder.path().join("other").display().to_string();
    let (code, _, err) = run(&format!("serve keygen {other} --host 127.0.0.1 --client eve:send"));
    assert_eq!(code, Some(0), "{err}");
    std::fs::copy(format!("{keys}/ca.pem"), format!("{other}/ca.pem")).unwrap();
    let (code, _, err) = run(&format!("info -d {at}?keys={other}/eve"));
    assert_eq!(code, Some(1));
    assert!(err.contains("lets nobody in with these keys") && err.contains("alert"), "{err}");
    // Without encryption, nothing answers.
    let (code, _, err) = run(&format!("info -d {}", at.replace("tls:", "tcp:")));
    assert_eq!(code, Some(1), "{err}");
    assert!(err.contains("does not let this client in"), "{err}");
}

/// Garbage, half-open peers and floods harm nobody, and receive nothing.
#[test]
fn strangers_on_the_port_hear_nothing_and_take_nobodys_place() {
    let mut server = Server::start("-d virtual:load=30 -b 500k --tcp 0", 1);
    let at = server.at[0].clone();
    let place = at.strip_prefix("tcp://").unwrap();
    let mut browser = TcpStream::connect(place).unwrap();
    browser.write_all(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    let flood: Vec<TcpStream> = (0..60).map(|_| TcpStream::connect(place).unwrap()).collect();
    browser.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
    let mut heard = Vec::new();
    // It is dropped without a byte: a peer that does not greet gets no answer.
    let closed = browser.read_to_end(&mut heard);
    assert!(closed.is_ok() && heard.is_empty(), "{closed:?} {heard:?}");
    drop(flood);
    for _ in 0..50 {
        drop(TcpStream::connect(place).unwrap());
    }
    let file = tempfile::NamedTempFile::new().unwrap();
    nothing_lost(&capture(&at, file.path(), "--format candump --force -t 500ms").output().unwrap());
    assert!(server.interrupt().success());
}

#[test]
fn what_cannot_be_served_is_said_at_once() {
    for (arguments, code, part) in [
        ("serve -d virtual -b 500k --tcp 0.0.0.0", 2, "everybody on every network"),
        ("serve -d virtual -b 500k --tcp 192.0.2.1", 2, "everybody on the network"),
        ("serve -d virtual -b 500k --tcp here", 2, "write it as 127.0.0.1:29537"),
        ("serve -d virtual -b 3:500k", 2, "no channel 3"),
        ("serve -d virtual -b 500k --unix /nowhere/at/all", 1, "no socket can be made at '/nowhere/at/all'"),
        ("serve -d /dev/nothing -b 500k", 1, "there is no device at '/dev/nothing'"),
        ("serve -d virtual -d virtual --stdio", 2, "--stdio serves one device"),
        ("capture -d tcp://127.0.0.1:9 -b 500k", 1, "there is no server"),
        ("capture -d ssh://-oProxyCommand=x -b 500k", 2, "is not the name of a computer"),
    ] {
        let (exit, out, err) = run(arguments);
        assert_eq!(exit, Some(code), "{arguments}: {out}{err}");
        assert!(err.contains(part), "{arguments}: {err}");
    }
}

/// A path may name anything.
#[test]
fn what_is_no_abandoned_socket_stays() {
    let folder = tempfile::tempdir().unwrap();
    let notes = folder.path().join("notes.txt");
    std::fs::write(&notes, "mine").unwrap();
    let (code, _, err) = run(&format!("serve -d virtual -b 500k --unix {}", notes.display()));
    assert_eq!(code, Some(1), "{err}");
    assert!(err.contains("there is a file, which is left as it is; give another path with --unix"), "{err}");
    assert_eq!(std::fs::read_to_string(&notes).unwrap(), "mine");
    let path = socket(folder.path());
    let server = Server::start(&format!("-d virtual -b 500k --unix {path}"), 1);
    let (code, _, err) = run(&format!("serve -d virtual -b 500k --unix {path}"));
    assert_eq!(code, Some(1), "{err}");
    assert!(err.contains("another server is at"), "{err}");
    drop(server);
}

/// Other clients that come, send and go cost one gap, which the capture's own summary counts.
#[test]
fn a_change_of_mode_is_in_the_capture_s_summary_and_in_the_statistics() {
    let folder = tempfile::tempdir().unwrap();
    let path = socket(folder.path());
    let server = Server::start(&format!("-d virtual:load=30 -b 500k --unix {path} --allow send"), 1);
    let file = folder.path().join("all.log");
    let capture = capture(&server.at[0], &file, "-t 4s").spawn().unwrap();
    let started = Instant::now();
    while std::fs::metadata(&file).map_or(0, |file| file.len()) < 1000 {
        assert!(started.elapsed() < Duration::from_secs(20), "nothing is captured");
        std::thread::sleep(Duration::from_millis(20));
    }
    for _ in 0..3 {
        let (code, _, err) = run(&format!("send -d unix:{path} 1 7A1#11"));
        assert_eq!(code, Some(0), "{err}");
    }
    let (code, out, err) = said(&capture.wait_with_output().unwrap());
    assert_eq!(code, Some(0), "{err}");
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(summary["lost"]["off_bus"], 1, "{summary}");
    assert!(summary["lost"]["off_bus_us"].as_u64() > Some(0), "{summary}");
    assert_eq!(summary["channels"][0]["lost_at_least"], true, "{summary}");
    assert_eq!(summary["channels"][1]["lost_at_least"], false, "{summary}");
    let (code, out, err) = run(&format!("stats {} -b 500k", file.display()));
    assert_eq!(code, Some(0), "{err}");
    assert!(out.lines().next().unwrap().contains(", an unknown number lost, "), "{out}");
}

/// The server's end is what clients are told, and commands say what was done until then.
#[test]
fn what_was_sent_until_the_server_ended_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let path = socket(folder.path());
    let mut server = Server::start(&format!("-d virtual:load=0 -b 500k --unix {path} --allow send"), 1);
    let sends = cantap(&format!("gen -d unix:{path} can0 -g 5 --json")).spawn().unwrap();
    let mut ears = capture(&server.at[0], &folder.path().join("x.log"), "-n 20").spawn().unwrap();
    assert!(ears.wait().unwrap().success());
    server.interrupt();
    let (code, out, err) = said(&sends.wait_with_output().unwrap());
    assert_eq!(code, Some(1), "{err}");
    assert!(err.contains("its server has ended"), "{err}");
    let object: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert!(object["sent"].as_u64() >= Some(19), "{object}");
    assert!(object["reason"].as_str().unwrap().contains("its server has ended"), "{object}");
}
