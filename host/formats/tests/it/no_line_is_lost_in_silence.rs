//! Changes one byte of every line: each line is then a record, something else that is known and counted, or an
//! issue.

use std::io::{Cursor, Read};
use std::path::Path;

use cantap_formats::{
    CsvDialect, Format, ReadOptions, TraceReader, TrcVersion, WriteOptions, create_writer, open_reader,
};
use cantap_trace::{Direction, FdFrame, TraceEvent, TraceRecord};

const LINES: usize = 4000;

/// Real traffic, with an FD frame in every tenth place if the format has them.
fn records(fd: bool) -> Vec<TraceRecord> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/nmea2000.log.gz");
    let records = open_reader(path, &ReadOptions::default()).unwrap().map(Result::unwrap).take(LINES);
    let flexible = |(at, record): (usize, TraceRecord)| match record.frame().copied() {
        Some(frame) if fd && at % 10 == 0 => {
            let data: Vec<u8> = (0..[12_u8, 20, 64][at / 10 % 3]).map(|byte| byte.wrapping_mul(7)).collect();
            let frame = FdFrame::new(frame.id(), at % 20 == 0, false, &data).unwrap().into();
            TraceRecord {
                event: TraceEvent::Frame { frame, direction: Direction::Tx, late: false },
                ..record
            }
        }
        _ => record,
    };
    records.enumerate().map(flexible).collect()
}

/// A text in each format: what comes before the rows, and the rows.
struct Text {
    format: Format,
    head: Vec<u8>,
    rows: Vec<Vec<u8>>,
}

impl Text {
    /// As this library writes it.
    fn written(format: Format, fd: bool) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("whole");
        let options = WriteOptions { format: Some(format), ..WriteOptions::default() };
        let mut writer = create_writer(&path, &options).unwrap();
        for record in records(fd) {
            writer.write(&record).unwrap();
        }
        writer.finish().unwrap();
        let mut text = Vec::new();
        std::fs::File::open(&path).unwrap().read_to_end(&mut text).unwrap();
        let mut lines: Vec<Vec<u8>> =
            text.split_inclusive(|byte| *byte == b'\n').map(<[u8]>::to_vec).collect();
        let rows = lines.split_off(lines.iter().position(|line| is_row(format, line)).unwrap());
        Self { format, head: lines.concat(), rows: rows.into_iter().take(LINES).collect() }
    }

    /// As another program writes it: `row` gets the record's number, its identifier, whether that is extended, and its bytes.
    fn foreign(format: Format, head: &str, row: impl Fn(usize, u32, bool, &[u8]) -> String) -> Self {
        let rows = records(false).into_iter().enumerate().map(|(at, record)| {
            let frame = record.frame().unwrap();
            row(at, frame.id().raw(), frame.id().is_extended(), frame.data()).into_bytes()
        });
        Self { format, head: head.as_bytes().to_vec(), rows: rows.collect() }
    }

    /// How many records, issues, and other counted things are in a file of the header and these rows.
    fn found(&self, rows: &[&[u8]]) -> (u64, u64, u64) {
        let source = Cursor::new([&self.head, &rows.concat()[..]].concat());
        let mut reader =
            TraceReader::from_source("damaged", source, self.format, &ReadOptions::default()).unwrap();
        let issues = reader.by_ref().filter(Result::is_err).count() as u64;
        (reader.records(), issues, reader.left_out().total() + reader.notes().total())
    }
}

fn hex(data: &[u8], between: &str) -> String {
    data.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(between)
}

