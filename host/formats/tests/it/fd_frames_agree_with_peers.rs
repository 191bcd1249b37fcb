//! CAN FD frames of every length with every flag: other programs read them in our files, and we read them in
//! theirs.

use crate::peers;
use crate::traces;

use std::path::PathBuf;
use std::process::Command;

use cantap_formats::{Format, TrcVersion};
use cantap_trace::fd::FD_LENGTHS;
use cantap_trace::{Direction, FdFrame, Frame, Id, TraceEvent, TraceFrame, TraceRecord};
use peers::{python_can, python_can_reads, run};
use traces::{directory, file_name, read, write};

/// All lengths with all flags, standard and extended, received and sent, on two channels, each followed by a classical
/// frame.
fn frames() -> Vec<TraceRecord> {
    let mut records = Vec::new();
    let mut push = |frame: TraceFrame| {
        let at = records.len();
        let direction = if at % 3 == 0 { Direction::Tx } else { Direction::Rx };
        let event = TraceEvent::Frame { frame, direction, late: false };
        let channel = 1 + (at % 4 / 2) as u8;
        records.push(TraceRecord {
            time_ns: 1_410_714_882_000_000_000 + at as i64 * 125_000,
            device_ns: None,
            channel,
            event,
        });
    };
    for (at, len) in FD_LENGTHS.iter().cycle().take(128).enumerate() {
        let raw = at as u32 * 2_654_435;
        let id = if at / 16 % 2 == 0 { Id::standard(raw & 0x7FF) } else { Id::extended(raw & 0x1FFF_FFFF) };
        let id = id.unwrap();
        let data: Vec<u8> = (0..*len).map(|byte| byte.wrapping_mul(37) ^ at as u8).collect();
        push(FdFrame::new(id, at / 32 % 2 == 1, at / 64 % 2 == 1, &data).unwrap().into());
        push(Frame::data_frame(id, &data[..data.len().min(8)]).unwrap().into());
    }
    records
}

/// A record as the script prints it.
fn line(record: &TraceRecord) -> String {
    let TraceEvent::Frame { frame, direction, .. } = &record.event else { panic!("{record:?}") };
    let direction = if *direction == Direction::Tx { "Tx" } else { "Rx" };
    let extended = if frame.id().is_extended() { "x" } else { "-" };
    let data = frame.data().iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().concat();
    let data = if data.is_empty() { "-".to_owned() } else { data };
    let (kind, flags) = match frame.fd() {
        Some(frame) => ("fd", format!(" {}", frame.flags())),
        None => ("data", String::new()),
    };
    let (micros, channel, id, len) =
        ((record.time_ns + 500).div_euclid(1000), record.channel, frame.id().raw(), frame.data_len());
    format!("{micros} {channel} {direction} {kind} {id:X} {extended} {len} {data}{flags}")
}

fn lines(records: &[TraceRecord]) -> Vec<String> {
    records.iter().map(line).collect()
}

#[test]
fn python_can_reads_them_in_our_files() {
    let directory = directory("fd_python_can_reads");
    let records = frames();
    let formats = [Format::Candump, Format::Asc, Format::Blf, Format::Mf4, Format::Trc(TrcVersion::V2_1)];
    let paths: Vec<_> = formats.iter().map(|format| directory.join(file_name(*format, ""))).collect();
    for (format, path) in formats.iter().zip(&paths) {
        assert!(write(path, *format, &records).is_empty(), "{format}");
    }
    let Some(theirs) = python_can_reads(&paths) else { return };
    for (format, path) in formats.iter().zip(&paths) {
        // In PEAK's files python-can mistakes the length code for the number of bytes, and confuses the two types of frames with ESI.
        let comparable = |line: &str| {
            let words = line
                .split(' ')
                .enumerate()
                .filter(|(at, _)| !matches!(at, 6 | 8) || !matches!(format, Format::Trc(_)));
            words.map(|(_, word)| word.to_owned()).collect::<Vec<_>>()
        };
        for (theirs, ours) in theirs[path].iter().zip(lines(&records)) {
            assert_eq!(comparable(theirs), comparable(&ours), "{format}");
        }
        assert_eq!(theirs[path].len(), records.len(), "{format}");
    }
}

