//! A server as a lab runs it: permissions, the audit log, figures, keys that are renewed and revoked, a board that is not there yet.
#![cfg(all(unix, feature = "tls"))]

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use rustix::process::Signal;

use crate::served::server::{
    CANTAP, Server, cantap, capture, log, nothing_lost, run, said, signal, wait_for,
};

/// A folder with keys for three clients, and a server that restricts two of them.
struct Lab {
    folder: tempfile::TempDir,
    server: Server,
}

const PERMISSIONS: &str = "[clients.alice]\nchannels = [1]\nsend = [\"123\", \"600:7F0\"]\n\n[clients.bob]\n";

impl Lab {
    fn open() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let keys = at("keys").display().to_string();
        let clients = "--client alice:send --client bob:listen --client eve:send";
        let (code, _, err) = run(&format!("serve keygen {keys} --host 127.0.0.1 {clients}"));
        assert_eq!(code, Some(0), "{err}");
        std::fs::write(at("lab.toml"), PERMISSIONS).unwrap();
        let remarks = std::fs::File::create(at("remarks")).unwrap();
        let [permissions, audit] = ["lab.toml", "audit.jsonl"].map(|name| at(name).display().to_string());
        // Before anybody is revoked, there is no list: one is made of a client that nobody has.
        let (code, _, err) =
            run(&format!("serve keygen {keys} --client nobody:listen --revoke eve --renew eve"));
        assert_eq!(code, Some(0), "{err}");
        let server = Server::reporting(
            &format!(
                "-d virtual:load=20 -b 500k --tcp 0 --tls {keys}/server.pem,{keys}/server-key.pem --clients {keys}/ca.pem \
                 --revoked {keys}/revoked.pem --permissions {permissions} --audit {audit} --metrics 0 --allow send --wait"
            ),
            2,
            Stdio::from(remarks),
        );
        Self { folder, server }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// The server's address for a client with a key.
    fn of(&self, name: &str) -> String {
        format!("{}?keys={}", self.server.at[0], self.path("keys").join(name).display())
    }

    fn remark(&self, wanted: &str) -> String {
        wait_for(&self.path("remarks"), wanted)
    }

    /// What the server answers to a request.
    fn http(&self, request: &str) -> String {
        let place =
            self.server.at[1].strip_prefix("http://").and_then(|at| at.strip_suffix("/metrics")).unwrap();
        let mut stream = TcpStream::connect(place).unwrap();
        stream.write_all(format!("{request} HTTP/1.1\r\nHost: {place}\r\n\r\n").as_bytes()).unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        answer
    }

    fn events(&self) -> Vec<serde_json::Value> {
        let text = std::fs::read_to_string(self.path("audit.jsonl")).unwrap();
        text.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|_| panic!("{line}"))).collect()
    }

    fn hang_up(&self, permissions: &str) {
        std::fs::write(self.path("lab.toml"), permissions).unwrap();
        signal(&self.server.child, Signal::HUP);
    }
}

#[test]
fn the_files_of_a_lab_hold_for_its_clients() {
    let mut lab = Lab::open();
    // Who is not named is not let in, and told so.
    let (code, _, err) = run(&format!("info -d {}", lab.of("eve")));
    assert_eq!(code, Some(1));
    assert!(err.contains("the permissions do not name its certificate"), "{err}");
    // Beside a client that listens, one sends what it may.
    let trace = lab.path("bob.log");
    let listener = capture(&lab.of("bob"), &trace, "-t 6s").spawn().unwrap();
    wait_for(&trace, "#");
    let (code, _, err) = run(&format!("send -d {} 1 123#C0FFEE", lab.of("alice")));
    assert_eq!(code, Some(0), "{err}");
    // And not what it may not: the message does not send its user to look for an option that is given.
    for (arguments, reason) in
        [("1 124#11", "sending 124 is not permitted"), ("2 123#11", "channel 2 is not permitted")]
    {
        let (code, _, err) = run(&format!("send -d {} {arguments}", lab.of("alice")));
        assert_eq!(code, Some(1), "{err}");
        assert!(err.contains("--permissions") && err.contains("log"), "{err}");
        lab.remark(&format!("was refused: {reason}"));
    }
    let (code, _, err) = run(&format!("send -d {} 1 123#11", lab.of("bob")));
    assert_eq!(code, Some(1), "{err}");
    let output = listener.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(log(&trace).iter().filter(|(_, frame)| frame.starts_with("can0 123#C0FFEE")).count(), 1);
    // The figures have the frame.
    let figures = lab.http("GET /metrics");
    let is_there = |line: &str| figures.lines().any(|there| there == line);
    let board = "board=\"virtual:load=20\"";
    assert!(figures.starts_with("HTTP/1.1 200 OK"), "{figures}");
    assert!(is_there(&format!("cantap_frames_sent_total{{{board},channel=\"1\"}} 1")), "{figures}");
    assert!(is_there(&format!("cantap_board_up{{{board}}} 1")), "{figures}");
    assert!(lab.http("POST /metrics").starts_with("HTTP/1.1 405 "));
    // The record has who did what.
    assert!(lab.server.interrupt().success());
    let events = lab.events();
    let of = |name: &str, certificate: &str| {
        let is_it =
            |event: &&serde_json::Value| event["event"] == name && event["certificate"] == certificate;
        events.iter().filter(is_it).cloned().collect::<Vec<_>>()
    };
    assert!(!of("refused", "eve").is_empty(), "{events:?}");
    assert_eq!(of("not_permitted", "alice").len(), 2, "{events:?}");
    let sent = of("sent", "alice");
    assert_eq!(
        (sent.len(), &sent[0]["frames"], &sent[0]["channel"]),
        (1, &1.into(), &1.into()),
        "{events:?}"
    );
    for (name, certificate) in [("came", "bob"), ("opened", "bob"), ("closed", "bob"), ("left", "bob")] {
        assert!(!of(name, certificate).is_empty(), "{name}: {events:?}");
    }
}

