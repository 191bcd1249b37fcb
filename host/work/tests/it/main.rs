//! The programs of `docs/library.md`: they run, and the page shows them as they are.

#![allow(dead_code, reason = "their `main`")]

use std::path::Path;

#[path = "../../examples/ask_an_ecu.rs"]
mod ask_an_ecu;
#[path = "../../examples/decode_file.rs"]
mod decode_file;
#[path = "../../examples/print_frames.rs"]
mod print_frames;
#[path = "../../examples/statistics_of_a_file.rs"]
mod statistics_of_a_file;

mod speaking;

const LOG: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/data/engine.log");
const DATABASE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/data/engine.dbc");

#[test]
fn what_a_bus_carries_is_printed() {
    let mut out = Vec::new();
    let lost = print_frames::print_frames(&format!("virtual:bitrate=500k,log={LOG}"), 10, &mut out).unwrap();
    let text = String::from_utf8(out).unwrap();
    assert_eq!((lost, text.lines().count()), (0, 10), "{text}");
    assert!(text.lines().all(|line| line.contains(" 1 ") && line.contains('#')), "{text}");
}

#[test]
fn a_traces_signals_are_printed_with_their_names() {
    let mut out = Vec::new();
    let unread = decode_file::decode(LOG.as_ref(), DATABASE.as_ref(), &mut out).unwrap();
    let text = String::from_utf8(out).unwrap();
    assert_eq!(unread, "");
    assert!(
        text.trim_end().ends_with("Ignition = 1 (on)") && text.contains(": EngineSpeed = 2850 rpm"),
        "{text}"
    );
}

#[test]
fn a_traces_statistics_name_its_identifier_and_what_was_not_read() {
    let (summary, unread) = statistics_of_a_file::summary(LOG.as_ref(), 500_000).unwrap();
    assert_eq!((summary.frames, summary.lost, unread.as_str()), (40, 0, ""));
    assert_eq!(summary.channels[0].ids[0].count, 40);
    let folder = tempfile::tempdir().unwrap();
    let damaged = folder.path().join("damaged.log");
    std::fs::write(&damaged, "(1.0) can0 123#11\nrubbish\n(2.0) can0 123#22\n").unwrap();
    let (summary, unread) = statistics_of_a_file::summary(&damaged, 500_000).unwrap();
    assert_eq!(summary.frames, 2);
    assert!(unread.contains("line 2"), "{unread}");
}

#[test]
fn a_vehicle_tells_its_number_and_a_bus_without_one_does_not_answer() {
    let vin = ask_an_ecu::vin("virtual:car").unwrap();
    assert!(vin.len() == 17 && vin.chars().all(|letter| letter.is_ascii_alphanumeric()), "{vin}");
    let error = ask_an_ecu::vin("virtual:bitrate=500k").unwrap_err().to_string();
    assert!(error.contains("7E8") || error.contains("answer"), "{error}");
}

#[test]
fn the_page_shows_the_programs() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    // In a package there is no page.
    let Ok(page) = std::fs::read_to_string(root.join("../../docs/library.md")) else { return };
    for name in ["print_frames", "decode_file", "statistics_of_a_file", "ask_an_ecu"] {
        let program = std::fs::read_to_string(root.join(format!("examples/{name}.rs"))).unwrap();
        assert!(
            page.contains(&format!("```rust,ignore\n{program}```")),
            "docs/library.md does not show {name}.rs as it is"
        );
    }
}