/// The formats that can only be read.
fn foreign() -> Vec<Text> {
    let letter = |extended, yes, no| if extended { yes } else { no };
    vec![
        Text::foreign(Format::CandumpScreen, "", |at, id, extended, data| {
            let id = if extended { format!("{id:08X}") } else { format!("{id:03X}") };
            format!(" (1410714882.{at:06})  can0  {id}   [{}]  {}\n", data.len(), hex(data, " "))
        }),
        Text::foreign(
            Format::Busmaster,
            "***BUSMASTER Ver 2.4.0***\n***PROTOCOL CAN***\n***START DATE AND TIME 8:8:2014 23:59:58:965***\n***HEX***\n***SYSTEM MODE***\n",
            |at, id, extended, data| {
                format!(
                    "23:59:59:{at:04} Rx 1 0x{id:03X} {} {} {} \n",
                    letter(extended, "x", "s"),
                    data.len(),
                    hex(data, " ")
                )
            },
        ),
        Text::foreign(Format::Crtd, "", |at, id, extended, data| {
            format!("1320745424.{at:06} 1R{} {id:X} {}\n", letter(extended, "29", "11"), hex(data, " "))
        }),
        Text::foreign(
            Format::Kvaser,
            "Kvaser Memorator Log\nFormat of data field: HEX\nFormat of id field:   HEX\nTime Chan   Identifier\n=======\n",
            |at, id, extended, data| {
                format!(
                    "    0.{at:06}  1  {id:8X}{}   Rx  {}  {}   {at}\n",
                    letter(extended, "x", " "),
                    data.len(),
                    hex(data, " ")
                )
            },
        ),
        Text::foreign(
            Format::CanKing,
            "Chn Identifier Flg   DLC  D0...1...2...3...4...5...6..D7       Time     Dir\n",
            |at, id, extended, data| {
                format!(
                    " 0    {id:08X} {}       {}  {}     1.{at:06} R\n",
                    letter(extended, "X", " "),
                    data.len(),
                    hex(data, "  ")
                )
            },
        ),
        Text::foreign(
            Format::Microchip,
            "//-----\nMicrochip Technology Inc.\nCAN BUS Analyzer\n//-----\n",
            |at, id, _, data| format!("{at};RX;0x{id:X};{};0x{}\n", data.len(), hex(data, ";0x")),
        ),
        Text::foreign(
            Format::CanHacker,
            "Time   ID     DLC Data                    Comment\n",
            |_, id, _, data| format!("00.500 {id:X} {} {} \n", data.len(), hex(data, " ")),
        ),
        Text::foreign(Format::Table, "Timestamp,CAN ID,IDE,DLC,Data\n", |at, id, extended, data| {
            format!("1.{at:06},{id:03X},{},{},{}\n", u8::from(extended), data.len(), hex(data, " "))
        }),
        Text::foreign(Format::Printer, "", |at, id, extended, data| {
            format!(
                "Timestamp: 1410714882.{at:06}    ID: {id:8x}    {} Rx                DL:  {}    {}     Channel: can0\n",
                letter(extended, "X", "S"),
                data.len(),
                hex(data, " ").to_lowercase()
            )
        }),
    ]
}

/// The formats that are written, and whether they carry CAN FD.
const WRITTEN: [(Format, bool); 12] = [
    (Format::Candump, true),
    (Format::Asc, true),
    (Format::Trc(TrcVersion::V2_1), true),
    (Format::Trc(TrcVersion::V2_0), true),
    (Format::Trc(TrcVersion::V1_3), false),
    (Format::Trc(TrcVersion::V1_2), false),
    (Format::Trc(TrcVersion::V1_1), false),
    (Format::Trc(TrcVersion::V1_0), false),
    (Format::Csv(CsvDialect::PythonCan), false),
    (Format::Csv(CsvDialect::Full), true),
    (Format::Csv(CsvDialect::Analyser), false),
    (Format::Csv(CsvDialect::Gvret), true),
];

