//! CSV in four dialects; the reader detects the dialect from the header.
//!
//! python-can's and our own are below; the earlier CANanalyser's is in [`analyser`](super::analyser), SavvyCAN's in
//! [`gvret`](super::gvret).

mod full;
mod python_can;
mod rows;

pub(crate) use full::Encoder as FullEncoder;
pub(crate) use python_can::Encoder as PythonCanEncoder;
#[cfg(feature = "sqlite")]
pub(crate) use python_can::{Message, time_ns as python_time_ns};

use std::collections::VecDeque;
use std::io;

use super::analyser;
use super::codec::Decode;
use super::error_frames::ErrorFrames;
use super::found::{Found, Row};
use super::gvret;
use super::input::Input;
use super::issue::{Fault, Place};
use super::seek;
use super::zone::Zone;
use cantap_trace::{TraceEvent, TraceRecord};

/// The columns.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum CsvDialect {
    /// As python-can writes and reads it.
    PythonCan,
    /// Ours: complete, for people and spreadsheets.
    Full,
    /// The earlier CANanalyser's.
    Analyser,
    /// SavvyCAN's.
    Gvret,
}

/// Reads any dialect.
#[derive(Default)]
pub(crate) struct Decoder {
    dialect: Option<CsvDialect>,
    /// Whether our own dialect's rows end with the device's time.
    has_device: bool,
    analyser: analyser::RowDecoder,
    gvret: gvret::RowDecoder,
    /// Lines before the header that may be the analyser's comments, with the fault to report if they are not.
    no_head: VecDeque<(Place, Fault)>,
    error_frames: ErrorFrames,
}

impl Decoder {
    /// `zone` is the zone of the file's date, if it has one.
    pub(crate) fn new(zone: &Zone) -> Self {
        Self { analyser: analyser::RowDecoder::new(zone), ..Self::default() }
    }
}

/// What a file can be in, by number.
const DIALECTS: [CsvDialect; 4] =
    [CsvDialect::PythonCan, CsvDialect::Full, CsvDialect::Analyser, CsvDialect::Gvret];

impl Decode for Decoder {
    fn save(&self, state: &mut Vec<u8>) -> bool {
        let dialect = self.dialect.map(|dialect| DIALECTS.iter().position(|known| *known == dialect));
        self.no_head.is_empty()
            && self.error_frames.is_over()
            && seek::save(&(dialect, self.has_device, self.analyser.state(), &self.gvret), state)
    }

    fn restore(&mut self, state: &[u8]) -> Option<()> {
        let (dialect, analyser): (Option<Option<usize>>, _);
        (dialect, self.has_device, analyser, self.gvret) = seek::load(state)?;
        self.dialect = match dialect {
            Some(number) => Some(*DIALECTS.get(number?)?),
            None => None,
        };
        self.analyser.restore(analyser)
    }

    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        if let Some(found) = self.error_frames.next() {
            return Ok(found);
        }
        // Too many for comments, or before a header that allows none.
        if (self.dialect.is_some() || self.no_head.len() > MAX_COMMENTS)
            && let Some((place, fault)) = self.no_head.pop_front()
        {
            return Ok(Found::Issue(place, fault));
        }
        while let Some(line) = input.line()? {
            let text = line.text.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(line.text).trim_ascii();
            if text.is_empty() {
                continue;
            }
            let result = match self.dialect {
                None => self.head(text),
                Some(CsvDialect::PythonCan) => python_can::row(text, &mut self.error_frames),
                Some(CsvDialect::Full) => full::row(text, self.has_device).map(|record| Some((record, None))),
                Some(CsvDialect::Analyser) => self.analyser.line(text, line.terminated),
                Some(CsvDialect::Gvret) => self.gvret.line(text),
            };
            if !line.terminated && self.may_be_cut(text, &result) {
                return Ok(line.cut());
            }
            match result {
                Ok(Some((record, second))) => {
                    self.error_frames.keep(second.map(|event| TraceRecord { event, ..record }));
                    return Ok(Found::Record(record));
                }
                Ok(None) => {}
                Err(fault) if self.dialect.is_none() => {
                    // The analyser's file begins with comments; only the header after them shows that they are not
                    // damage.
                    self.no_head.push_back((Place::Line(line.number), fault));
                    if self.no_head.len() > MAX_COMMENTS
                        && let Some((place, fault)) = self.no_head.pop_front()
                    {
                        return Ok(Found::Issue(place, fault));
                    }
                }
                Err(fault) => return Ok(line.issue(fault)),
            }
        }
        Ok(self.no_head.pop_front().map_or(Found::End, |(place, fault)| Found::Issue(place, fault)))
    }
}

