//! Other programs read our files and we read theirs: python-can, Wireshark's tshark, can-utils. See `peers/mod.rs` for where they are.

use crate::peers;
use crate::traces;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use cantap_can::{ErrorState, LossStage};
use cantap_formats::{CsvDialect, Format, ReadOptions, TrcVersion, open_reader};
use cantap_trace::{Direction, TraceEvent, TraceFrame, TraceRecord};
use peers::{python, python_can, python_can_reads, run, skip};
use traces::{directory, file_name, frames, odd, read, real, split, write};

/// How much of a line a format carries.
#[derive(Clone, Copy)]
struct Carries {
    step_us: i64,
    channel: Option<u8>,
    direction: bool,
    /// Whether a remote frame keeps its length.
    remote_length: bool,
    /// What python-can gets besides frames.
    events: Events,
    /// Subtracted from all times.
    from_us: i64,
}

/// Which events come as error frames.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Events {
    /// None: its reader skips them.
    None,
    /// Bus errors; states and losses have forms that it skips.
    BusErrors,
    /// All, as SocketCAN's error frames, but without their channel.
    All,
}

const EVERYTHING: Carries = Carries {
    step_us: 1,
    channel: None,
    direction: true,
    remote_length: true,
    events: Events::BusErrors,
    from_us: 0,
};

/// A record as the script prints it; `None` if python-can has no message for it.
fn line(record: &TraceRecord, carries: Carries) -> Option<String> {
    // python-can's times are floating-point numbers.
    let micros = (record.time_ns + 500).div_euclid(1000).div_euclid(carries.step_us) * carries.step_us
        - carries.from_us;
    let channel = carries.channel.unwrap_or(record.channel);
    let (frame, direction) = match &record.event {
        TraceEvent::Frame { frame, direction, .. } => (frame, *direction),
        event => {
            let is_bus_error = matches!(event, TraceEvent::BusError { .. });
            let comes = carries.events == Events::All || is_bus_error && carries.events == Events::BusErrors;
            let channel = if carries.events == Events::All { 0 } else { channel };
            return comes.then(|| format!("{micros} {channel} Rx error"));
        }
    };
    let direction = if direction == Direction::Tx && carries.direction { "Tx" } else { "Rx" };
    let kind = match frame {
        TraceFrame::Fd(_) => "fd",
        TraceFrame::Classic(frame) if frame.is_remote() => "remote",
        TraceFrame::Classic(_) => "data",
    };
    let extended = if frame.id().is_extended() { "x" } else { "-" };
    let digits = frame.data().iter().flat_map(|byte| [byte >> 4, byte & 15]);
    let data: String = digits.map(|digit| char::from(b"0123456789ABCDEF"[usize::from(digit)])).collect();
    let data = if data.is_empty() { "-".to_owned() } else { data };
    let len = if frame.is_fd() { frame.data_len() as u8 } else { frame.dlc() };
    let len = if frame.is_remote() && !carries.remote_length { 0 } else { len };
    let id = frame.id().raw();
    let flags = frame.fd().map(|frame| format!(" {}", frame.flags())).unwrap_or_default();
    Some(format!("{micros} {channel} {direction} {kind} {id:X} {extended} {len} {data}{flags}"))
}

fn lines(records: &[TraceRecord], carries: Carries) -> Vec<String> {
    records.iter().filter_map(|record| line(record, carries)).collect()
}

/// Real traffic, followed by records of every kind.
fn records_of_every_kind(directory: &Path) -> Vec<TraceRecord> {
    let mut records = real(1000);
    let last_ns = records.last().unwrap().time_ns;
    let odd = odd(directory);
    let first_ns = odd[0].time_ns;
    records.extend(odd.iter().map(|record| TraceRecord {
        time_ns: record.time_ns - first_ns + last_ns + 1_000_000_000,
        ..*record
    }));
    records
}

/// Only the frames among those.
fn frames_of_every_kind(directory: &Path) -> Vec<TraceRecord> {
    frames(&records_of_every_kind(directory))
}

