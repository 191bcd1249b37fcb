//! Two who ask the same nodes at once: what may be an answer to the other is never taken for ours in silence.
#![cfg(unix)]

use crate::served;

use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use served::Served;

const CANTAP: &str = env!("CARGO_BIN_EXE_cantap");

/// Sends a frame again and again, until it is dropped.
struct Other(Child);

impl Other {
    fn start(served: &Served, frame: &str, period: &str) -> Self {
        let mut command = Command::new(CANTAP);
        command.args(["send", "-d", &served.at, "-b", "500k", "1", frame, "--period", period]);
        let child = command.stdin(Stdio::null()).stdout(Stdio::null()).spawn().unwrap();
        std::thread::sleep(Duration::from_millis(400));
        Self(child)
    }
}

impl Drop for Other {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn run(served: &Served, line: &str) -> (Option<i32>, String, String) {
    let mut command = Command::new(CANTAP);
    command.args(line.split(' ')).args(["-d", &served.at, "-b", "500k"]).stdin(Stdio::null());
    let Output { status, stdout, stderr } = command.output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

#[test]
fn a_refusal_that_may_be_the_other_testers_is_no_answer() {
    let served = Served::start("virtual:car", Stdio::null());
    // The ECU has no such identifier, and does not say which one it refuses.
    let other = Other::start(&served, "7E0#0322010200000000", "4ms");
    for _ in 0..5 {
        let (code, out, err) = run(&served, "uds read 0100");
        assert!(err.contains("another tester asks the same ECU as 7E0"), "{out}{err}");
        if code == Some(0) {
            assert!(out.contains("did 0x0100") && !out.contains("nrc"), "{out}{err}");
        } else {
            assert!(
                err.contains("may be to the request of another tester") || err.contains("no answer"),
                "{out}{err}"
            );
        }
    }
    drop(other);
    // One who asks another ECU disturbs nobody, and what it is answered is not shown as ours.
    let _other = Other::start(&served, "7E1#0322020000000000", "5ms");
    let (code, out, err) = run(&served, "uds read 0100");
    assert_eq!((code, out.lines().count(), err.as_str()), (Some(0), 1, ""), "{out}");
    assert!(out.contains("7E0 > 7E8") && out.contains("did 0x0100"), "{out}");
}

#[test]
fn a_channel_or_an_address_that_another_uses_ends_it() {
    let served = Served::start("virtual:canopen", Stdio::null());
    for (frame, line, words) in [
        (
            "605#4018100100000000",
            "canopen read 5 2000",
            "another client uses this SDO channel at the same time",
        ),
        (
            "605#4018100100000000",
            "canopen write 5 2001 0 1 --type i16",
            "run this again while the other is silent",
        ),
        ("7E5#5E00000000000000", "canopen lss", "another LSS master sends commands"),
        ("18EAFFC8#ECFE00", "j1939 request 65260 --address 200", "another node sends from the address 200"),
    ] {
        let _other = Other::start(&served, frame, "1ms");
        let (code, out, err) = run(&served, line);
        assert!(code == Some(1) && err.contains(words), "{line}: {code:?} {out}{err}");
    }
    // The object is read well when the other is gone.
    let (code, out, err) = run(&served, "canopen read 5 2001");
    assert!(code == Some(0) && out.contains("SDO read 2001:00"), "{out}{err}");
}
