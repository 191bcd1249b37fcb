//! `cantap canopen drive` with the ready drive and with drives that are not as they should be, on a board shared by `cantap serve`: what is
//! confirmed, what is refused before anything is sent, and how the drive is left.
#![cfg(unix)]

use crate::served::Served;

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};

use serde_json::Value;

const CANTAP: &str = env!("CARGO_BIN_EXE_cantap");

/// A script on a shared board, and a listener.
struct Rig {
    served: Served,
    node: Child,
    listener: Child,
}

impl Rig {
    /// `node` is `node:NAME`, or a script's text.
    fn new(node: &str) -> Self {
        let served = Served::start("virtual:load=0", Stdio::null());
        let folder = served.folder.path();
        let script = if node.starts_with("node:") {
            node.to_owned()
        } else {
            std::fs::write(folder.join("node.rhai"), node).unwrap();
            "node.rhai".to_owned()
        };
        let listener = served.record("heard.log");
        let node = served.run_node(&script, &[]);
        Self { served, node, listener }
    }

    fn start(&self, line: &str) -> Child {
        let mut command = Command::new(CANTAP);
        command.args(["canopen", "-d", &self.served.at, "-b", "500k", "drive"]).args(line.split(' '));
        // Both sides share a computer that may be busy.
        for option in ["--timeout", "--confirm"].into_iter().filter(|option| !line.contains(option)) {
            command.args([option, "30s"]);
        }
        command.current_dir(self.served.folder.path());
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
    }

    fn run(&self, line: &str) -> (Option<i32>, String, String) {
        ended(self.start(line))
    }

    /// What must succeed; its lines on both outputs.
    fn well(&self, line: &str) -> (String, String) {
        let (code, out, err) = self.run(line);
        assert_eq!(code, Some(0), "{line}: {out}{err}");
        (out, err)
    }

    /// The frames with this identifier, when nothing more comes.
    fn frames(mut self, id: &str) -> Vec<String> {
        signal(&self.listener, "-INT");
        self.listener.wait().unwrap();
        let log = std::fs::read_to_string(self.served.folder.path().join("heard.log")).unwrap();
        let frames = log.lines().filter_map(|line| line.split(' ').nth(2));
        frames.filter(|frame| frame.starts_with(id)).map(str::to_owned).collect()
    }
}

