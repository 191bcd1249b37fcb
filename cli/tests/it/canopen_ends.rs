//! How `cantap canopen` ends where nobody answers, and what it leaves behind on the bus.
#![cfg(unix)]

use crate::served;

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use served::Served;

const CANTAP: &str = env!("CARGO_BIN_EXE_cantap");

/// A node whose client vanishes would be busy until it gives up.
#[test]
fn ctrl_c_aborts_a_transfer_and_the_node_is_told() {
    let mut served = Served::start("virtual:load=0", Stdio::piped());
    let heard = served.folder.path().join("heard.log");
    let start = |arguments: &[&str]| {
        let mut command = Command::new(CANTAP);
        command.args(arguments).args(["-d", &served.at, "-b", "500k"]).current_dir(served.folder.path());
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
    };
    let mut words = BufReader::new(served.server.stderr.take().unwrap()).lines();
    let mut is_in = || assert!(words.any(|line| line.unwrap().contains("is in and may")));
    let interrupt = |child: &Child| {
        assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    };
    let mut listener = start(&["capture", "-t", "2m", "-o", "heard.log"]);
    is_in();
    // Nobody answers.
    let reader = start(&["canopen", "--timeout", "1m", "read", "5", "1000"]);
    is_in();
    std::thread::sleep(Duration::from_millis(1500));
    interrupt(&reader);
    let output = reader.wait_with_output().unwrap();
    let error = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.code() == Some(130) && error.contains("ended by Ctrl-C"), "{error}");
    interrupt(&listener);
    listener.wait().unwrap();
    served.server.kill().unwrap();
    let log = std::fs::read_to_string(&heard).unwrap();
    let frames = log.lines().filter_map(|line| line.split(' ').nth(2));
    let frames: Vec<_> = frames.filter(|frame| frame.starts_with("605#")).collect();
    assert_eq!(frames, ["605#4000100000000000", "605#8000100000000008"], "{log}");
}

#[test]
fn a_node_that_does_not_say_that_it_obeyed_is_named() {
    // Node 5 reports its own state meanwhile.
    let output = Command::new(CANTAP)
        .args(["canopen", "-d", "virtual:canopen", "-b", "500k", "nmt", "99", "start"])
        .output()
        .unwrap();
    let error = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success() && error.contains("node 99 has not reported a new state"), "{error}");
}
