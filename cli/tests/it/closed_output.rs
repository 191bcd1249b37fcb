//! Whoever reads standard output may have read enough (`cantap … | head`), or its disk may be full: no command panics.

use std::process::{Command, Output, Stdio};
use std::sync::Mutex;

use crate::json_schema::{LINES, directory};

/// Where the output goes.
#[derive(Clone, Copy, Debug)]
enum Out {
    Closed,
    #[cfg(target_os = "linux")]
    Full,
}

fn stdout(out: Out) -> Stdio {
    match out {
        Out::Closed => std::io::pipe().unwrap().1.into(),
        #[cfg(target_os = "linux")]
        Out::Full => std::fs::File::options().write(true).open("/dev/full").unwrap().into(),
    }
}

fn run(number: usize, line: &str, out: Out) -> (Option<i32>, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let words = line.split(' ').map(|word| word.replace('%', " "));
    command.args(words).current_dir(directory(&format!("closed_output.{number}.{out:?}")));
    let Output { status, stderr, .. } = command.stdin(Stdio::null()).stdout(stdout(out)).output().unwrap();
    (status.code(), String::from_utf8(stderr).unwrap())
}

/// Every command of `docs/json.md`, and those that only print text.
#[test]
fn output_that_nobody_takes_panics_no_command() {
    let text = ["--help", "selftest --help", "completions bash", "capture -d virtual -b 500k -t 300ms -o -"];
    let selftest = ["selftest -d virtual:load=0 --load-time 100ms"];
    // Details are for `--json` only.
    let plain = LINES.iter().filter(|(line, ..)| !line.contains("--details"));
    let plain = plain.map(|(line, code, _)| ((*line).to_owned(), *code));
    let json = LINES.iter().map(|(line, code, _)| (format!("{line} --json"), *code));
    let others = text.iter().chain(&selftest).map(|line| ((*line).to_owned(), 0));
    let todo: Vec<(String, i32)> = plain.chain(json).chain(others).collect();
    let next = Mutex::new(todo.iter().enumerate());
    let wrong = Mutex::new(Vec::new());
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                loop {
                    let Some((number, (line, code))) = next.lock().unwrap().next() else { return };
                    let (ended, err) = run(number, line, Out::Closed);
                    if err.contains("panicked") || ![Some(0), Some(*code)].contains(&ended) {
                        wrong.lock().unwrap().push(format!("{line} | true: {ended:?} {err}"));
                    }
                    #[cfg(target_os = "linux")]
                    {
                        let (ended, err) = run(number, line, Out::Full);
                        if err.contains("panicked") || ended.is_none_or(|code| code > 3) {
                            wrong.lock().unwrap().push(format!("{line} > /dev/full: {ended:?} {err}"));
                        }
                    }
                }
            });
        }
    });
    let wrong = wrong.into_inner().unwrap();
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// What it counts was received; nobody knows what of it was read.
#[test]
fn a_capture_whose_reader_went_claims_no_frame_to_have_been_taken() {
    let (ended, told) = run(1000, "capture -d virtual:load=50 -b 500k -t 30s", Out::Closed);
    let closed =
        "standard output was closed before the end: how many of these frames its reader took is not known";
    assert!(ended == Some(0) && told.lines().any(|line| line == closed), "{told}");
    let (_, told) = run(1001, "capture -d virtual:load=50 -b 500k -t 100ms -o all.log --force", Out::Closed);
    assert!(told.contains("channel 1: ") && !told.contains("was closed"), "{told}");
}