#[test]
fn we_read_them_in_the_files_that_python_can_writes() {
    let directory = directory("fd_python_can_writes");
    let records = frames();
    let source = directory.join("messages.txt");
    std::fs::write(&source, lines(&records).join("\n")).unwrap();
    let paths: Vec<PathBuf> = ["a.log", "a.asc", "a.blf", "a0.mf4", "a2.mf4", "a.txt", "a.csv", "a.db"]
        .map(|name| directory.join(name))
        .into();
    for path in &paths {
        // It appends to an existing database.
        let _ = std::fs::remove_file(path);
    }
    let arguments: Vec<_> = std::iter::once(&source).chain(&paths).map(PathBuf::as_path).collect();
    if python_can(&arguments, "write").is_none() {
        return;
    }
    let bare = records.iter().map(|record| {
        // Its tables have neither channel nor direction, and only the longer of the CAN FD frames.
        let TraceEvent::Frame { frame, .. } = &record.event else { panic!("{record:?}") };
        let id = frame.id();
        let frame: TraceFrame = match frame.data_len() {
            0..=8 => Frame::data_frame(id, frame.data()).unwrap().into(),
            _ => FdFrame::new(id, false, false, frame.data()).unwrap().into(),
        };
        let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
        TraceRecord { channel: 1, event, ..*record }
    });
    let bare: Vec<_> = bare.collect();
    for path in &paths {
        let (read, issues) = read(path);
        assert_eq!(issues, Vec::<String>::new(), "{}", path.display());
        let is_table = path.extension().is_some_and(|suffix| suffix == "csv" || suffix == "db");
        let expected = if is_table { &bare } else { &records };
        assert_eq!(lines(&read), lines(expected), "{}", path.display());
    }
}

#[test]
fn wireshark_reads_them_in_our_pcapng_and_we_in_the_captures_that_it_writes() {
    let directory = directory("fd_wireshark");
    let records = frames();
    let ours = directory.join("ours.pcapng");
    write(&ours, Format::Pcapng, &records);
    let mut command = Command::new("tshark");
    command.arg("-r").arg(&ours).args(["-T", "fields", "-E", "separator=,"]);
    let fields = ["can.id", "can.len", "can.flags.xtd", "canfd.flags.brs", "canfd.flags.esi"];
    for field in fields {
        command.args(["-e", field]);
    }
    let Some(text) = run("tshark", &["--version"], &mut command) else { return };
    assert_eq!(text.lines().count(), records.len());
    for (line, record) in text.lines().zip(&records) {
        let frame = record.frame().unwrap();
        let flag = |flag: bool| if flag { ["1", "True"] } else { ["0", "False"] };
        let words: Vec<_> = line.split(',').collect();
        assert_eq!(!words[3].is_empty(), frame.is_fd(), "{line}");
        assert_eq!(words[..2], [frame.id().raw().to_string(), frame.data_len().to_string()], "{line}");
        assert!(flag(frame.id().is_extended()).contains(&words[2]), "{line}");
        if let Some(frame) = frame.fd() {
            assert!(flag(frame.brs()).contains(&words[3]) && flag(frame.esi()).contains(&words[4]), "{line}");
        }
    }
    for (format, name) in [("pcapng", "theirs.pcapng"), ("nsecpcap", "theirs.pcap"), ("pcap", "micros.pcap")]
    {
        let path = directory.join(name);
        let mut command = Command::new("tshark");
        command.arg("-r").arg(&ours).args(["-F", format, "-w"]).arg(&path);
        run("tshark", &["--version"], &mut command);
        let (mut read, issues) = read(&path);
        assert_eq!(issues, Vec::<String>::new(), "{name}");
        let mut expected = records.clone();
        if format != "pcapng" {
            // Older captures have neither interfaces nor directions.
            for record in expected.iter_mut().chain(&mut read) {
                record.channel = 1;
                let TraceEvent::Frame { direction, .. } = &mut record.event else { panic!("{record:?}") };
                *direction = Direction::Rx;
            }
        }
        assert_eq!(lines(&read), lines(&expected), "{name}");
    }
}

#[test]
fn can_utils_and_we_read_each_others_logs_and_asc_files_with_them() {
    let directory = directory("fd_can_utils");
    let records = frames();
    let at = |name: &str| directory.join(name);
    write(&at("ours.log"), Format::Candump, &records);
    write(&at("ours.asc"), Format::Asc, &records);
    for (name, options) in [("theirs.asc", &[][..]), ("all_fd_rows.asc", &["-f"]), ("crlf.asc", &["-n"])] {
        let mut log2asc = Command::new("log2asc");
        log2asc.args(options).arg("-I").arg(at("ours.log")).arg("-O").arg(at(name)).args(["can0", "can1"]);
        if run("log2asc (can-utils)", &[], &mut log2asc).is_none() {
            return;
        }
    }
    let mut asc2log = Command::new("asc2log");
    asc2log.arg("-I").arg(at("ours.asc")).arg("-O").arg(at("theirs.log"));
    run("asc2log (can-utils)", &[], &mut asc2log);
    // It reads dates in only one language, so compare times from the start.
    let from_start = |records: &[TraceRecord]| {
        let first = records[0].time_ns;
        let shifted = records.iter().map(|record| TraceRecord { time_ns: record.time_ns - first, ..*record });
        lines(&shifted.collect::<Vec<_>>())
    };
    for name in ["theirs.asc", "all_fd_rows.asc", "crlf.asc", "theirs.log"] {
        let (read, issues) = read(at(name));
        assert_eq!(issues, Vec::<String>::new(), "{name}");
        assert_eq!(from_start(&read), from_start(&records), "{name}");
    }
}