/// What python-can's readers can return of each format.
fn python_can_formats(start_us: i64) -> Vec<(Format, Carries)> {
    let version = |version, step_us, channel, direction| {
        // It does not read the date in the header of version 1.0.
        let from_us = if version == TrcVersion::V1_0 { start_us / step_us * step_us } else { 0 };
        let events = Events::None;
        (Format::Trc(version), Carries { step_us, channel, direction, events, from_us, ..EVERYTHING })
    };
    vec![
        (Format::Candump, Carries { events: Events::All, ..EVERYTHING }),
        (Format::Asc, EVERYTHING),
        (Format::Blf, EVERYTHING),
        (Format::Mf4, EVERYTHING),
        (
            Format::Csv(CsvDialect::PythonCan),
            Carries { channel: Some(0), direction: false, events: Events::All, ..EVERYTHING },
        ),
        version(TrcVersion::V2_1, 1, None, true),
        version(TrcVersion::V2_0, 1, Some(1), true),
        version(TrcVersion::V1_3, 1, None, true),
        version(TrcVersion::V1_1, 100, Some(1), true),
        version(TrcVersion::V1_0, 1000, Some(1), false),
    ]
}

#[test]
fn python_can_reads_every_record_of_the_files_we_write() {
    let directory = directory("python_can_reads");
    // A bus-off in candump's log stays as the kernel writes it, and python-can takes that for a frame.
    let mut records = records_of_every_kind(&directory);
    let off = TraceEvent::State { state: ErrorState::BusOff, counters: None };
    records.retain(|record| record.event != off);
    let formats = python_can_formats(records[0].time_ns / 1000);
    let paths: Vec<_> = formats.iter().map(|(format, _)| directory.join(file_name(*format, ""))).collect();
    for ((format, _), path) in formats.iter().zip(&paths) {
        write(path, *format, &records);
    }
    let Some(read) = python_can_reads(&paths) else { return };
    for ((format, carries), path) in formats.iter().zip(&paths) {
        let expected = lines(&records, *carries);
        for (line, (theirs, ours)) in read[path].iter().zip(&expected).enumerate() {
            assert_eq!(theirs, ours, "{format}, message {line}");
        }
        assert_eq!(read[path].len(), expected.len(), "{format}");
    }
}

#[test]
fn we_read_every_message_of_the_files_that_python_can_writes() {
    let directory = directory("python_can_writes");
    let records = records_of_every_kind(&directory);
    let source = directory.join("messages.txt");
    fs::write(&source, lines(&records, EVERYTHING).join("\n")).unwrap();
    let table = Carries { channel: Some(1), direction: false, ..EVERYTHING };
    // It writes remote frames into a log without their length.
    let log = Carries { remote_length: false, ..EVERYTHING };
    let cases = [
        ("a.log", log),
        ("a.asc", EVERYTHING),
        ("a.blf", EVERYTHING),
        ("a.csv", table),
        ("a.trc", EVERYTHING),
        ("a0.mf4", EVERYTHING),
        ("a1.mf4", EVERYTHING),
        ("a2.mf4", EVERYTHING),
        ("a.txt", EVERYTHING),
        ("a.log.gz", log),
    ];
    let paths: Vec<_> = cases.iter().map(|(name, _)| directory.join(name)).collect();
    let arguments: Vec<_> = std::iter::once(&source).chain(&paths).map(PathBuf::as_path).collect();
    if python_can(&arguments, "write").is_none() {
        return;
    }
    for ((name, carries), path) in cases.iter().zip(&paths) {
        let (read, issues) = read(path);
        assert_eq!(issues, Vec::<String>::new(), "{name}");
        // It truncates the date in the header to milliseconds, but not what the times count from.
        let (ours, mut expected) = if *name == "a.asc" {
            (from_start(&read), from_start(&records))
        } else {
            (lines(&read, EVERYTHING), lines(&records, *carries))
        };
        if *name == "a.trc" {
            // It writes none into PEAK's files, and warns about it.
            expected.retain(|line| !line.contains(" remote ") && !line.ends_with(" error"));
        }
        for (at, (ours, expected)) in ours.iter().zip(&expected).enumerate() {
            assert_eq!(ours, expected, "{name}, message {at}");
        }
        assert_eq!(ours.len(), expected.len(), "{name}");
    }
}

