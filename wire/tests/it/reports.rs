//! What the decoder reports of answers, of other versions, and of headers that say that something is missing.

use cantap_wire::batch::BatchWriter;
use cantap_wire::framing::{CRC_LEN, MAX_ENCODED, MAX_MESSAGE, encode};
use cantap_wire::message::{
    BatchHeader, DeviceMessage, EndReason, Hello, Reply, Response, SessionEnd, capability,
};
use cantap_wire::record::{MAX_RECORD, encode_event};
use cantap_wire::{Channel, Decoded, Decoder, Event, PROTOCOL_VERSION, Refusal};

/// A message as it crosses the wire.
fn sent(message: &DeviceMessage) -> Vec<u8> {
    let (mut buffer, mut out) = ([0; MAX_MESSAGE + CRC_LEN], [0; MAX_ENCODED]);
    let len = encode(message, &mut buffer, &mut out).unwrap();
    out[..len].to_vec()
}

fn header(sequence: u32, frames_before: [u32; 2]) -> Vec<u8> {
    sent(&DeviceMessage::Batch(BatchHeader { sequence, base_ticks: 0, frames_before }))
}

fn hello(protocol: u16, capabilities: u32) -> Hello {
    let (board, serial) = ("board".try_into().unwrap(), "1".try_into().unwrap());
    Hello {
        protocol,
        firmware: [0, 1, 0],
        board,
        serial,
        channels: 2,
        tick_hz: 12_000_000,
        can_clock_hz: 36_000_000,
        queue_bytes: 1,
        tx_queue: 1,
        periodic_slots: 1,
        trigger_slots: 1,
        filter_banks: 1,
        capabilities,
    }
}

fn answer(result: Result<Reply, Refusal>) -> Vec<u8> {
    sent(&DeviceMessage::Response(Response { id: 7, result }))
}

fn reports(decoder: &mut Decoder, bytes: &[u8]) -> Vec<String> {
    let mut all = Vec::new();
    decoder.push(bytes, |decoded| {
        all.push(match decoded {
            Decoded::Response(response) => format!("answer to {}", response.id),
            decoded => format!("{decoded:?}"),
        });
    });
    all
}

#[test]
fn an_answer_is_reported_and_one_to_hello_begins_a_session() {
    let mut decoder = Decoder::new();
    assert_eq!(reports(&mut decoder, &header(5, [9, 0])), ["BatchesLost { batches: 5, frames: [9, 0] }"]);
    assert_eq!(reports(&mut decoder, &answer(Err(Refusal::BadId))), ["answer to 7"]);
    // Nothing has changed by it: an older batch is not of this session.
    assert_eq!(reports(&mut decoder, &header(0, [0, 0])), ["Corrupt(OutOfOrder { sequence: 0 })"]);
    assert_eq!(reports(&mut decoder, &answer(Ok(Reply::Hello(hello(PROTOCOL_VERSION, 0))))), ["answer to 7"]);
    assert_eq!(reports(&mut decoder, &header(0, [0, 0])), [""; 0]);
}

#[test]
fn a_device_of_another_version_is_reported_by_its_version() {
    let other = PROTOCOL_VERSION + 1;
    for result in [Ok(Reply::Hello(hello(other, 0))), Err(Refusal::Protocol { device: other })] {
        assert_eq!(reports(&mut Decoder::new(), &answer(result)), [format!("OtherProtocol({other})")]);
    }
    // A later version may have put anything behind it.
    let (mut buffer, mut out) = ([0; 64], [0; 128]);
    for (message, what) in [
        ((1_u8, 7_u16, 0_u8, 0_u8, other, [0xFF_u8; 9]), format!("OtherProtocol({other})")),
        ((1, 7, 1, 0, other, [0xFF; 9]), format!("OtherProtocol({other})")),
        // Not an answer; neither a value nor a refusal; another answer; our own version.
        ((3, 7, 0, 0, other, [0xFF; 9]), "Corrupt(Unknown)".to_owned()),
        ((1, 7, 2, 0, other, [0xFF; 9]), "Corrupt(Unknown)".to_owned()),
        ((1, 7, 0, 99, other, [0xFF; 9]), "Corrupt(Unknown)".to_owned()),
        ((1, 7, 0, 0, PROTOCOL_VERSION, [0xFF; 9]), "Corrupt(Unknown)".to_owned()),
    ] {
        let len = encode(&message, &mut buffer, &mut out).unwrap();
        assert_eq!(reports(&mut Decoder::new(), &out[..len]), [what], "{message:?}");
    }
}