/// A block of a disk that was lost is zeros. Where the hole began in a column that nobody reads, the lines in it were lost in silence.
#[test]
fn a_hole_of_nul_bytes_is_an_issue_wherever_it_begins_and_ends() {
    const HOLE: usize = 512;
    let written = WRITTEN.into_iter().map(|(format, fd)| Text::written(format, fd));
    let texts = written.chain(foreign()).map(|text| {
        let rows: Vec<u8> = text.rows.iter().take(60).flatten().copied().collect();
        (text.format, [&text.head[..], &rows].concat(), text.head.len())
    });
    let table = {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("whole.dif");
        let mut writer = create_writer(&path, &WriteOptions::default()).unwrap();
        records(false).iter().take(60).for_each(|record| writer.write(record).unwrap());
        writer.finish().unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let head = bytes.len() / 4;
        (Format::Dif, bytes, head)
    };
    for (format, whole, head) in texts.chain([table]) {
        let found = |bytes: Vec<u8>| {
            let reader =
                TraceReader::from_source("hole", Cursor::new(bytes), format, &ReadOptions::default());
            reader.unwrap().filter_map(Result::err).map(|issue| issue.to_string()).collect::<Vec<_>>()
        };
        assert_eq!(found(whole.clone()), Vec::<String>::new(), "{format}");
        for at in (head..whole.len() - HOLE).take(400) {
            let mut holed = whole.clone();
            holed[at..at + HOLE].fill(0);
            let issues = found(holed);
            assert!(!issues.is_empty(), "{format}: nothing said of a hole at {at}");
            let is_said = issues.iter().any(|issue| issue.contains("NUL bytes"));
            assert!(is_said, "{format}: {issues:?}");
            let mut places: Vec<_> = issues.iter().map(|issue| issue.split(": ").next().unwrap()).collect();
            places.dedup();
            assert_eq!(places.len(), issues.len(), "{format}: one line is wrong once: {issues:?}");
        }
    }
}

/// They looked like an empty log that was read without a fault.
#[test]
fn comments_alone_are_not_a_trace_that_was_read() {
    let of = |text: &str| {
        let source = Cursor::new(text.to_owned());
        let mut reader =
            TraceReader::from_source("a.log", source, Format::Candump, &ReadOptions::default()).unwrap();
        assert_eq!(reader.by_ref().count(), 0);
        reader.nothing_read().map(|nothing| nothing.to_string())
    };
    let nothing = of("# drive 3\n# of two\n").unwrap();
    assert!(nothing.contains("without a single frame"), "{nothing}");
    assert_eq!(of(""), None);
}

#[test]
fn with_one_byte_changed_in_every_line_none_is_lost_without_being_counted() {
    let written = WRITTEN.into_iter().map(|(format, fd)| Text::written(format, fd));
    for text in written.chain(foreign()) {
        let (format, whole) = (text.format, &text.rows);
        let all: Vec<&[u8]> = whole.iter().map(Vec::as_slice).collect();
        // Comments and warnings are written only on request.
        assert_eq!(text.found(&all), (LINES as u64, 0, 0), "{format}: the rows are none");
        for seed in 0..2 {
            let mut random = fastrand::Rng::with_seed(seed);
            let mut issues = 0;
            for row in whole {
                let mut row = row.clone();
                let at =
                    random.usize(..row.len() - row.iter().rev().take_while(|byte| **byte < b' ').count());
                let old = row[at];
                while row[at] == old || matches!(row[at], b'\n' | b'\r') {
                    row[at] = random.u8(..);
                }
                // After a whole row, on its own: a line with two events would make up for one that is lost.
                let (records, wrong, others) = text.found(&[&whole[0], &row]);
                // Comments are a separate kind; the program that made the file may have written them.
                let is_comment = match format {
                    Format::Candump => row.starts_with(b"#"),
                    Format::Csv(CsvDialect::Analyser) => matches!(row[0], b'#' | b'/'),
                    _ => false,
                };
                assert!(
                    records + wrong + others > 1 || is_comment,
                    "{format}: {:?}",
                    String::from_utf8_lossy(&row)
                );
                issues += u64::from(wrong > 0);
            }
            // If the test damaged nothing, it would show nothing.
            assert!(issues > LINES as u64 / 20, "{format}: {issues}");
        }
    }
}

