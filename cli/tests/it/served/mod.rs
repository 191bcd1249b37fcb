//! A board that `cantap serve` shares, for programs of other people that connect through python-can's socketcand.

#[cfg(unix)]
pub mod server;

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
#[cfg(unix)]
use std::time::{Duration, Instant};

/// A running server. It ends when this is dropped.
pub struct Served {
    pub server: Child,
    /// Its address for `-d`.
    pub at: String,
    /// Host and port of its socketcand.
    #[allow(dead_code, reason = "not every test has a program of other people")]
    pub socketcand: [String; 2],
    #[allow(dead_code, reason = "not every test has files")]
    pub folder: tempfile::TempDir,
}

impl Served {
    /// Shares a device at 500 kbit/s; clients may send. `stderr` is where its remarks go.
    pub fn start(device: &str, stderr: Stdio) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let socket = folder.path().join("cantap.sock").display().to_string();
        let mut server = Command::new(env!("CARGO_BIN_EXE_cantap"))
            .args(["serve", "-d", device, "-b", "500k", "--unix", &socket])
            .args(["--allow", "send", "--socketcand", "127.0.0.1:0", "--allow", "socketcand:send"])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(stderr)
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(server.stdout.take().unwrap()).lines();
        let at = lines.next().unwrap().unwrap();
        let way = lines.next().unwrap().unwrap();
        let (host, port) = way.strip_prefix("can://").unwrap().split_once(':').unwrap();
        Self { server, at, socketcand: [host.to_owned(), port.to_owned()], folder }
    }

    /// Records what is on the bus to a file in the folder, until it is interrupted; returns when it has begun.
    #[cfg(unix)]
    pub fn record(&self, file: &str) -> Child {
        let recorder = Command::new(env!("CARGO_BIN_EXE_cantap"))
            .args(["capture", "-d", &self.at, "-b", "500k", "-t", "5m", "-o", file])
            .current_dir(self.folder.path())
            .stdin(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        // It is there as soon as the channels are open.
        let path = self.folder.path().join(file);
        let until = Instant::now() + Duration::from_mins(1);
        while !path.exists() {
            assert!(Instant::now() < until, "nothing is recorded to {file}");
            std::thread::sleep(Duration::from_millis(5));
        }
        recorder
    }

    /// Runs a script, or a ready node, in the folder; returns when it has begun.
    #[cfg(unix)]
    pub fn run_node(&self, script: &str, options: &[&str]) -> Child {
        // Scripts begin one after the other: when this one says so, the other has begun.
        std::fs::write(self.folder.path().join("ready.rhai"), "log(\"ready\");").unwrap();
        let mut node = Command::new(env!("CARGO_BIN_EXE_cantap"))
            .args(["run", script, "ready.rhai", "-d", &self.at, "-b", "500k"])
            .args(options)
            .current_dir(self.folder.path())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(node.stdout.take().unwrap()).lines();
        assert!(lines.any(|line| line.unwrap().ends_with("ready.rhai: ready")));
        std::thread::spawn(move || lines.count());
        node
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        let _ = self.server.kill();
        let _ = self.server.wait();
    }
}