/// Whether a text begins like a table of python-can, with the names of its columns or without, of ours or of the analyser.
pub(crate) fn is_head(text: &[u8]) -> bool {
    // Tables of others have some of the same names.
    text.starts_with(b"timestamp,arbitration_id,extended")
        || text.starts_with(b"time,channel,direction")
        || analyser::is_head(text)
        || python_can::is_row(text.split(|byte| *byte == b'\n').next().unwrap_or_default().trim_ascii())
}

/// More lines than this before the header are not comments.
const MAX_COMMENTS: usize = 100;

impl Decoder {
    /// Whether a last row that looks whole but has no line end may have lost its end.
    fn may_be_cut(&self, row: &[u8], read: &Result<Row, Fault>) -> bool {
        let Ok(Some((TraceRecord { event, .. }, _))) = read else { return false };
        let is_frame = matches!(event, TraceEvent::Frame { .. });
        match self.dialect {
            Some(CsvDialect::Full) if self.has_device => !row.ends_with(b","),
            Some(CsvDialect::Full) => !is_frame || !(row.ends_with(b",") || row.ends_with(b",late")),
            Some(CsvDialect::PythonCan) => !is_frame && !row.ends_with(b"="),
            // Its rows end with a comma.
            Some(CsvDialect::Gvret) => !row.ends_with(b","),
            Some(CsvDialect::Analyser) | None => false,
        }
    }

    fn head(&mut self, line: &[u8]) -> Result<Row, Fault> {
        if line == python_can::HEAD.as_bytes() {
            self.dialect = Some(CsvDialect::PythonCan);
        } else if [full::HEAD, full::HEAD_WITHOUT_DEVICE].map(str::as_bytes).contains(&line) {
            self.dialect = Some(CsvDialect::Full);
            self.has_device = line == full::HEAD.as_bytes();
        } else if self.gvret.head(line) {
            self.dialect = Some(CsvDialect::Gvret);
        } else if self.analyser.head(line) {
            self.dialect = Some(CsvDialect::Analyser);
            self.no_head.clear();
        } else {
            // A table without its header is most likely one in SavvyCAN's columns, if they fit, or in python-can's, cut out of a file.
            if self.gvret.headless(line) {
                self.dialect = Some(CsvDialect::Gvret);
                return self.gvret.line(line);
            }
            let row = python_can::row(line, &mut self.error_frames);
            if row.is_ok() {
                self.dialect = Some(CsvDialect::PythonCan);
                return row;
            }
            let expected =
                format!("a head such as {}, {} or Index;TimeStamps;…", python_can::HEAD, full::HEAD);
            return Err(Fault::malformed(expected, line));
        }
        Ok(None)
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use super::*;
    use crate::{Format, WriteOptions};
    use cantap_trace::Direction;
    use cantap_trace::testing::{record, record_lin_or_can, with_device_time};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn any_trace_round_trips(records in prop::collection::vec(record(1), 0..20), late: bool) {
            let mut records = records;
            if let Some(TraceRecord { event: TraceEvent::Frame { late: flag, .. }, .. }) = records.first_mut() {
                *flag = late;
            }
            prop_assert_eq!(tests::round_trip(Format::Csv(CsvDialect::Full), &records), records.clone());
            let options =
                WriteOptions { format: Some(Format::Csv(CsvDialect::PythonCan)), ..WriteOptions::default() };
            let (bytes, left_out) = tests::write_with(&options, &records);
            let plain = |record: &TraceRecord| {
                let mut event = record.event;
                if let TraceEvent::Frame { direction, late, .. } = &mut event {
                    (*direction, *late) = (Direction::Rx, false);
                }
                TraceRecord { channel: 1, event, ..*record }
            };
            let expected: Vec<_> = records.iter().map(plain).collect();
            let (read, issues) = tests::read(Format::Csv(CsvDialect::Full), bytes);
            prop_assert_eq!(issues, Vec::<String>::new());
            prop_assert_eq!(read, expected.clone());
            let told = records.iter().zip(&expected).filter(|(record, plain)| record.channel != plain.channel);
            let noted = left_out.iter().filter(|(what, _)| what.contains("channels")).map(|(_, count)| count);
            prop_assert_eq!(noted.sum::<u64>(), told.count() as u64);
        }

        #[test]
        fn our_own_dialect_keeps_fd_frames_and_the_devices_time(
            records in prop::collection::vec(with_device_time(record_lin_or_can(1)), 0..20),
        ) {
            prop_assert_eq!(tests::round_trip(Format::Csv(CsvDialect::Full), &records), records);
        }
    }

