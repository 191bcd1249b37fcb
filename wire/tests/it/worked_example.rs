//! The worked example of `docs/wire-protocol.md`, byte for byte.

use cantap_wire::batch::BatchWriter;
use cantap_wire::framing::{self, CRC_LEN, MAX_ENCODED, MAX_MESSAGE};
use cantap_wire::record::{LossStage, MAX_RECORD, encode_event, encode_received};
use cantap_wire::{Channel, Command, Decoded, Decoder, Event, Received, Record, Request, Stamp};

/// The bytes of the code block after `heading` in the document.
fn documented(heading: &str) -> Vec<u8> {
    let document = include_str!("../../../docs/wire-protocol.md");
    let (_, after) = document.split_once(heading).unwrap_or_else(|| panic!("no heading {heading:?}"));
    let block = after.split("```").nth(1).unwrap_or_else(|| panic!("no block behind {heading:?}"));
    let lines = block.lines().skip(1).map(|line| line.split("  ").next().unwrap_or_default());
    lines.flat_map(str::split_whitespace).map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect()
}

#[test]
fn the_request_is_what_the_document_says() {
    let mut message = [0; MAX_MESSAGE + CRC_LEN];
    let request = Request { id: 1, command: Command::Hello { protocol: 7 } };
    let mut out = [0; MAX_ENCODED];
    let len = framing::encode(&request, &mut message, &mut out).unwrap();
    assert_eq!(out[..len], documented("### The request"), "{:02x?}", &out[..len]);
}

#[test]
fn the_batch_is_what_the_document_says() {
    let mut writer = BatchWriter::new();
    let mut record = [0; MAX_RECORD];
    let frame = "123#DEADBEEF".parse().unwrap();
    let received = Received { channel: Channel::Can1, frame, stamp: Stamp::Exact, data_omitted: false };
    let lost = Event::Lost { channel: Channel::Can2, stage: LossStage::Queue, count: 7, at_least: false };
    let len = encode_received(&received, 576, &mut record);
    assert!(writer.push(&record[..len], 12_000_000, Some(Channel::Can1)));
    let len = encode_event(&lost, 1200, &mut record);
    assert!(writer.push(&record[..len], 12_000_576, None));
    let mut out = [0; MAX_ENCODED];
    let len = writer.finish(&mut out);
    let documented = documented("### The batch");
    assert_eq!(out[..len], documented, "{:02x?}", &out[..len]);

    let mut decoded = Vec::new();
    Decoder::new().push(&documented, |event| match event {
        Decoded::Record { ticks, record } => decoded.push((ticks, record)),
        other => panic!("{other:?}"),
    });
    assert_eq!(decoded, [(12_000_576, Record::Received(received)), (12_001_776, Record::Event(lost))]);
}
