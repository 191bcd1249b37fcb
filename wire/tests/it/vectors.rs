//! `wire/vectors.json`: what crosses USB, byte for byte, for authors of clients in other languages.
//!
//! The file is generated and pinned here: a change to the protocol changes it, and this test says how to regenerate
//! it.

use crate::samples;

use std::fmt::Write;

use cantap_wire::batch::BatchWriter;
use cantap_wire::framing::{CRC_LEN, MAX_ENCODED, MAX_MESSAGE, encode, seal};
use cantap_wire::message::{DeviceMessage, EndReason};
use cantap_wire::record::{MAX_RECORD, TransmitFailure, encode_event, encode_received};
use cantap_wire::{
    Channel, Command, Decoded, Decoder, Event, Frame, PROTOCOL_VERSION, Received, Record, Refusal, Reply,
    Request, Response, Stamp,
};
use samples::{commands, events, frame, hex, refusals, replies};
use serde::Serialize;
use serde_json::{Value, json};

const FILE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/vectors.json");
const ABOUT: &str = "Test vectors of cantap's wire protocol (docs/wire-protocol.md), made by wire/tests/it/vectors.rs. All bytes are \
    hexadecimal. `message` is before CRC and COBS, `wire` is what crosses USB, the ending zero included. `reads` is what the clients \
    in docs/clients print for it. The `wire` of all `batches`, one after the other, is one session.";
/// Ticks from one record to the next.
const STEP: i64 = 576;
/// One second.
const START: u64 = 12_000_000;

fn channel_name(channel: Channel) -> String {
    format!("can{}", channel.number())
}

/// The last part of a variant's name, in lower case with hyphens.
fn hyphenated(value: &impl Serialize) -> String {
    let name = variant(value);
    let mut words = String::new();
    for letter in name.chars() {
        if letter.is_uppercase() && !words.is_empty() {
            words.push('-');
        }
        words.extend(letter.to_lowercase());
    }
    words
}

/// The name of an enum's variant.
fn variant(value: &impl Serialize) -> String {
    match serde_json::to_value(value).unwrap() {
        Value::String(name) => name,
        Value::Object(fields) => fields.into_iter().next().unwrap().0,
        other => panic!("{other} is no variant"),
    }
}

/// Identifier, DLC, and what the frame carries.
fn frame_reads(frame: &Frame, data_omitted: bool) -> String {
    let width = if frame.id().is_extended() { 8 } else { 3 };
    let mut reads = format!("{:0width$X} {}", frame.id().raw(), frame.dlc());
    if frame.is_remote() {
        reads.push_str(" remote");
    } else if data_omitted {
        reads.push_str(" no-data");
    } else if !frame.data().is_empty() {
        reads.push(' ');
        reads.extend(frame.data().iter().map(|byte| format!("{byte:02x}")));
    }
    reads
}

fn received_reads(received: &Received) -> String {
    let stamp = match received.stamp {
        Stamp::Exact => "",
        Stamp::UpperBound => " upper-bound",
        Stamp::Omitted => " no-time",
    };
    format!(
        "{} {}{stamp}",
        channel_name(received.channel),
        frame_reads(&received.frame, received.data_omitted)
    )
}

fn event_reads(event: &Event) -> String {
    match event {
        Event::Lost { channel, stage, count, at_least } => {
            let bound = if *at_least { "at-least " } else { "" };
            format!("{} lost {bound}{count} {}", channel_name(*channel), hyphenated(stage))
        }
        Event::BusError { channel, kind, tec, rec } => {
            format!("{} error {} tec {tec} rec {rec}", channel_name(*channel), hyphenated(kind))
        }
        Event::ErrorsSuppressed { channel, count } => {
            format!("{} errors-suppressed {count}", channel_name(*channel))
        }
        Event::State { channel, state, tec, rec } => {
            format!("{} state {} tec {tec} rec {rec}", channel_name(*channel), hyphenated(state))
        }
        Event::Started { channel } => format!("{} started", channel_name(*channel)),
        Event::Stopped { channel } => format!("{} stopped", channel_name(*channel)),
        Event::Transmitted { channel, tag, frame } => {
            format!("{} sent tag {tag} {}", channel_name(*channel), frame_reads(frame, false))
        }
        Event::TransmitFailed { channel, tag, reason } => {
            let periods = match reason {
                TransmitFailure::Overtaken { periods } => format!(" {periods}"),
                _ => String::new(),
            };
            format!("{} not-sent tag {tag} {}{periods}", channel_name(*channel), hyphenated(reason))
        }
        Event::Disturbed { channel, ticks } => format!("{} disturbed {ticks}", channel_name(*channel)),
        Event::SofMark { frame, doubled } => format!("sof {frame} doubled {doubled}"),
    }
}