#[test]
fn a_header_says_what_is_missing_even_if_only_one_of_its_numbers_does() {
    let after = |first: Vec<u8>, second: Vec<u8>| {
        let mut decoder = Decoder::new();
        reports(&mut decoder, &first);
        reports(&mut decoder, &second)
    };
    // A batch of which no frame is missing: it had only events, or was lost in part.
    let lost =
        |batches, frames: [u32; 2]| vec![format!("BatchesLost {{ batches: {batches}, frames: {frames:?} }}")];
    assert_eq!(after(header(0, [0, 0]), header(2, [0, 0])), lost(1, [0, 0]));
    assert_eq!(after(header(0, [0, 0]), header(1, [0, 3])), lost(0, [0, 3]));
    assert_eq!(after(header(0, [0, 0]), header(1, [0, 0])), [""; 0]);
    // Counters wrap; half of their range is ahead.
    assert_eq!(
        after(header(0, [0, 0]), header(0x8000_0000, [0x7FFF_FFFF, 0])),
        lost(0x7FFF_FFFF, [0x7FFF_FFFF, 0])
    );
    let back = |sequence| vec![format!("Corrupt(OutOfOrder {{ sequence: {sequence} }})")];
    assert_eq!(after(header(0, [0, 0]), header(0x8000_0001, [0, 0])), back(0x8000_0001_u32));
    assert_eq!(after(header(0, [5, 5]), header(1, [5, 4])), back(1));
    assert_eq!(after(header(3, [5, 5]), header(3, [5, 5])), ["Corrupt(Repeated { sequence: 3 })"]);
}

#[test]
fn bytes_without_an_end_are_too_long_in_one_piece_and_in_several() {
    let long = [&[1; MAX_ENCODED + 1][..], &[0]].concat();
    for piece in [1, 100, MAX_ENCODED, MAX_ENCODED + 1, MAX_ENCODED + 2] {
        let mut decoder = Decoder::new();
        let all: Vec<String> = long.chunks(piece).flat_map(|bytes| reports(&mut decoder, bytes)).collect();
        assert_eq!(all, ["Corrupt(TooLong)"], "{piece}");
        assert_eq!(reports(&mut decoder, &answer(Err(Refusal::BadId))), ["answer to 7"]);
    }
}

#[test]
fn a_writer_starts_again_at_the_first_batch_without_what_was_unfinished() {
    let mut record = [0; MAX_RECORD];
    let len = encode_event(&Event::Started { channel: Channel::Can1 }, 0, &mut record);
    let mut writer = BatchWriter::new();
    let mut out = [0; MAX_ENCODED];
    assert!(writer.is_empty() && writer.finish(&mut out) == 0);
    assert!(writer.append(&record[..len], 0, [1, 2]) && !writer.is_empty() && writer.finish(&mut out) > 0);
    assert!(writer.is_empty() && writer.append(&record[..len], 0, [1, 2]));
    writer.restart();
    assert!(writer.is_empty() && writer.finish(&mut out) == 0);
    assert!(writer.push(&record[..len], 0, None));
    let len = writer.finish(&mut out);
    assert_eq!(
        reports(&mut Decoder::new(), &out[..len]),
        ["Record { ticks: 0, record: Event(Started { channel: Can1 }) }"]
    );
}

#[test]
fn records_fill_a_batch_to_its_last_byte() {
    let mut writer = BatchWriter::new();
    let room = writer.room();
    assert!(!writer.push(&vec![0; room + 1], 0, None) && writer.push(&vec![0; room], 0, None));
    let rest = writer.room();
    assert!(
        !writer.push(&vec![0; rest + 1], 0, None)
            && writer.push(&vec![0; rest], 0, None)
            && writer.room() == 0
    );
    let mut out = [0; MAX_ENCODED];
    assert!(writer.finish(&mut out[..MAX_ENCODED - 1]) == 0 && writer.finish(&mut out) > 0);
}

#[test]
fn the_end_of_a_session_is_no_batch() {
    let header = BatchHeader { sequence: 0, base_ticks: 99, frames_before: [0, 0] };
    let ended = sent(&DeviceMessage::Ended(SessionEnd { reason: EndReason::Configured, header }));
    assert_eq!(reports(&mut Decoder::new(), &ended), ["Ended { ticks: 99, reason: Configured }"]);
}

#[test]
fn what_a_device_can_do_is_in_its_bits() {
    let all = u32::MAX;
    for (bit, yes, no) in [
        (capability::FD_TRANSMIT, all, all ^ capability::FD_TRANSMIT),
        (capability::DISTURB, all, all ^ capability::DISTURB),
    ] {
        let has = |capabilities| {
            let hello = hello(PROTOCOL_VERSION, capabilities);
            if bit == capability::DISTURB { hello.disturbs() } else { hello.sends_fd() }
        };
        assert!(has(yes) && has(bit) && !has(no) && !has(0));
    }
    let counts = |capabilities| hello(PROTOCOL_VERSION, capabilities).counts_losses();
    assert!(
        counts(0)
            && counts(all ^ capability::UNCOUNTED_LOSSES)
            && !counts(capability::UNCOUNTED_LOSSES)
            && !counts(all)
    );
}