    #[test]
    fn a_file_of_before_there_was_the_devices_time_is_read_and_half_a_time_is_none() {
        let old = "time,channel,direction,type,id,dlc,data,event\n1.5,1,Rx,data,123,1,55,late\n1.5,1,Rx,data,123,1,55,";
        let (records, issues) = tests::read(Format::Csv(CsvDialect::Full), old);
        assert_eq!((records.len(), issues), (2, Vec::new()));
        assert_eq!(records[0].device_ns, None);
        let head = "time,channel,direction,type,id,dlc,data,event,device_ns\n";
        let row = "1.5,1,Rx,data,123,1,55,,1234567";
        let (records, issues) = tests::read(Format::Csv(CsvDialect::Full), format!("{head}{row}\n"));
        assert_eq!((records[0].device_ns, issues), (cantap_trace::DeviceNs::new(1_234_567), Vec::new()));
        for cut in [row, &row[..row.len() - 2], "1.5,1,Rx,data,123,1,55,", "1.5,1,Rx,data,123,1,55,late"] {
            let (records, issues) = tests::read(Format::Csv(CsvDialect::Full), format!("{head}{cut}"));
            assert_eq!((records.len(), issues.len()), (0, 1), "{cut}: {issues:?}");
        }
        for wrong in ["0", "-1", "x", "99999999999999999999"] {
            let (records, issues) = tests::read(
                Format::Csv(CsvDialect::Full),
                format!("{head}1.5,1,Rx,data,123,1,55,,{wrong}\n"),
            );
            assert_eq!((records.len(), issues.len()), (0, 1), "{wrong}: {issues:?}");
        }
    }

    #[test]
    fn rows_are_python_cans() {
        let file = "timestamp,arbitration_id,extended,remote,error,dlc,data\n\
                    1483389946.197000,0xdadada,1,0,0,6,WzQyLCA5XQ==\n";
        let (records, issues) = tests::read(Format::Csv(CsvDialect::PythonCan), file);
        // python-can's own example has a length of 6 and 7 bytes.
        assert_eq!((records.len(), issues.len()), (0, 1));
        let file = file.replace(",6,", ",7,").replace("0xdadada", "0xDADADA");
        let (records, issues) = tests::read(Format::Csv(CsvDialect::PythonCan), &file);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(tests::write(Format::Csv(CsvDialect::PythonCan), &records), file);
        assert_eq!(
            tests::write(Format::Csv(CsvDialect::Full), &records),
            "time,channel,direction,type,id,dlc,data,event,device_ns\n\
             1483389946.197000,1,Rx,data,00DADADA,7,5B34322C20395D,,\n"
        );
    }

    /// With the names of its columns cut off, flags were once taken for lengths and bytes, and the bytes for something without a place in a trace.
    #[test]
    fn python_cans_rows_are_known_without_the_names_above_them() {
        let rows = "1691588499.4185264,0x4,0,0,1,8,AAQAAAAAAAA=\n1691588499.482613,0xcfff048,1,0,0,2,EiM=\n\
                    1691588499.483165,0x123,0,0,0,0,\n";
        let (_, without_the_first) = rows.split_once('\n').unwrap();
        for file in [rows, without_the_first] {
            assert_eq!(
                Format::of_content(file.as_bytes()),
                Some(Format::Csv(CsvDialect::PythonCan)),
                "{file}"
            );
        }
        let (records, issues) = tests::read(Format::Csv(CsvDialect::PythonCan), rows);
        assert_eq!(issues, Vec::<String>::new());
        assert!(matches!(records[0].event, TraceEvent::State { .. }), "{records:?}");
        let log = "(1691588499.482613) can0 0CFFF048#1223\n(1691588499.483165) can0 123#\n";
        assert_eq!(tests::write(Format::Candump, &records[1..]), log);
        // Nor are such rows with other separators a table with as many bytes as its third column says.
        assert_eq!(Format::of_content(rows.replace(',', ";").as_bytes()), None);
    }