/// One session: a batch for each record.
struct Session {
    writer: BatchWriter,
    ticks: u64,
    lines: Vec<Value>,
}

impl Session {
    fn record(&mut self, what: &str, value: &Value, record: &Record) {
        let mut bytes = [0; MAX_RECORD];
        let base = self.ticks;
        let (len, frame_of, reads, timed) = match record {
            Record::Received(received) => {
                let len = encode_received(received, STEP, &mut bytes);
                let timed = received.stamp != Stamp::Omitted;
                (len, Some(received.channel), received_reads(received), timed)
            }
            Record::ReceivedFd(_) | Record::TransmittedFd(_) => {
                unreachable!("no board sends it, so that clients need not read it")
            }
            Record::Event(event) => (encode_event(event, STEP, &mut bytes), None, event_reads(event), true),
        };
        if timed {
            self.ticks += STEP as u64;
        }
        assert!(self.writer.push(&bytes[..len], base, frame_of));
        let mut out = [0; MAX_ENCODED];
        let encoded = self.writer.finish(&mut out);
        let reads = format!("{} {reads}", self.ticks);
        self.lines.push(json!({
            "what": what, "value": value, "record": hex(&bytes[..len]), "wire": hex(&out[..encoded]), "reads": [reads],
        }));
    }
}

impl Session {
    /// Many records in one batch without a zero byte among them: a full COBS block.
    fn long_batch(&mut self) {
        let (base, mut reads) = (self.ticks, Vec::new());
        let frame = frame("123#1122334455667788");
        for _ in 0..25 {
            let received =
                Received { channel: Channel::Can1, frame, stamp: Stamp::Exact, data_omitted: false };
            let mut bytes = [0; MAX_RECORD];
            let len = encode_received(&received, STEP, &mut bytes);
            assert!(self.writer.push(&bytes[..len], base, Some(Channel::Can1)));
            self.ticks += STEP as u64;
            reads.push(format!("{} {}", self.ticks, received_reads(&received)));
        }
        let mut out = [0; MAX_ENCODED];
        let len = self.writer.finish(&mut out);
        let what = "25 frames: more than 254 bytes without a zero";
        self.lines.push(json!({ "what": what, "wire": hex(&out[..len]), "reads": reads }));
    }
}

/// A message on the wire, with its own bytes.
fn sealed(message: &impl Serialize) -> (String, String) {
    let (mut buffer, mut out) = ([0; MAX_MESSAGE + CRC_LEN], [0; MAX_ENCODED]);
    let plain = hex(postcard::to_slice(message, &mut buffer).unwrap());
    let len = encode(message, &mut buffer, &mut out).unwrap();
    (plain, hex(&out[..len]))
}

fn requests() -> Vec<Value> {
    let vector = |command: Command| {
        let request = Request { id: 300, command };
        let (message, wire) = sealed(&request);
        json!({ "what": variant(&request.command), "value": request, "message": message, "wire": wire })
    };
    commands().into_iter().map(|(command, _)| vector(command)).collect()
}

fn responses() -> Vec<Value> {
    let vector = |what: String, result: Result<Reply, Refusal>, reads: String| {
        let (message, wire) = sealed(&DeviceMessage::Response(Response { id: 5, result: result.clone() }));
        let value = json!({ "id": 5, "result": result });
        json!({ "what": what, "value": value, "message": message, "wire": wire, "reads": [reads] })
    };
    let replies = replies().into_iter().map(|(reply, _)| {
        let what = variant(&reply);
        let reads = format!("response 5 {what}");
        vector(what, Ok(reply), reads)
    });
    let refusals = refusals().into_iter().map(|(refusal, _)| {
        let what = variant(&refusal);
        let detail = match refusal {
            Refusal::Protocol { device } => format!(" {device}"),
            Refusal::QueueFull { free } => format!(" {free}"),
            Refusal::BanksExhausted { needed, available } => format!(" {needed} {available}"),
            Refusal::NotGranted { needs } => format!(" {}", needs as u8),
            _ => String::new(),
        };
        let reads = format!("response 5 refused {what}{detail}");
        vector(what, Err(refusal), reads)
    });
    replies.chain(refusals).collect()
}