/// Every version and compression that asammdf writes; frames of both buses in one group or in one each, next to a measured signal;
/// in MDF 4.2 also in columns, with times in one group and frames in another.
#[test]
fn we_read_what_asammdf_writes() {
    let directory = directory("asammdf");
    let mut records = frames_of_every_kind(&directory);
    records.retain(|record| record.frame().is_some_and(|frame| !frame.is_remote()));
    let source = directory.join("messages.txt");
    fs::write(&source, lines(&records, EVERYTHING).join("\n")).unwrap();
    // Plain, deflated, and with rows and columns of bytes exchanged before.
    let packed = |version, layout| {
        let each =
            move |compression| [1, 2].map(|groups| format!("{version}_{compression}_{groups}_{layout}.mf4"));
        (0..3).flat_map(each)
    };
    let rows =
        ["4.00", "4.10", "4.11", "4.20", "4.30"].into_iter().flat_map(|version| packed(version, "rows"));
    let names = rows.chain(packed("4.20", "columns"));
    // Version 4.00 has no compressed blocks.
    let names = names.filter(|name| !name.starts_with("4.00") || name.starts_with("4.00_0"));
    let paths: Vec<_> = names.map(|name| directory.join(name)).collect();
    let arguments: Vec<_> = std::iter::once(&source).chain(&paths).map(PathBuf::as_path).collect();
    if python_can(&arguments, "asammdf").is_none() {
        return;
    }
    for path in &paths {
        let bytes = fs::read(path).unwrap();
        let has = |name: &[u8]| bytes.windows(4).any(|window| window == name);
        let in_columns = path.display().to_string().contains("columns");
        assert_eq!(has(b"##LD"), in_columns, "{}: asammdf wrote another layout", path.display());
        let (read, issues) = read(path);
        assert_eq!(issues, Vec::<String>::new(), "{}", path.display());
        let (mut ours, mut expected) = (lines(&read, EVERYTHING), lines(&records, EVERYTHING));
        // Frames of both groups at the same time have no order.
        if path.display().to_string().contains("_2_") {
            ours.sort();
            expected.sort();
        }
        for (at, (ours, expected)) in ours.iter().zip(&expected).enumerate() {
            assert_eq!(ours, expected, "{}, frame {at}", path.display());
        }
        assert_eq!(ours.len(), expected.len(), "{}", path.display());
    }
}

#[test]
fn python_can_reads_the_fd_frames_of_our_mf4() {
    let directory = directory("mf4_fd");
    let log = "(1410714882.000100) can0 123##1000102030405060708090A0B\n\
               (1410714882.000200) can1 18DAF110##0AA T\n(1410714882.000300) can0 7FF#1122\n";
    fs::write(directory.join("fd.log"), log).unwrap();
    let (records, issues) = read(directory.join("fd.log"));
    assert_eq!((records.len(), issues), (3, Vec::new()));
    let path = directory.join("fd.mf4");
    write(&path, Format::Mf4, &records);
    let Some(theirs) = python_can_reads(std::slice::from_ref(&path)) else { return };
    assert_eq!(
        theirs[&path],
        [
            "1410714882000100 1 Rx fd 123 - 12 000102030405060708090A0B 1",
            "1410714882000200 2 Tx fd 18DAF110 x 1 AA 0",
            "1410714882000300 1 Rx data 7FF - 2 1122",
        ]
    );
}

