//! docs/formats.md has a row for each format, made of what is read back from a file with one of each kind of record.
//!
//! After a change that is meant, write them anew with `CANTAP_OVERWRITE=1 cargo test -p cantap-formats --test formats_page`.

mod traces;

use std::path::Path;

use cantap_formats::{CsvDialect, Format};
use cantap_trace::{Direction, TraceEvent, TraceFrame, TraceRecord};
use cantap_wire::record::{BusErrorKind, ErrorState, LossStage};
use traces::{directory, file_name, read, write};

const PAGE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/formats.md");
const BEGIN: &str = "| format |";

/// Nanoseconds since 1970 of a time of which no digit is zero.
const TIME_NS: i64 = 1_410_714_882_111_111_111;

fn frame(text: &str, direction: Direction) -> TraceEvent {
    TraceEvent::Frame { frame: text.parse().unwrap(), direction, late: false }
}

fn alone(event: TraceEvent, channel: u8) -> TraceRecord {
    TraceRecord { time_ns: TIME_NS, channel, event }
}

/// What comes back of a record behind an ordinary frame, or of that frame.
fn back(format: Format, record: TraceRecord) -> Option<TraceRecord> {
    let path = directory("formats_page").join(file_name(format, ""));
    let first = alone(frame("123#11", Direction::Rx), 1);
    write(&path, format, &[first, record]);
    let (records, issues) = read(&path);
    assert_eq!(issues, Vec::<String>::new(), "{format}");
    records.into_iter().nth(1)
}

fn row(format: Format) -> String {
    if !format.is_written() {
        // What each has a place for, as its own tests show.
        let [times, rest] = match format {
            Format::Pcap => ["1 ns", "– | yes | yes | yes | yes | yes | –"],
            Format::CandumpScreen => {
                ["1 µs, local with `-t A`", "yes | with `-x` | yes | yes | yes | yes | –"]
            }
            Format::Busmaster => ["0.1 ms, local", "yes | yes | yes | – | – | – | –"],
            Format::Crtd => ["as written", "yes | yes | – | – | – | – | –"],
            Format::Kvaser => ["as written, no date", "yes | yes | yes | yes | yes | – | that there was one"],
            Format::Microchip => ["1 ms, no date", "– | yes | – | – | – | – | –"],
            Format::CanHacker => ["1 ms, no date, of a minute", "– | – | – | – | – | – | –"],
            Format::Printer => ["1 µs", "yes | yes | yes | yes | yes | yes | –"],
            Format::CanKing => ["as written, no date", "yes | yes | yes | yes | that there was one | – | –"],
            Format::Sqlite => ["as written", "– | – | yes | without flags | yes | yes | yes"],
            new => panic!("{new} has no row here yet"),
        };
        return format!("| {format} | read | {times} | {rest} |");
    }
    let step_ns = [1, 1000, 100_000, 1_000_000].into_iter().find(|step_ns| {
        let record = alone(frame("123#11", Direction::Rx), 1);
        back(format, record).is_some_and(|back| (back.time_ns - TIME_NS).abs() < *step_ns)
    });
    let local = matches!(
        format,
        Format::Asc | Format::Blf | Format::Trc(_) | Format::Csv(CsvDialect::Analyser) | Format::Dif
    );
    let times = match step_ns {
        Some(1) => "1 ns",
        Some(1000) => "1 µs",
        Some(100_000) => "0.1 ms",
        Some(_) => "1 ms",
        None => "?",
    };
    let event = |event: TraceEvent| back(format, alone(event, 1)).map(|back| back.event);
    let keeps = |record: TraceRecord, same: fn(&TraceRecord, &TraceRecord) -> bool| {
        if back(format, record).is_some_and(|back| same(&back, &record)) { "yes" } else { "–" }
    };
    let channel = keeps(alone(frame("123#11", Direction::Rx), 2), |a, b| a.channel == b.channel);
    let direction = keeps(alone(frame("123#11", Direction::Tx), 1), |a, b| a.event == b.event);
    let remote = match event(frame("123#R4", Direction::Rx)) {
        Some(TraceEvent::Frame { frame: TraceFrame::Classic(frame), .. }) if frame.is_remote() => {
            if frame.dlc() == 4 { "yes" } else { "without length" }
        }
        _ => "–",
    };
    let flexible: TraceFrame = "123##1000102030405060708090A0B".parse().unwrap();
    let fd = match event(frame("123##1000102030405060708090A0B", Direction::Rx)) {
        Some(TraceEvent::Frame { frame, .. }) if frame == flexible => "yes",
        Some(TraceEvent::Frame { frame, .. }) if frame.is_fd() => "without flags",
        _ => "–",
    };
    let kinds = [
        BusErrorKind::Stuff,
        BusErrorKind::Form,
        BusErrorKind::Acknowledgment,
        BusErrorKind::BitRecessive,
        BusErrorKind::BitDominant,
        BusErrorKind::Crc,
    ];
    let errors = kinds.map(|kind| event(TraceEvent::BusError { kind: Some(kind), counters: Some((8, 0)) }));
    let exact = errors
        .iter()
        .zip(kinds)
        .all(|(back, kind)| *back == Some(TraceEvent::BusError { kind: Some(kind), counters: Some((8, 0)) }));
    let of_kind = errors.iter().any(|back| matches!(back, Some(TraceEvent::BusError { kind: Some(_), .. })));
    let any = errors.iter().any(|back| matches!(back, Some(TraceEvent::BusError { .. })));
    let errors = match (exact, of_kind, any) {
        (true, ..) => "yes",
        (_, true, _) => "kind",
        (.., true) => "that there was one",
        _ => "–",
    };
    let state = TraceEvent::State { state: ErrorState::Passive, counters: Some((130, 0)) };
    let states = if event(state) == Some(state) { "yes" } else { "–" };
    let lost = TraceEvent::Lost { stage: Some(LossStage::Queue), count: 5, at_least: true };
    let losses = match event(lost) {
        Some(back) if back == lost => "yes",
        Some(TraceEvent::Lost { .. }) => "that there was one",
        _ => "–",
    };
    let times = if local { format!("{times}, local") } else { times.to_owned() };
    format!(
        "| {format} | read, written | {times} | {channel} | {direction} | {remote} | {fd} | {errors} | {states} | {losses} |"
    )
}

#[test]
fn the_page_has_what_every_format_keeps() {
    let rows: Vec<String> = Format::all().map(row).collect();
    let page = std::fs::read_to_string(PAGE).unwrap();
    let begin = page.find(BEGIN).expect("the page has the table");
    let (head, table) = page.split_at(begin);
    let mut lines = table.split_inclusive('\n');
    let names: String = lines.by_ref().take(2).collect();
    let rest: String = lines.skip_while(|line| line.starts_with('|')).collect();
    let expected = format!("{head}{names}{}\n{rest}", rows.join("\n"));
    if std::env::var_os("CANTAP_OVERWRITE").is_some() {
        std::fs::write(Path::new(PAGE), &expected).unwrap();
    }
    assert!(
        page == expected || std::env::var_os("CANTAP_OVERWRITE").is_some(),
        "docs/formats.md is not what the formats keep; write it anew with CANTAP_OVERWRITE=1:\n{}",
        rows.join("\n")
    );
}