/// Frames with each qualifier, every event, a gap on the link, and the session's end.
fn batches() -> Vec<Value> {
    let mut session = Session { writer: BatchWriter::new(), ticks: START, lines: Vec::new() };
    let plain = ["123#DEADBEEF", "555#", "555#R2", "1F334455#11", "1F334455#R8", "123#1122334455667788_F"];
    let qualified = [
        ("the stamp is an upper bound", Stamp::UpperBound, false),
        ("no time", Stamp::Omitted, false),
        ("no data", Stamp::Exact, true),
        ("upper bound, no data", Stamp::UpperBound, true),
        ("no time, no data", Stamp::Omitted, true),
    ];
    let frames = plain.map(|text| ("a received frame", text, Stamp::Exact, false)).into_iter();
    let frames = frames.chain(qualified.map(|(what, stamp, omitted)| (what, "123#1122", stamp, omitted)));
    for (number, (what, text, stamp, data_omitted)) in frames.enumerate() {
        let channel = Channel::ALL[number % 2];
        let received = Received { channel, frame: frame(text), stamp, data_omitted };
        let value = json!({
            "channel": channel, "frame": text, "stamp": format!("{stamp:?}"), "data_omitted": data_omitted,
        });
        session.record(what, &value, &Record::Received(received));
    }
    for (event, _) in events() {
        session.record(&variant(&event), &serde_json::to_value(event).unwrap(), &Record::Event(event));
    }
    session.long_batch();
    let frame = |text: &str| Received {
        channel: Channel::Can2,
        frame: frame(text),
        stamp: Stamp::Exact,
        data_omitted: false,
    };
    // Two batches that are left out of the file: the next one counts what was in them.
    let told = session.lines.len();
    session.record("", &Value::Null, &Record::Received(frame("100#")));
    session.record("", &Value::Null, &Record::Received(frame("101#")));
    session.lines.truncate(told);
    session.record("after two batches that were lost", &Value::Null, &Record::Received(frame("102#")));
    if let Some(Value::Array(reads)) = session.lines.last_mut().map(|line| &mut line["reads"]) {
        reads.insert(0, json!("lost on the link 0 2"));
    }
    let mut out = [0; MAX_ENCODED];
    let len = session.writer.end(EndReason::Configured, session.ticks, &mut out);
    let reads = format!("{} session ended: configured", session.ticks);
    session.lines.push(json!({ "what": "the session's end", "wire": hex(&out[..len]), "reads": [reads] }));
    session.lines
}

/// COBS near its block size of 254 bytes, and bytes that are not messages.
fn framing() -> Vec<Value> {
    let vector = |what: &str, message: &[u8]| {
        let (mut buffer, mut out) = ([0; MAX_MESSAGE + CRC_LEN], [0; MAX_ENCODED]);
        buffer[..message.len()].copy_from_slice(message);
        let len = seal(&mut buffer, message.len(), &mut out).unwrap();
        json!({ "what": what, "message": hex(message), "wire": hex(&out[..len]) })
    };
    let counted: Vec<u8> = (0..600_u32).map(|n| (n % 255) as u8 + 1).collect();
    let mut zero_behind = counted[..255].to_vec();
    zero_behind[254] = 0;
    let mut all = vec![
        vector("zeros", &[0, 0, 0]),
        vector("250 bytes and the CRC fill a block of 254", &counted[..250]),
        vector("the CRC stands on both sides of a block's end", &counted[..252]),
        vector("a zero right behind a full block", &zero_behind),
        vector("more than two full blocks", &counted),
    ];
    let good = sealed(&Request { id: 1, command: Command::Status }).1;
    let damaged = good.replacen("03", "04", 1);
    assert_ne!(good, damaged);
    let broken =
        [("a wrong CRC", damaged.as_str()), ("a block that is longer than what follows", "09 01 02 00")];
    for (what, wire) in broken.into_iter().chain([("shorter than a CRC", "03 01 02 00")]) {
        all.push(json!({ "what": what, "message": null, "wire": wire }));
    }
    all
}

