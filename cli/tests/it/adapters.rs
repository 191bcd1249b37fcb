//! What commands say of an adapter that does not count its losses: never zero.

use std::io::Write;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::sync::mpsc;

use serde_json::Value;

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

#[test]
fn an_fd_frame_to_be_sent_is_refused_with_the_reason() {
    let (device, _done) = pipe("fd-send", fd_rows());
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let output = command.args(["send", "-d", &device, "-b", "500k", "1", "123##1AA"]).output().unwrap();
    let err = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success() && err.contains("CAN FD"), "{err}");
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
}

/// A trigger on losses is for frames that are missing, not for an adapter that does not know.
#[test]
fn a_trigger_on_losses_does_not_take_it_for_one() {
    let (out, _) = on_pipe("trigger", "capture -d PIPE -c 1 -b 500k -t 500ms --trigger lost --json");
    assert_eq!(object(&out)["trigger"]["events"], 0, "{out}");
}