impl Drop for Rig {
    fn drop(&mut self) {
        for child in [&mut self.node, &mut self.listener] {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

fn ended(child: Child) -> (Option<i32>, String, String) {
    let output = child.wait_with_output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

fn signal(child: &Child, name: &str) {
    assert!(Command::new("kill").args([name, &child.id().to_string()]).status().unwrap().success());
}

/// The first line, when operation has been enabled.
fn until_enabled(child: &mut Child) {
    let mut out = BufReader::new(child.stdout.take().unwrap());
    let mut line = String::new();
    while !line.contains(": operation enabled, ") {
        line.clear();
        assert!(out.read_line(&mut line).unwrap() > 0, "it has ended");
    }
    std::thread::spawn(move || out.lines().count());
}

#[test]
fn the_ready_drive_is_enabled_moved_and_left_without_power() {
    let rig = Rig::new("node:drive?heartbeat=100");
    let (out, _) = rig.well("5 status");
    assert_eq!(
        out,
        "node 5: switch on disabled, statusword 0250 (voltage enabled, remote), mode no mode, position 0, velocity 0\n"
    );
    let (out, err) = rig.well("5 enable --yes");
    let states: Vec<_> = out.lines().map(|line| line.split(", ").next().unwrap()).collect();
    let expected = ["switch on disabled", "ready to switch on", "switched on", "operation enabled"];
    assert_eq!(states, expected.map(|state| format!("node 5: {state}")));
    assert_eq!(err, "cantap: node 5: done; operation stays enabled\n");
    let (code, _, err) = rig.run("5 mode pv");
    assert!(code == Some(2) && err.contains("operation is enabled; this can move the machine"), "{err}");
    rig.well("5 disable");
    assert!(rig.well("5 mode pv").0.contains("mode profile velocity"));
    // Each motion ends with a quick stop and without power.
    let (out, err) = rig.well("5 velocity 1500 -t 1s --yes");
    assert!(out.lines().last().unwrap().contains("switch on disabled"), "{out}");
    assert_eq!(
        err,
        "cantap: node 5: the time is over at velocity 1500; it was stopped, and is switch on disabled\n"
    );
    let (_, err) = rig.well("5 home --yes");
    assert_eq!(
        err,
        "cantap: node 5: the home position is found at position 0; it was stopped, and is switch on disabled\n"
    );
    for (line, position) in
        [("5 position 4000 --velocity 20000 --yes", 4000), ("5 position -500 --relative --yes", 3500)]
    {
        let (_, err) = rig.well(line);
        assert_eq!(
            err,
            format!(
                "cantap: node 5: the target is reached at position {position}; it was stopped, and is switch on disabled\n"
            )
        );
    }
    let (out, err) = rig.well("5 position 100 --yes --stay-enabled --json");
    assert!(err.ends_with("the target is reached at position 100; operation stays enabled\n"), "{err}");
    let last: Value = serde_json::from_str(out.lines().last().unwrap()).unwrap();
    assert_eq!(
        (&last["state"], &last["position"], &last["mode"]),
        (&"operation enabled".into(), &100.into(), &1.into())
    );
    let (out, _) = rig.well("5 quick-stop");
    assert!(out.contains("quick stop active"), "{out}");
    rig.well("5 disable");
    // It has no such mode.
    let (code, _, err) = rig.run("5 torque 100 --yes --confirm 1s");
    assert!(code == Some(1) && err.contains("object 6071: the node aborted it"), "{err}");
    assert!(err.trim_end().ends_with("it was stopped, and is switch on disabled"), "{err}");
}

#[test]
fn what_can_move_needs_a_yes_and_what_does_not_fit_is_refused_before_anything_is_sent() {
    let rig = Rig::new("node:drive?heartbeat=0");
    let sheet = "[DeviceInfo]\nProductName=D\n[60FF]\nParameterName=Target velocity\nObjectType=0x7\nDataType=0x0004\nAccessType=rw\n\
                 LowLimit=-1000\nHighLimit=0x3E8\n";
    std::fs::write(rig.served.folder.path().join("drive.eds"), sheet).unwrap();
    for (line, expected) in [
        ("5 enable", "add --yes"),
        ("5 velocity 100", "add --yes"),
        ("5 position 100", "add --yes"),
        ("5 home", "add --yes"),
        ("5 torque 100", "add --yes"),
        ("5 velocity 2147483648 --yes", "object 60FF: '2147483648' is not a valid i32"),
        ("5 torque 40000 --yes", "object 6071: '40000' is not a valid i16"),
        ("5 position 1.5 --yes", "object 607A: '1.5' is not a valid i32"),
        ("5 position 1 --velocity -1 --yes", "object 6081: '-1' is not a valid u32"),
        ("5 velocity 1001 --yes --eds 5:drive.eds", "outside the limits of the node's sheet, -1000 to 0x3E8"),
        (
            "5 velocity -1001 --yes --eds 5:drive.eds",
            "outside the limits of the node's sheet, -1000 to 0x3E8",
        ),
        ("5 position 1 --yes --eds 5:drive.eds", "the node's sheet has no object 607A"),
        ("5 mode turbo", "modes are pp, vl, pv"),
        ("128 status", "nodes are 1 to 127"),
        ("5 status --axis 9", "9 is not in 1..=8"),
        ("5 velocity 1 --yes --guard 0s", "--guard"),
        ("5 velocity 1 --yes --guard-node 3", "--guard"),
    ] {
        let (code, out, err) = rig.run(line);
        assert!(code == Some(2) && out.is_empty() && err.contains(expected), "{line}: {code:?} {err}");
    }
    assert_eq!(rig.frames("605#"), [""; 0]);
}

#[test]
fn ctrl_c_stops_the_drive_and_says_so() {
    let rig = Rig::new("node:drive?heartbeat=100");
    // The usual end of a velocity.
    let mut running = rig.start("5 velocity 800 --yes");
    until_enabled(&mut running);
    signal(&running, "-INT");
    let (code, _, err) = ended(running);
    assert_eq!(err, "cantap: node 5: ended by Ctrl-C; it was stopped, and is switch on disabled\n");
    assert_eq!(code, Some(0));
    // Not of a position, which would take a quarter of an hour.
    let mut running = rig.start("5 position 1000000 --velocity 1000 --yes --stay-enabled");
    until_enabled(&mut running);
    signal(&running, "-INT");
    let (code, _, err) = ended(running);
    assert_eq!(code, Some(130), "{err}");
    assert!(err.contains("Ctrl-C") && err.ends_with("it was stopped, and is switch on disabled\n"), "{err}");
    assert!(rig.well("5 status").0.contains("switch on disabled"));
}

/// Whatever ends the command, even what leaves it no time: the drive hears nothing more, and stops.
#[test]
fn a_guarded_drive_stops_when_it_hears_nothing_more() {
    let rig = Rig::new("node:drive?heartbeat=0");
    let (_, err) = rig.well("5 velocity 500 -t 200ms --yes --guard 20s");
    let (first, last) = err.split_once('\n').unwrap();
    assert!(
        first.starts_with("cantap: node 5 watches the heartbeat of node 127, which is sent from here: after 20000 ms without it, ")
            && first.ends_with(
                "(what it then does is 1 (fault), by object 6007); object 1016:01 was 00000000 and is 007F4E20 until the end"
            ),
        "{err}"
    );
    assert!(
        last.ends_with("it was stopped, and is switch on disabled; object 1016:01 is 00000000 again\n"),
        "{err}"
    );
    let (code, _, err) = rig.run("5 velocity 500 --yes --guard 1s --guard-node 5");
    assert!(code == Some(1) && err.contains("node 5 is there; give --guard-node"), "{err}");
    let mut running = rig.start("5 velocity 800 --yes --guard 3s");
    until_enabled(&mut running);
    running.kill().unwrap();
    running.wait().unwrap();
    let mut status = String::new();
    for _ in 0..1000 {
        status = rig.well("5 status").0;
        if status.contains(": fault, ") {
            break;
        }
    }
    assert!(status.contains(": fault, ") && status.contains("error 8130"), "{status}");
    assert!(status.contains("velocity 0"), "{status}");
    assert!(!rig.frames("77F#05").is_empty());
}

/// It braked from a velocity and said "target reached" all the while.
#[test]
fn a_drive_that_still_turns_after_a_quick_stop_has_not_reached_its_target() {
    let rig = Rig::new("node:drive?heartbeat=0");
    rig.well("5 velocity 20000 -t 3s --yes --stay-enabled");
    // It was told to stand, and brakes; the quick stop finds it turning, or standing.
    let (out, _) = rig.well("5 quick-stop");
    let status = out.lines().last().unwrap();
    let velocity = status.rsplit("velocity ").next().unwrap().parse::<i32>().unwrap();
    assert!(status.contains("target reached") == (velocity == 0), "{status}");
}

#[test]
fn a_fault_in_a_motion_is_named_and_can_be_reset() {
    let rig = Rig::new("node:drive?heartbeat=100");
    let mut running = rig.start("5 velocity 800 --yes");
    until_enabled(&mut running);
    // Written through another client, which ours notices as such, unless the emergency is first.
    let line =
        ["canopen", "-d", &rig.served.at, "-b", "500k", "write", "5", "2000", "0", "0x8611", "--type", "u16"];
    let _ = Command::new(CANTAP).args(line).output().unwrap();
    let (code, _, err) = ended(running);
    let is_named = err.contains("following error (8611)") || err.contains("SDO channel at the same time");
    assert!(code == Some(1) && is_named && err.ends_with("it was stopped, and is fault\n"), "{err}");
    let (code, _, err) = rig.run("5 enable --yes");
    assert!(code == Some(1) && err.contains("it has a fault: following error (8611)"), "{err}");
    assert!(err.contains("`cantap canopen drive 5 fault-reset`"), "{err}");
    let (out, _) = rig.well("5 fault-reset");
    assert!(out.lines().last().unwrap().starts_with("node 5: switch on disabled"), "{out}");
}

/// It answers, and its statusword never changes, or says what cannot be; a scripted node is as bad as one wants.
#[test]
fn drives_that_lie_end_a_motion_with_the_last_confirmed_state() {
    const FROZEN: &str = r#"
        on_frame("605", |f| {
            let is_read = f.data[0] == 0x40;
            let answer = if is_read && f.data[1] == 0x41 { [0x4B, 0x41, 0x60, 0, 0x50, 2, 0, 0] }
                else if is_read { [0x80, f.data[1], f.data[2], f.data[3], 0, 0, 2, 6] }
                else { [0x60, f.data[1], f.data[2], f.data[3], 0, 0, 0, 0] };
            send(frame(0x585, answer));
        });
    "#;
    let rig = Rig::new(FROZEN);
    let (code, _, err) = rig.run("5 enable --yes --confirm 1s");
    assert!(code == Some(1) && err.contains("it is still switch on disabled (0250)"), "{err}");
    assert!(err.ends_with("it was stopped, and is switch on disabled\n"), "{err}");
    let (code, _, err) = rig.run("5 velocity 1 --yes");
    assert!(code == Some(1) && err.contains("object 6061: the node aborted it"), "{err}");
    let (code, _, err) = rig.run("6 velocity 1 --yes --timeout 300ms");
    assert!(code == Some(1) && err.contains("node 6: object 6041: no answer within 300 ms"), "{err}");
    assert!(err.ends_with("it was told nothing\n"), "{err}");
}

/// The drive's power is gone in the middle, or the device's: nobody can stop it, and that is said.
#[test]
fn what_cannot_be_stopped_any_more_is_said() {
    let mut rig = Rig::new("node:drive?heartbeat=100");
    let mut running = rig.start("5 velocity 800 --yes --timeout 500ms");
    until_enabled(&mut running);
    rig.node.kill().unwrap();
    let (code, _, err) = ended(running);
    assert!(code == Some(1), "{err}");
    assert!(
        err.contains("it could not be stopped (object 6040: no answer within")
            && err.ends_with("and may still move; the last state that it confirmed is operation enabled\n"),
        "{err}"
    );
    let mut rig = Rig::new("node:drive?heartbeat=100");
    let mut running = rig.start("5 velocity 800 --yes");
    until_enabled(&mut running);
    rig.served.server.kill().unwrap();
    let (code, _, err) = ended(running);
    assert!(code == Some(1) && err.contains("its server has ended"), "{err}");
    assert!(err.contains("it could not be stopped (") && err.contains("and may still move"), "{err}");
}