#[test]
fn wireshark_and_we_read_each_others_pcapng_files() {
    let directory = directory("wireshark");
    let mut records = records_of_every_kind(&directory);
    for record in &mut records {
        record.time_ns += 7;
    }
    let (ours, theirs) = (directory.join("ours.pcapng"), directory.join("theirs.pcapng"));
    write(&ours, Format::Pcapng, &records);
    let fields =
        ["frame.time_epoch", "frame.interface_name", "can.flags.err", "can.flags.xtd", "can.flags.rtr"];
    let mut command = Command::new("tshark");
    command.arg("-r").arg(&ours).args(["-T", "fields", "-E", "separator=/s"]);
    for field in fields.iter().chain(&["can.len", "can.id"]) {
        command.args(["-e", field]);
    }
    let Some(text) = run("tshark", &["--version"], &mut command) else { return };
    let flag = |flag| if flag { "(1|True)" } else { "(0|False)" };
    assert_eq!(text.lines().count(), records.len());
    for (line, record) in text.lines().zip(&records) {
        let (seconds, nanos) = (record.time_ns / 1_000_000_000, record.time_ns % 1_000_000_000);
        let start = format!("{seconds}.{nanos:09} can{} ", record.channel - 1);
        let rest =
            line.strip_prefix(&start).unwrap_or_else(|| panic!("'{line}' does not begin with '{start}'"));
        let words: Vec<_> = rest.split(' ').collect();
        assert!(flag(record.frame().is_none()).contains(words[0]), "{line}");
        let Some(frame) = record.frame() else { continue };
        let (extended, remote) = (flag(frame.id().is_extended()), flag(frame.is_remote()));
        assert!(words.len() == 5 && extended.contains(words[1]) && remote.contains(words[2]), "{line}");
        assert_eq!(words[3..], [frame.dlc().to_string(), frame.id().raw().to_string()], "{line}");
    }
    // It writes the same packets in its own kinds of blocks, gzip included.
    for (name, compress) in [("theirs.pcapng", "none"), ("theirs.pcapng.gz", "gzip")] {
        let path = theirs.with_file_name(name);
        let mut command = Command::new("tshark");
        command.arg("-r").arg(&ours).args(["-F", "pcapng", "-w"]).arg(&theirs);
        run("tshark", &["--version"], &mut command);
        if compress == "gzip" {
            let packed = Command::new("gzip").args(["-kf"]).arg(&theirs).status();
            assert!(packed.unwrap().success());
        }
        let (read, issues) = read(&path);
        assert_eq!(issues, Vec::<String>::new(), "{name}");
        assert!(read == records, "{name}: {} of {}", read.len(), records.len());
    }
}

/// This is in addition to the error frame, which reports the loss, but not its size to every reader.
/// Older kinds of capture have one interface, so no channel, and no direction.
#[test]
fn we_read_the_captures_that_editcap_makes_of_ours() {
    let directory = directory("editcap");
    let records = frames_of_every_kind(&directory);
    let ours = directory.join("ours.pcapng");
    write(&ours, Format::Pcapng, &records);
    let plain = Carries { channel: Some(1), direction: false, ..EVERYTHING };
    for (kind, carries) in [("pcap", plain), ("nsecpcap", plain), ("pcapng", EVERYTHING)] {
        let theirs = directory.join(format!("theirs.{kind}"));
        let mut command = Command::new("editcap");
        if run("editcap", &["--version"], command.args(["-F", kind]).args([&ours, &theirs])).is_none() {
            return;
        }
        let (read, issues) = read(&theirs);
        assert_eq!(issues, Vec::<String>::new(), "{kind}");
        assert_eq!(lines(&frames(&read), carries), lines(&records, carries), "{kind}");
    }
}

