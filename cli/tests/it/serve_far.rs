//! `cantap serve` and its clients on other computers: through ssh, with keys, and over connections that break.
#![cfg(unix)]

use cantap_testing::peers;

use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::time::{Duration, Instant};

use rustix::process::Signal;

use crate::served::server::{
    CANTAP, Server, agree, cantap, capture, log, nothing_lost, run, said, signal, socket,
};

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
        assert!(started.elapsed() < Duration::from_mins(1), "it does not end");
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
        assert!(started.elapsed() < Duration::from_mins(1), "nothing is captured");
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
    // Nobody is told of what nobody could reach.
    let (code, _, err) = run(&format!("serve -d virtual -b 500k --tcp 0 {files} --announce"));
    assert!(code == Some(2) && err.contains("other computers cannot reach 127.0.0.1:0"), "{err}");
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
