//! Every line of `docs/tutorial.md`, as written and in its order.
#![cfg(unix)]

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::shell;
use crate::terminal::Terminal;

/// Longer than anything here takes, however busy the machine.
const PATIENCE: Duration = Duration::from_mins(2);

/// The blocks of a page, each with its language.
fn blocks(page: &str) -> Vec<(String, String)> {
    let mut blocks = Vec::new();
    let mut rest = page;
    while let Some((_, after)) = rest.split_once("```") {
        let (language, after) = after.split_once('\n').expect("a block has lines");
        let (block, after) = after.split_once("```").expect("a block ends");
        blocks.push((language.to_owned(), block.to_owned()));
        rest = after;
    }
    blocks
}

/// Runs lines in one folder, like somebody who follows the page.
struct Reader<'f> {
    folder: &'f Path,
    /// What goes on in other terminals.
    running: Vec<Child>,
}

impl Reader<'_> {
    fn command(&self, line: &str) -> Command {
        let mut command = shell::line(self.folder, line);
        command.env("CANTAP_PAGE", self.folder.join("page.html"));
        command
    }

    /// Runs a line to its end, and returns its standard output.
    fn run(&self, line: &str) -> String {
        shell::run(&mut self.command(line), line)
    }

    /// Starts a line that goes on until somebody ends it, and waits for the file that shows that it has begun.
    fn start(&mut self, line: &str, file: &str) {
        let child = self.command(&format!("exec {line}")).stdout(Stdio::null()).stderr(Stdio::null()).spawn();
        self.running.push(child.unwrap());
        let deadline = Instant::now() + PATIENCE;
        while !self.folder.join(file).exists() {
            assert!(Instant::now() < deadline, "{line} never began");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

impl Drop for Reader<'_> {
    fn drop(&mut self) {
        for child in &mut self.running {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// In the live view, until its row for an identifier is there; then it is left.
fn watch(line: &str) {
    let arguments = line.strip_prefix("cantap ").unwrap();
    let mut view = Terminal::start(arguments, (120, 40));
    view.wait_for("virtual:car");
    view.keys("2");
    view.wait_for("ABS_Brake");
    view.keys("q");
    assert_eq!(view.end(), 0);
}

/// Whether Python has the package, which this build does not make.
fn has_python_package() -> bool {
    let found = Command::new("python3").args(["-c", "import cantap"]).stderr(Stdio::null()).status();
    found.is_ok_and(|status| status.success())
}

#[test]
fn every_line_of_the_tutorial_does_what_it_says() {
    let folder = tempfile::tempdir().unwrap();
    let mut reader = Reader { folder: folder.path(), running: Vec::new() };
    std::fs::write(folder.path().join("page.html"), "<!doctype html><body><!--cantap-report--></body>")
        .unwrap();
    let page = std::fs::read_to_string("../docs/tutorial.md").unwrap();
    let mut last = String::new();
    let mut ran = 0;
    for (language, block) in blocks(&page) {
        match language.as_str() {
            "sh" => {
                for line in block.lines() {
                    ran += 1;
                    if line.starts_with("cantap monitor") {
                        watch(line);
                    } else if line.starts_with("cantap serve") {
                        reader.start(line, "car.sock");
                    } else {
                        last = reader.run(line);
                        check(line, &last, folder.path());
                    }
                }
            }
            // What the page quotes is among what was printed.
            "console" => {
                for line in block.lines() {
                    assert!(last.lines().any(|printed| printed == line), "{line} is not in: {last}");
                }
            }
            "toml" => std::fs::write(folder.path().join("guess.toml"), &block).unwrap(),
            "python" if has_python_package() => {
                std::fs::write(folder.path().join("program.py"), &block).unwrap();
                let out = reader.run("python3 program.py");
                assert!(out.trim().parse::<f64>().is_ok_and(|speed| speed > 30.0), "{out}");
            }
            "python" => eprintln!("Python has no package cantap: its block is skipped"),
            other => panic!("a block of {other} is not run"),
        }
    }
    assert!(ran >= 20, "only {ran} lines");
}

/// What the page says of a line's result.
fn check(line: &str, out: &str, folder: &Path) {
    let size = |name: &str| folder.join(name).metadata().map_or(0, |metadata| metadata.len());
    let has = |part: &str| assert!(out.contains(part), "{line}: {part} is not in: {out}");
    match line.split(' ').nth(1).unwrap() {
        "capture" if line.contains("drive.blf") => assert!(size("drive.blf") > 10_000),
        "capture" if line.contains("shift.log") => assert!(size("shift.log") > 10_000),
        "capture" if line.contains("shared.log") => assert!(size("shared.log") > 1_000),
        "stats" => has("1A1"),
        "diff" => has("channel 1, 1A1: byte 0"),
        "search" if line.contains("byte[1]") => has("1A1#0010"),
        "search" => assert_eq!(out.lines().count(), 1, "{line}: {out}"),
        "decode" if line.contains("guess.toml") => has("Guess: Speed = 40.96 km/h"),
        "decode" => has("VehicleSpeed = "),
        "plot" => {
            let name = line.rsplit(' ').next().unwrap();
            assert!(size(name) > 2_000, "{line}");
        }
        "conversations" => has("EEC1"),
        "obd" if line.contains("vin") => has("WCTCANTA4P0000001"),
        "obd" if line.contains("codes") => has("P0128"),
        "report" => assert!(size("drive.html") > 10_000),
        "doctor" => has("ok       bus 1"),
        _ => {}
    }
}
