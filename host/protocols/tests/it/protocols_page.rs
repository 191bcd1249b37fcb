//! docs/protocols.md has a row for each service or object: those of `data/protocols-page.txt`, each with messages that are decoded here.
//!
//! After an intended change, rewrite them with `CANTAP_OVERWRITE=1 cargo test -p cantap-protocols --test it protocols_page`.

use std::fmt::Write as _;
use std::path::Path;
use std::sync::Arc;

use cantap_protocols::canopen::{Sheet, eds::Eds};
use cantap_protocols::{Options, ReadItem, Reader, odx};
use cantap_trace::{Direction, TraceEvent, TraceRecord};

const CRATE: &str = env!("CARGO_MANIFEST_DIR");
const BEGIN: &str = "| Service or object |";

/// A row of the page, and what shows it.
#[derive(Default)]
struct Row {
    line: String,
    options: Options,
    records: Vec<TraceRecord>,
    now_ms: i64,
    /// What events must say.
    wanted: Vec<String>,
}

impl Row {
    fn frame(&mut self, frame: &str) {
        let frame = frame.parse().unwrap_or_else(|error| panic!("{}: {frame}: {error}", self.line));
        let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
        self.records.push(TraceRecord {
            time_ns: self.now_ms * 1_000_000,
            device_ns: None,
            channel: 1,
            event,
        });
        self.now_ms += 1;
    }

    /// A message of ISO 15765-2, with the other side's flow control if it needs that.
    fn message(&mut self, from: &str, to: &str, data: &[u8]) {
        let hex = |bytes: &[u8]| {
            let bytes = bytes.iter().chain(std::iter::repeat(&0xAA)).take(8);
            bytes.fold(String::new(), |mut text, byte| {
                write!(text, "{byte:02X}").unwrap();
                text
            })
        };
        if data.len() < 8 {
            return self.frame(&format!("{from}#{}", hex(&[&[data.len() as u8], data].concat())));
        }
        self.frame(&format!("{from}#{}", hex(&[&[0x10, data.len() as u8], &data[..6]].concat())));
        self.frame(&format!("{to}#{}", hex(&[0x30, 0, 0])));
        for (number, chunk) in (1_u8..).zip(data[6..].chunks(7)) {
            self.frame(&format!("{from}#{}", hex(&[&[0x20 | number & 15], chunk].concat())));
        }
    }

    fn take(&mut self, line: &str) {
        let file = |path: &str| std::fs::read(Path::new(CRATE).join(path)).unwrap();
        let words: Vec<&str> = line.split(' ').collect();
        match words[..] {
            ["=", ..] => self.wanted.push(line[2..].to_owned()),
            ["wait", ms] => self.now_ms += ms.parse::<i64>().unwrap(),
            ["eds", node, path] => {
                let (node, eds) = (node.parse().unwrap(), Arc::new(Eds::parse(&file(path))));
                self.options.sheets.push(Sheet { node: Some(node), eds });
            }
            ["odx", path] => {
                let odx = odx::Odx::read(path, &file(path)).unwrap();
                let source = odx::Source { odx: &odx, layer: None };
                self.options.descriptions = Some(Arc::new(odx::Descriptions::new([source]).unwrap()));
            }
            [ends, data] if ends.contains('>') => {
                let (from, to) = ends.split_once('>').unwrap();
                let byte = |at| u8::from_str_radix(&data[at..at + 2], 16).unwrap();
                self.message(from, to, &(0..data.len()).step_by(2).map(byte).collect::<Vec<_>>());
            }
            [frame] if frame.contains('#') => self.frame(frame),
            _ => self.options.protocols = words.iter().map(|name| name.parse().unwrap()).collect(),
        }
    }

    /// What all events say.
    fn events(&mut self) -> Vec<String> {
        let mut said = Vec::new();
        let mut reader = Reader::new(std::mem::take(&mut self.options));
        reader
            .take(&self.records, false, |read| {
                if let ReadItem::Event(event) = read {
                    said.push(event.to_string());
                }
                Ok::<_, std::convert::Infallible>(())
            })
            .unwrap();
        said
    }
}

fn rows() -> Vec<Row> {
    let text = std::fs::read_to_string(Path::new(CRATE).join("tests/data/protocols-page.txt")).unwrap();
    let mut rows: Vec<Row> = Vec::new();
    for line in text.lines().filter(|line| !line.is_empty() && !line.starts_with('#')) {
        if line.starts_with('|') {
            rows.push(Row { line: line.to_owned(), ..Row::default() });
        } else {
            rows.last_mut().unwrap().take(line);
        }
    }
    rows
}

/// A row of which no message shows anything is a claim.
#[test]
fn what_every_row_says_is_decoded() {
    let mut faults = String::new();
    for mut row in rows() {
        let said = row.events();
        let missing: Vec<_> =
            row.wanted.iter().filter(|wanted| !said.iter().any(|line| line.contains(*wanted))).collect();
        if row.wanted.is_empty() || !missing.is_empty() {
            writeln!(faults, "{}\n  missing: {missing:?}\n  said: {said:#?}", row.line).unwrap();
        }
    }
    assert!(faults.is_empty(), "{faults}");
}

#[test]
fn the_page_has_these_rows() {
    let page = Path::new(CRATE).join("../../docs/protocols.md");
    let text = std::fs::read_to_string(&page).unwrap();
    let (head, table) = text.split_at(text.find(BEGIN).expect("the page has the table"));
    let mut lines = table.split_inclusive('\n');
    let names: String = lines.by_ref().take(2).collect();
    let rest: String = lines.skip_while(|line| line.starts_with('|')).collect();
    let rows: String = rows().iter().map(|row| row.line.clone() + "\n").collect();
    let expected = format!("{head}{names}{rows}{rest}");
    if std::env::var_os("CANTAP_OVERWRITE").is_some() {
        return std::fs::write(page, expected).unwrap();
    }
    assert!(text == expected, "docs/protocols.md has other rows; write it anew with CANTAP_OVERWRITE=1");
}