#[test]
fn a_hang_up_reads_the_files_again_and_those_whom_it_concerns_go() {
    let lab = Lab::open();
    let trace = lab.path("bob.log");
    let listener = capture(&lab.of("bob"), &trace, "").stderr(Stdio::piped()).spawn().unwrap();
    wait_for(&trace, "#");
    let send = |frame: &str| run(&format!("send -d {} 1 {frame}", lab.of("alice")));
    assert_eq!(send("124#11").0, Some(1));
    // A slip changes nothing.
    lab.hang_up("[clients.alice]\nsend = [\"1234\"]\n");
    let remarks = lab.remark("the permissions and certificates all stay as they were");
    assert!(remarks.contains("'1234' is no identifier"), "{remarks}");
    assert_eq!(send("124#11").0, Some(1));
    assert_eq!(send("123#11").0, Some(0));
    // Nor does one in another file: the permissions by themselves would be good.
    let list = lab.path("keys").join("revoked.pem");
    let good = std::fs::read(&list).unwrap();
    std::fs::write(&list, "no list").unwrap();
    lab.hang_up("[clients.alice]\nsend = [\"124\"]\n\n[clients.bob]\n");
    lab.remark("revoked.pem' cannot be used");
    assert_eq!(send("124#11").0, Some(1));
    assert_eq!(send("123#11").0, Some(0));
    std::fs::write(&list, good).unwrap();
    lab.hang_up("[clients.alice]\nsend = [\"124\"]\n\n[clients.bob]\n");
    lab.remark("were read again");
    let (code, _, err) = send("124#11");
    assert_eq!(code, Some(0), "{err}");
    // Nobody else was let go.
    let remarks = lab.remark("were read again");
    let is_bobs_end = |line: &str| line.contains("bob at") && line.contains("was let go");
    assert!(!remarks.lines().any(is_bobs_end), "{remarks}");
    // Until he is revoked: his capture does not go on for ever with a server that does not let him in.
    let keys = lab.path("keys").display().to_string();
    let (code, out, err) = run(&format!("serve keygen {keys} --revoke bob"));
    assert_eq!(code, Some(0), "{err}");
    assert!(out.trim().ends_with("revoked.pem") && err.contains("SIGHUP"), "{out}{err}");
    signal(&lab.server.child, Signal::HUP);
    lab.remark("its certificate is no longer trusted");
    let (code, _, err) = run(&format!("info -d {}", lab.of("bob")));
    assert_eq!(code, Some(1));
    assert!(err.contains("lets nobody in with these keys"), "{err}");
    signal(&listener, Signal::INT);
    // Its device was not there at the end, which is not success.
    let (code, out, err) = said(&listener.wait_with_output().unwrap());
    assert!(code == Some(1) && err.contains("does not let this client in"), "{out}{err}");
    // A new certificate of the same name is another one, for both.
    let (code, _, err) = run(&format!("serve keygen {keys} --renew bob"));
    assert_eq!(code, Some(0), "{err}");
    let trace = lab.path("again.log");
    nothing_lost(&capture(&lab.of("bob"), &trace, "-t 500ms").output().unwrap());
}

/// A program that knows only socketcand.
struct Foreign {
    stream: TcpStream,
    heard: String,
}

impl Foreign {
    /// At a tunnel's listener, with a bus open in raw mode.
    fn at(tunnel: &Server) -> Self {
        let place = tunnel.at[1].strip_prefix("can://").unwrap();
        let mut foreign = Self { stream: TcpStream::connect(place).unwrap(), heard: String::new() };
        foreign.hear("< hi >");
        foreign
    }

    fn raw(mut self) -> Self {
        self.ask("open can0", "< ok >");
        self.ask("rawmode", "< ok >");
        self
    }

    fn ask(&mut self, command: &str, answer: &str) {
        self.stream.write_all(format!("< {command} >").as_bytes()).unwrap();
        self.hear(answer);
    }