#[test]
fn wireshark_shows_losses_as_drop_counts_with_words_and_sent_frames_as_outbound() {
    let directory = directory("wireshark_losses");
    let path = directory.join("lost.pcapng");
    let frame = |direction| TraceEvent::Frame { frame: "123#11".parse().unwrap(), direction, late: false };
    let lost = |count| TraceEvent::Lost { stage: Some(LossStage::Queue), count, at_least: false };
    let events = [(1, frame(Direction::Rx)), (2, lost(42)), (1, frame(Direction::Tx)), (2, lost(1))];
    let records = events.map(|(channel, event)| TraceRecord { time_ns: 5, device_ns: None, channel, event });
    write(&path, Format::Pcapng, &records);
    let mut command = Command::new("tshark");
    command.arg("-r").arg(&path).args(["-T", "fields", "-E", "separator=|"]);
    for field in ["frame.interface_name", "frame.drop_count", "frame.comment", "frame.packet_flags_direction"]
    {
        command.args(["-e", field]);
    }
    let Some(text) = run("tshark", &["--version"], &mut command) else { return };
    assert_eq!(
        text.lines().collect::<Vec<_>>(),
        [
            "can0|||",
            "can1|42|42 frames were lost here in the device's queue|",
            "can0|||0x00000002",
            "can1|1|1 frame was lost here in the device's queue|",
        ]
    );
    // The statistics are not packets, and nothing that it complains about.
    let mut command = Command::new("capinfos");
    let Some(text) = run("capinfos", &["--version"], command.arg("-M").arg(&path)) else { return };
    assert_eq!(text.matches("Number of stat entries = 1").count(), 2, "{text}");
}

/// Times from the first record: can-utils' asc2log understands the date in only one language.
fn from_start(records: &[TraceRecord]) -> Vec<String> {
    lines(records, Carries { from_us: records[0].time_ns / 1000, ..EVERYTHING })
}

#[test]
fn can_utils_and_we_read_each_others_logs_and_asc_files() {
    let directory = directory("can_utils");
    let records = frames_of_every_kind(&directory);
    let at = |name: &str| directory.join(name);
    write(&at("ours.log"), Format::Candump, &records);
    write(&at("ours.asc"), Format::Asc, &records);
    let mut log2asc = Command::new("log2asc");
    log2asc.arg("-I").arg(at("ours.log")).arg("-O").arg(at("theirs.asc")).args(["can0", "can1"]);
    // Neither program has an option that does nothing: all that can be checked is whether it starts.
    if run("log2asc (can-utils)", &[], &mut log2asc).is_none() {
        return;
    }
    let mut asc2log = Command::new("asc2log");
    asc2log.arg("-I").arg(at("ours.asc")).arg("-O").arg(at("theirs.log"));
    run("asc2log (can-utils)", &[], &mut asc2log);
    // It prints each line of a log, error frames with their meaning.
    let every = records_of_every_kind(&directory);
    write(&at("every.log"), Format::Candump, &every);
    let mut log2long = Command::new("log2long");
    log2long.stdin(fs::File::open(at("every.log")).unwrap());
    let text = run("log2long (can-utils)", &[], &mut log2long).unwrap();
    assert_eq!(text.lines().filter(|line| line.starts_with('(')).count(), every.len(), "{text}");
    // It prints like candump.
    fs::write(at("screen.txt"), &text).unwrap();
    let options = ReadOptions { format: Some(Format::CandumpScreen), ..ReadOptions::default() };
    let (screen, issues) = split(open_reader(at("screen.txt"), &options).unwrap());
    assert_eq!(issues, Vec::<String>::new());
    let shown = Carries { direction: false, events: Events::All, ..EVERYTHING };
    assert_eq!(lines(&screen, shown), lines(&every, shown));
    let errors = every.iter().filter(|record| record.frame().is_none()).count();
    assert_eq!(text.matches("ERRORFRAME").count(), errors, "{text}");
    for name in ["theirs.asc", "theirs.log"] {
        let (read, issues) = read(at(name));
        assert_eq!(issues, Vec::<String>::new(), "{name}");
        assert_eq!(from_start(&read), from_start(&records), "{name}");
    }
}