/// In DIF a row is many lines.
#[test]
fn with_one_byte_changed_in_every_row_of_a_table_each_is_a_record_or_an_issue() {
    const BEGIN: &[u8] = b"-1,0\r\nBOT\r\n";
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("whole.dif");
    let mut writer = create_writer(&path, &WriteOptions::default()).unwrap();
    for record in records(false) {
        writer.write(&record).unwrap();
    }
    writer.finish().unwrap();
    let text = std::fs::read(&path).unwrap();
    let begins: Vec<_> = (0..text.len()).filter(|at| text[*at..].starts_with(BEGIN)).collect();
    // The names of the columns, then the rows.
    assert_eq!(begins.len(), LINES + 1);
    let mut random = fastrand::Rng::with_seed(1);
    let mut counts = [0; 2];
    for row in begins[1..].windows(2) {
        let mut damaged = [&text[..begins[2]], &text[row[0]..row[1]], &text[begins[LINES]..]].concat();
        // The row in the middle, except for its starting mark, which ends the row before.
        let at = begins[2] + BEGIN.len() + random.usize(..row[1] - row[0] - BEGIN.len());
        let old = damaged[at];
        while damaged[at] == old {
            damaged[at] = random.u8(..);
        }
        let source = Cursor::new(damaged);
        let reader =
            TraceReader::from_source("damaged", source, Format::Dif, &ReadOptions::default()).unwrap();
        let (read, wrong): (Vec<_>, Vec<_>) = reader.partition(Result::is_ok);
        assert!(read.len() + wrong.len() >= 3, "{} and {wrong:?} at {at}", read.len());
        counts[usize::from(wrong.is_empty())] += 1;
    }
    assert!(counts[0] > LINES / 20, "{counts:?}");
}

/// Not every change can be noticed, but missing records can.
#[test]
fn with_one_byte_of_a_binary_file_changed_no_record_is_lost_without_being_told() {
    const RECORDS: usize = 200;
    let records = &records(true)[..RECORDS];
    for format in [Format::Blf, Format::Pcapng, Format::Mf4] {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("whole");
        let options = WriteOptions { format: Some(format), ..WriteOptions::default() };
        let mut writer = create_writer(&path, &options).unwrap();
        for record in records {
            writer.write(record).unwrap();
        }
        writer.finish().unwrap();
        let whole = std::fs::read(&path).unwrap();
        let found = |bytes: Vec<u8>| {
            let source = Cursor::new(bytes);
            let reader = TraceReader::from_source("damaged", source, format, &ReadOptions::default());
            let mut reader = reader.unwrap();
            let issues = reader.by_ref().filter(Result::is_err).count() as u64;
            (reader.records(), issues + reader.left_out().total() + reader.notes().total())
        };
        assert_eq!(found(whole.clone()), (RECORDS as u64, 0), "{format}");
        let mut random = fastrand::Rng::with_seed(3);
        let mut told = 0;
        for turn in 0..6000 {
            let mut damaged = whole.clone();
            // What describes the file is short, and gets its turn, too.
            let at = random.usize(..if turn % 2 == 0 { whole.len() } else { whole.len().min(2000) });
            damaged[at] ^= random.u8(1..);
            let (at_value, (records, words)) = (damaged[at], found(damaged));
            assert!(
                records >= RECORDS as u64 || words > 0,
                "{format}: {records} with {at_value:#x} for {:#x} at {at:#x}",
                whole[at]
            );
            told += u64::from(words > 0);
        }
        assert!(told > 100, "{format}: {told}");
    }
}

fn is_row(format: Format, line: &[u8]) -> bool {
    let text = line.trim_ascii_start();
    match format {
        Format::Asc => text.first().is_some_and(u8::is_ascii_digit) && !text.ends_with(b"measurement\n"),
        Format::Trc(_) => !text.starts_with(b";"),
        Format::Csv(_) => text.first().is_some_and(u8::is_ascii_digit),
        _ => true,
    }
}
