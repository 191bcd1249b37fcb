//! The README's commands, as written.

use crate::shell;

/// The lines of the first block of commands below a heading.
fn commands(page: &str, heading: &str) -> Vec<String> {
    let (_, section) = page.split_once(&format!("\n## {heading}\n")).expect("the heading is there");
    let (_, block) = section.split_once("```sh\n").expect("a block of commands follows");
    let (block, _) = block.split_once("```").expect("the block ends");
    block.lines().map(|line| line.split(" #").next().unwrap_or_default().trim().to_owned()).collect()
}

/// Each command that needs no board works on a capture of the virtual vehicle, which is the block's first line.
#[test]
fn the_examples_work_on_the_virtual_vehicle_as_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let run = |line: &str| shell::run(&mut shell::line(folder.path(), line), line);
    let page = std::fs::read_to_string("../README.md").unwrap();
    let mut ran = 0;
    for line in commands(&page, "Use") {
        // These need a board, or Parquet or MCAP, which not every build has.
        let is_left_out = line.contains(".parquet") && !cfg!(feature = "parquet")
            || line.contains(".mcap") && !cfg!(feature = "mcap");
        if line.contains("/dev/tty") || is_left_out {
            continue;
        }
        // Two recorders of a bus, and two drives, are assumed to be there.
        for (name, command) in [
            ("cabin.blf", "cp drive.blf engine.blf && cp drive.blf cabin.blf"),
            ("after.log", "cantap convert drive.blf before.log && cp before.log after.log"),
        ] {
            if line.contains(name) && !path(name).exists() {
                run(command);
            }
        }
        let out = run(&line);
        match line.split(' ').nth(1).unwrap() {
            "search" => assert!(out.contains('#'), "{line} finds nothing: {out}"),
            "plot" => assert!(path("speed.svg").metadata().unwrap().len() > 2_000, "{line}"),
            "capture" => assert!(path("drive.blf").metadata().unwrap().len() > 10_000, "{line}"),
            "decode" | "conversations" if !line.contains(" -o ") => {
                assert!(out.lines().count() > 10, "{line} prints {out}");
            }
            _ => {}
        }
        ran += 1;
    }
    assert!(ran >= 12, "only {ran} of the commands ran");
}
