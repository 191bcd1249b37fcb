//! A session that the device ends: frames lost before the end are counted, and an older message does not end it
//! again.

use cantap_wire::batch::BatchWriter;
use cantap_wire::framing::MAX_ENCODED;
use cantap_wire::message::EndReason;
use cantap_wire::record::{MAX_RECORD, encode_received};
use cantap_wire::{Channel, Corruption, Decoded, Decoder, Received, Stamp};

/// A batch of one frame on CAN2.
fn batch(writer: &mut BatchWriter) -> Vec<u8> {
    let frame = "123#00".parse().unwrap();
    let received = Received { channel: Channel::Can2, frame, stamp: Stamp::Exact, data_omitted: false };
    let mut record = [0; MAX_RECORD];
    let len = encode_received(&received, 1, &mut record);
    assert!(writer.push(&record[..len], 1000, Some(Channel::Can2)));
    let mut out = [0; MAX_ENCODED];
    let len = writer.finish(&mut out);
    out[..len].to_vec()
}

fn end(writer: &mut BatchWriter) -> Vec<u8> {
    let mut out = [0; MAX_ENCODED];
    let len = writer.end(EndReason::Suspended, 1234, &mut out);
    out[..len].to_vec()
}

fn reports(decoder: &mut Decoder, bytes: &[u8]) -> Vec<String> {
    let mut all = Vec::new();
    decoder.push(bytes, |decoded| {
        if !matches!(decoded, Decoded::Record { .. }) {
            all.push(format!("{decoded:?}"));
        }
    });
    all
}

#[test]
fn the_end_counts_what_went_missing_before_it() {
    let mut writer = BatchWriter::new();
    let mut decoder = Decoder::new();
    let first = batch(&mut writer);
    let _lost = [batch(&mut writer), batch(&mut writer)];
    let stream = [first, end(&mut writer)].concat();
    assert_eq!(
        reports(&mut decoder, &stream),
        ["BatchesLost { batches: 2, frames: [0, 2] }", "Ended { ticks: 1234, reason: Suspended }"]
    );
}

#[test]
fn an_end_older_than_the_session_does_not_end_it() {
    let mut writer = BatchWriter::new();
    let old = end(&mut writer);
    let mut decoder = Decoder::new();
    let stream = [batch(&mut writer), old].concat();
    let corruption = Corruption::OutOfOrder { sequence: 0 };
    assert_eq!(reports(&mut decoder, &stream), [format!("{:?}", Decoded::Corrupt(corruption))]);
}