/// python-can's own test files, from its source distribution, unpacked once.
fn python_can_test_data() -> Option<PathBuf> {
    let directory = directory("python_can_sdist");
    let unpacked = |directory: &Path| {
        let mut entries = fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().path());
        entries.find(|path| path.join("test/data").is_dir()).map(|path| path.join("test/data"))
    };
    if unpacked(&directory).is_none() {
        let fetched = Command::new(python())
            .args([
                "-m",
                "pip",
                "download",
                "--quiet",
                "--no-deps",
                // All others as binaries: building this one would otherwise build its build dependencies from source,
                // which takes minutes.
                "--no-binary",
                "python-can",
                "python-can",
                "-d",
            ])
            .arg(&directory)
            .output();
        if !fetched.is_ok_and(|output| output.status.success()) {
            skip("python-can's source could not be fetched");
            return None;
        }
        let archive = fs::read_dir(&directory)
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .find(|path| path.extension().is_some_and(|suffix| suffix == "gz"));
        let unpack = Command::new("tar").arg("-xzf").arg(archive.unwrap()).current_dir(&directory).status();
        assert!(unpack.unwrap().success());
    }
    unpacked(&directory)
}

/// Files by other programs, cut at a hundred places, yield no more than whole ones and no panic.
fn cut_everywhere(path: &Path) {
    let whole = fs::read(path).unwrap();
    let all = read(path).0.len();
    let cut_path = directory("python_can_cut").join(path.file_name().unwrap());
    for cut in (0..whole.len()).step_by(whole.len() / 100 + 1) {
        fs::write(&cut_path, &whole[..cut]).unwrap();
        let got = read(&cut_path).0.len();
        assert!(got <= all, "{} cut at {cut}: {got} of {all}", path.display());
    }
}

/// Files of the distribution that the two read differently, and why.
const DIFFERENT: &[(&str, &str)] = &[
    (
        "issue_1299.asc",
        "a length code of 13 means 8 bytes in a classical frame; python-can takes CAN FD's 32",
    ),
    (
        "logfile.asc",
        "a remote frame in a CANFD row is a classical one; an error frame is nobody's to have sent",
    ),
    ("single_frame.asc", "64 bytes in a classical row are a CAN FD frame here"),
    ("test_CanErrorFrameExt.blf", "channel 4370 is an issue; and a microsecond is rounded the other way"),
    ("test_CanErrorFrames.asc", "an error frame is nobody's to have sent"),
    ("test_CanFdMessage.blf", "channel 4370 is an issue here"),
    ("test_CanFdMessage64.blf", "an identifier of 31 bits is an issue here"),
    ("test_CanFdRemoteMessage.asc", "a remote frame in a CANFD row is a classical one"),
    ("test_CanMessage.asc.gz", "the date has PM behind it, which python-can does not read"),
    ("test_CanMessage.blf", "a mere request to send is not a frame on the bus"),
    ("test_CanMessage2.blf", "a mere request to send is not a frame on the bus"),
    ("test_CanMessage_V1_0_BUS1.trc", "python-can does not read the date of version 1.0"),
];

#[test]
fn python_cans_own_test_files_read_the_same() {
    let Some(data) = python_can_test_data() else { return };
    let known = ["asc", "blf", "trc", "gz"];
    let mut paths: Vec<_> = fs::read_dir(data)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|suffix| known.iter().any(|known| suffix == *known)))
        .collect();
    paths.sort();
    assert!(paths.len() >= 20, "{paths:?}");
    let Some(theirs) = python_can_reads(&paths) else { return };
    let mut differences = Vec::new();
    for path in &paths {
        let name = path.file_name().unwrap().to_str().unwrap();
        let theirs = theirs[path].clone();
        let ours = lines(&read(path).0, EVERYTHING);
        if ours != theirs {
            differences.push((name.to_owned(), ours, theirs));
        }
    }
    for path in &paths {
        cut_everywhere(path);
    }
    let names: Vec<_> = differences.iter().map(|(name, ..)| name.as_str()).collect();
    let expected: Vec<_> = DIFFERENT.iter().map(|(name, _)| *name).collect();
    assert_eq!(names, expected, "{differences:#?}");
}