/// One vector per line, so that a diff shows what changed.
fn file() -> String {
    let parts = [
        ("framing", framing()),
        ("requests", requests()),
        ("responses", responses()),
        ("batches", batches()),
    ];
    let mut text = format!("{{\n\"about\": {},\n\"protocol\": {PROTOCOL_VERSION}", json!(ABOUT));
    for (name, vectors) in parts {
        let lines: Vec<String> = vectors.iter().map(Value::to_string).collect();
        let _ = write!(text, ",\n\"{name}\": [\n{}\n]", lines.join(",\n"));
    }
    text + "\n}\n"
}

#[test]
fn the_file_is_what_this_protocol_says() {
    let expected = file();
    if std::env::var_os("CANTAP_WRITE_VECTORS").is_some() {
        std::fs::write(FILE, &expected).unwrap();
    }
    let found = std::fs::read_to_string(FILE).unwrap_or_default();
    let differs = expected.lines().zip(found.lines()).find(|(expected, found)| expected != found);
    assert!(
        expected == found,
        "wire/vectors.json is of another protocol; if the change was meant, write it again with\n    \
         CANTAP_WRITE_VECTORS=1 cargo test -p cantap-wire --test it vectors\nThe first difference: {differs:?}"
    );
}

/// A variant without a sample would be missing from the file.
#[test]
fn there_is_a_sample_of_every_variant() {
    fn check<T: Serialize + for<'a> serde::Deserialize<'a>>(what: &str, samples: &[T]) {
        let mut bytes = [0; 700];
        let index = |sample: &T, bytes: &mut [u8]| postcard::to_slice(sample, bytes).unwrap()[0];
        let mut seen: Vec<u8> = samples.iter().map(|sample| index(sample, &mut bytes)).collect();
        seen.sort_unstable();
        seen.dedup();
        assert_eq!(seen, (0..seen.len() as u8).collect::<Vec<_>>(), "{what}");
        let mut next = [0; 700];
        next[0] = seen.len() as u8;
        assert!(postcard::take_from_bytes::<T>(&next).is_err(), "{what} {} has no sample", seen.len());
    }
    fn values<T>(table: Vec<(T, &'static str)>) -> Vec<T> {
        table.into_iter().map(|(value, _)| value).collect()
    }
    check("command", &values(commands()));
    check("reply", &values(replies()));
    check("refusal", &values(refusals()));
    check("event", &values(events()));
}

/// The page's tables name every variant, after its index.
#[test]
fn the_document_has_every_variant() {
    let document = include_str!("../../../docs/wire-protocol.md");
    let check = |index: usize, name: String| {
        let row = document.lines().any(|line| {
            line.strip_prefix(&format!("| {index} | {name}")).is_some_and(|rest| rest.starts_with([' ', ',']))
        });
        assert!(row, "no row for {index} {name}");
    };
    let commands = commands().into_iter().map(|(command, bytes)| (bytes, variant(&command)));
    let replies = replies().into_iter().map(|(reply, bytes)| (bytes, variant(&reply)));
    let refusals = refusals().into_iter().map(|(refusal, bytes)| (bytes, variant(&refusal)));
    let events = events().into_iter().map(|(event, bytes)| (bytes, variant(&event)));
    for (bytes, name) in commands.chain(replies).chain(refusals).chain(events) {
        check(usize::from_str_radix(&bytes[..2], 16).unwrap(), name);
    }
    assert!(document.contains(&format!("version {PROTOCOL_VERSION}")));
}

/// The vectors say what our own decoder reports.
#[test]
fn the_session_in_the_file_is_whole() {
    let mut decoder = Decoder::new();
    let mut seen = Vec::new();
    for line in batches() {
        let wire = line["wire"].as_str().unwrap();
        let bytes: Vec<u8> = wire.split(' ').map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect();
        decoder.push(&bytes, |decoded| {
            seen.push(match decoded {
                Decoded::Record { ticks, record: Record::Received(received) } => {
                    format!("{ticks} {}", received_reads(&received))
                }
                Decoded::Record { ticks, record: Record::Event(event) } => {
                    format!("{ticks} {}", event_reads(&event))
                }
                Decoded::BatchesLost { batches: 2, frames } => {
                    format!("lost on the link {} {}", frames[0], frames[1])
                }
                Decoded::Ended { ticks, reason: EndReason::Configured } => {
                    format!("{ticks} session ended: configured")
                }
                other => panic!("{other:?}"),
            });
        });
        let reads: Vec<&str> = line["reads"].as_array().unwrap().iter().filter_map(Value::as_str).collect();
        assert_eq!(seen, reads);
        seen.clear();
    }
}