    /// python-can writes a longer frame with its length and bytes, and nothing else that shows it is FD.
    #[test]
    fn python_cans_dialect_keeps_the_data_of_fd_frames_and_counts_what_it_has_no_column_for() {
        let log = "(1.000000) can0 123##1000102030405060708090A0B\n(2.000000) can0 124##0AA\n";
        let (records, _) = tests::read(Format::Candump, log);
        let options =
            WriteOptions { format: Some(Format::Csv(CsvDialect::PythonCan)), ..WriteOptions::default() };
        let (bytes, left_out) = tests::write_with(&options, &records);
        let (read, issues) = tests::read(Format::Csv(CsvDialect::PythonCan), bytes);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            tests::write(Format::Candump, &read),
            "(1.000000) can0 123##0000102030405060708090A0B\n(2.000000) can0 124#AA\n"
        );
        let counts: Vec<_> = left_out.iter().collect();
        assert_eq!(
            counts,
            [
                ("that short CAN FD frames are such, which python-can's CSV has no column for", 1),
                ("the flags of CAN FD frames, which python-can's CSV has no column for", 1),
            ]
        );
        let bad = "timestamp,arbitration_id,extended,remote,error,dlc,data\n1.0,0x1,0,0,0,9,AAAAAAAAAAAA\n";
        assert!(
            tests::read(Format::Csv(CsvDialect::PythonCan), bad).1[0]
                .contains("a length that CAN or CAN FD has")
        );
    }

    #[test]
    fn flags_are_read_or_refused_and_every_unknown_line_counts() {
        let file = "timestamp,arbitration_id,extended,remote,error,dlc,data\n1.0,0x800,True,0,0,0,\n\
                    1.0,0x1,2,0,0,0,\n1.0,0x1,0,x,0,0,\n1.0,0x1,0,0,,0,\n2.0,0x1,False,0,0,0,\n";
        let (records, issues) = tests::read(Format::Csv(CsvDialect::PythonCan), file);
        assert_eq!(
            tests::write(Format::Candump, &records),
            "(1.000000) can0 00000800#\n(2.000000) can0 001#\n"
        );
        assert_eq!(issues.len(), 3, "{issues:?}");
        // Every line of a file that is not in our formats counts, including those before a header.
        let file = "not a table\n".repeat(150);
        assert_eq!(tests::read(Format::Csv(CsvDialect::PythonCan), &file).1.len(), 150);
        let file = format!("rubbish\nmore\n{}\n2.0,0x1,0,0,0,0,\n", python_can::HEAD);
        let (records, issues) = tests::read(Format::Csv(CsvDialect::PythonCan), &file);
        assert_eq!((records.len(), issues.len()), (1, 2), "{issues:?}");
    }

    #[test]
    fn broken_rows_are_named() {
        let file = "timestamp,arbitration_id,extended,remote,error,dlc,data\n1.0,0x1,0,0,0,1\n\
                    x,0x1,0,0,0,0,\n1.0,zz,0,0,0,0,\n1.0,0x800,0,0,0,0,\n1.0,0x1,0,0,0,1,?\n9.7e-05,0x1,0,1,0,3,\n";
        let (records, issues) = tests::read(Format::Csv(CsvDialect::PythonCan), file);
        assert_eq!(tests::write(Format::Candump, &records), "(0.000097) can0 001#R3\n");
        assert_eq!(issues.len(), 5, "{issues:?}");
        assert_eq!(issues[0], "test, line 2: expected 7 columns, found '1.0,0x1,0,0,0,1'");
    }
}