    /// Reads up to this.
    fn hear(&mut self, wanted: &str) {
        let mut bytes = [0; 4096];
        loop {
            if let Some(at) = self.heard.find(wanted) {
                self.heard.drain(..at + wanted.len());
                return;
            }
            let len = self.stream.read(&mut bytes).unwrap();
            assert!(len > 0, "it ended without '{wanted}': {}", self.heard);
            self.heard.push_str(std::str::from_utf8(&bytes[..len]).unwrap());
        }
    }
}

/// Programs on another computer that know only socketcand come through TLS by a server of their own, as docs/serve.md says: they may do what its
/// certificate may.
#[test]
fn a_tunnel_for_socketcand_has_the_permissions_of_its_certificate() {
    let mut lab = Lab::open();
    let tunnel = |name: &str| {
        let socket = lab.path(name).display().to_string();
        let arguments = "--socketcand 0 --allow socketcand:send";
        Server::start(&format!("-d {} --unix {socket} {arguments}", lab.of(name)), 2)
    };
    // How socketcand says that a frame was not sent, to clients that read nothing but frames.
    let not_sent = "< error 20000001 ";
    let (alices, bobs) = (tunnel("alice"), tunnel("bob"));
    let mut alice = Foreign::at(&alices).raw();
    alice.hear("< frame ");
    alice.ask("send 124 1 11", not_sent);
    lab.remark("sending 124 is not permitted");
    Foreign::at(&alices).ask("open can1", "< error could not open bus >");
    lab.remark("channel 2 is not permitted");
    // Whoever may only listen does so there, whatever the tunnel allows.
    let mut bob = Foreign::at(&bobs).raw();
    bob.hear("< frame ");
    alice.stream.write_all(b"< send 123 2 C0 FE >").unwrap();
    bob.hear(" C0FE >");
    bob.ask("send 123 1 11", not_sent);
    drop((alice, bob, alices, bobs));
    assert!(lab.server.interrupt().success());
    let sent: Vec<_> = lab.events().into_iter().filter(|event| event["event"] == "sent").collect();
    assert!(sent.len() == 1 && sent[0]["certificate"] == "alice" && sent[0]["frames"] == 1, "{sent:?}");
}

/// Strangers' connections are bounded at each listener, and all listeners together may still have more than the usual descriptors.
#[test]
fn strangers_do_not_use_up_the_descriptors_by_which_the_owner_comes_in() {
    let folder = tempfile::tempdir().unwrap();
    let socket = folder.path().join("cantap.sock").display().to_string();
    let mut few = Command::new("/bin/sh");
    let serve = format!("serve -d virtual -b 500k --unix {socket} --socketcand 0");
    few.args(["-c", &format!("ulimit -Sn 64 && exec {CANTAP} {serve}")]).stdout(Stdio::piped());
    let server = Server::of(&mut few, 2);
    let place = server.at[1].strip_prefix("can://").unwrap();
    let strangers: Vec<_> = (0..32).map(|_| TcpStream::connect(place).unwrap()).collect();
    for mut stranger in &strangers {
        stranger.read_exact(&mut [0; "< hi >".len()]).unwrap();
    }
    let (code, _, err) = run(&format!("info -d {}", server.at[0]));
    assert_eq!(code, Some(0), "{err}");
}

/// A board that comes later, as a serial port does.
#[test]
fn a_server_waits_for_its_board() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let port = at("port");
    let remarks = std::fs::File::create(at("remarks")).unwrap();
    let socket = at("cantap.sock").display().to_string();
    let server = Server::reporting(
        &format!("-d {} -b 500k --unix {socket} --wait", port.display()),
        1,
        Stdio::from(remarks),
    );
    let (code, _, err) = run(&format!("info -d {}", server.at[0]));
    assert_eq!(code, Some(1));
    assert!(err.contains("its server has no board at the moment"), "{err}");
    wait_for(&at("remarks"), "it is tried again");
    let mut board = VirtualPort::open(&port);
    wait_for(&at("remarks"), "is there again");
    nothing_lost(&capture(&server.at[0], &at("trace.log"), "-t 500ms").output().unwrap());
    board.close();
    // Without the option, it is an error, which names it.
    let (code, _, err) = run(&format!("serve -d {} -b 500k --unix {socket}-2", at("nothing").display()));
    assert_eq!(code, Some(1));
    assert!(err.contains("--wait"), "{err}");
}

/// `cantap virtual` behind a name of its own.
struct VirtualPort(std::process::Child);

impl VirtualPort {
    fn open(name: &Path) -> Self {
        let mut command: Command = cantap("virtual load=20");
        let mut child = command.spawn().unwrap();
        let mut line = String::new();
        let mut output = std::io::BufReader::new(child.stdout.take().unwrap());
        std::io::BufRead::read_line(&mut output, &mut line).unwrap();
        std::os::unix::fs::symlink(line.trim(), name).unwrap();
        Self(child)
    }

    fn close(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Drop for VirtualPort {
    fn drop(&mut self) {
        self.close();
    }
}
