//! The bytes of every variant. A change here is a change of the protocol: it touches the version, the
//! documentation and the changelog too.

use crate::samples;

use cantap_wire::Channel::{Can1, Can2};
use cantap_wire::batch::BatchHeader;
use cantap_wire::framing::MAX_REQUEST;
use cantap_wire::message::{
    Checksum, DeviceMessage, EndReason, Filter, FrameKind, MAX_FILTERS, MAX_SEND, MAX_SEND_FD, Mode,
    SessionEnd, TxFdFrame, TxFrame, read_send, why_unreadable, write_response,
};
use cantap_wire::record::{
    MAX_FD_RECORD, MAX_RECORD, encode_event, encode_received, encode_received_fd, encode_transmitted_fd,
};
use cantap_wire::{
    Command, FdFrame, Id, PROTOCOL_VERSION, Received, ReceivedFd, Refusal, Reply, Request, Response, Stamp,
    TransmittedFd,
};
use samples::{commands, events, frame, hex, refusals, replies};
use serde::Serialize;

fn bytes(value: &impl Serialize) -> String {
    let mut out = [0; 600];
    hex(postcard::to_slice(value, &mut out).unwrap())
}

fn written(result: &Result<Reply, Refusal>) -> String {
    let mut out = [0; 600];
    let len = write_response(5, result, &mut out).unwrap();
    hex(&out[..len])
}

#[test]
fn the_version_is_the_one_that_these_bytes_belong_to() {
    assert_eq!(PROTOCOL_VERSION, 7);
}

#[test]
fn received_frames() {
    let record = |text: &str, channel, stamp, data_omitted, ticks| {
        let mut out = [0; MAX_RECORD];
        let received = Received { channel, frame: frame(text), stamp, data_omitted };
        let len = encode_received(&received, ticks, &mut out);
        hex(&out[..len])
    };
    assert_eq!(record("555#", Can1, Stamp::Exact, false, 576), "80 55 05 80 09");
    assert_eq!(record("555#R2", Can2, Stamp::Exact, false, -1), "d2 55 05 01");
    assert_eq!(record("123#DEADBEEF", Can2, Stamp::Exact, false, 0), "c4 23 01 00 de ad be ef");
    assert_eq!(
        record("1F334455#11", Can1, Stamp::Exact, false, i64::from(i32::MAX)),
        "a1 55 44 33 1f fe ff ff ff 0f 11"
    );
    // Two wraps of a 32-bit timer: differences are not bounded.
    assert_eq!(record("1F334455#11", Can1, Stamp::Exact, false, 2 << 32), "a1 55 44 33 1f 80 80 80 80 40 11");
    assert_eq!(record("555#", Can1, Stamp::Exact, false, i64::MIN), "80 55 05 ff ff ff ff ff ff ff ff ff 01");
    assert_eq!(record("1F334455#11", Can1, Stamp::UpperBound, false, 64), "41 a1 55 44 33 1f 80 01 11");
    assert_eq!(record("123#1122", Can1, Stamp::Omitted, false, 64), "42 82 23 01 11 22");
    assert_eq!(record("123#1122", Can1, Stamp::Exact, true, 1), "44 82 23 01 02");
    assert_eq!(record("123#1122", Can1, Stamp::UpperBound, true, 1), "45 82 23 01 02");
    assert_eq!(record("123#1122", Can1, Stamp::Omitted, true, 1), "46 82 23 01");
    assert_eq!(record("123#1122334455667788_F", Can1, Stamp::Omitted, true, 1), "46 8f 23 01");
}

#[test]
fn received_fd_frames() {
    let record = |id, (brs, esi), data: &[u8], channel, stamp, data_omitted, ticks| {
        let mut out = [0; MAX_FD_RECORD];
        let frame = FdFrame::new(id, brs, esi, data).unwrap();
        let len = encode_received_fd(&ReceivedFd { channel, frame, stamp, data_omitted }, ticks, &mut out);
        hex(&out[..len])
    };
    let (short, long) = (Id::standard(0x123).unwrap(), Id::extended(0x1F33_4455).unwrap());
    let (exact, bound) = (Stamp::Exact, Stamp::UpperBound);
    assert_eq!(record(short, (false, false), &[], Can1, exact, false, 576), "60 80 23 01 80 09");
    assert_eq!(record(short, (true, false), &[1, 2], Can2, bound, false, 64), "69 c2 23 01 80 01 01 02");
    assert_eq!(record(long, (false, true), &[7; 12], Can1, exact, true, 1), "74 a9 55 44 33 1f 02");
    assert_eq!(record(long, (true, true), &[0xAA], Can1, Stamp::Omitted, false, 1), "7a a1 55 44 33 1f aa");
    let whole = record(short, (true, false), &[0x11; 64], Can1, exact, false, 1);
    assert_eq!(whole, format!("68 8f 23 01 02{}", " 11".repeat(64)));
}

#[test]
fn confirmations_of_fd_frames() {
    let record = |id, (brs, esi), data: &[u8], channel, tag, ticks| {
        let mut out = [0; MAX_FD_RECORD];
        let frame = FdFrame::new(id, brs, esi, data).unwrap();
        let len = encode_transmitted_fd(&TransmittedFd { channel, tag, frame }, ticks, &mut out);
        hex(&out[..len])
    };
    let (short, long) = (Id::standard(0x123).unwrap(), Id::extended(0x1F33_4455).unwrap());
    assert_eq!(record(short, (false, false), &[], Can1, 1, 576), "50 80 23 01 01 80 09");
    assert_eq!(record(short, (true, false), &[1, 2], Can2, 300, 64), "51 c2 23 01 ac 02 80 01 01 02");
    let tail = " 11".repeat(64);
    assert_eq!(record(long, (true, true), &[0x11; 64], Can1, 0, 1), format!("53 af 55 44 33 1f 00 02{tail}"));
}

#[test]
fn every_event() {
    for (event, expected) in events() {
        let mut out = [0; MAX_RECORD];
        let len = encode_event(&event, 576, &mut out);
        assert_eq!(hex(&out[..len]), format!("{expected} 80 09"), "{event:?}");
    }
}

#[test]
fn every_command() {
    for (command, expected) in commands() {
        assert_eq!(
            bytes(&Request { id: 300, command: command.clone() }),
            format!("ac 02 {expected}"),
            "{command:?}"
        );
    }
    assert_eq!(bytes(&Checksum::Crc8J1850), "02");
    assert_eq!(bytes(&[FrameKind::Data, FrameKind::Remote, FrameKind::Any]), "00 01 02");
    assert_eq!(bytes(&[Mode::ListenOnly, Mode::Normal, Mode::Loopback, Mode::SilentLoopback]), "00 01 02 03");
}

#[test]
fn every_reply() {
    for (reply, expected) in replies() {
        let message = DeviceMessage::Response(Response { id: 5, result: Ok(reply.clone()) });
        assert_eq!(bytes(&message), format!("01 05 00 {expected}"), "{message:?}");
        assert_eq!(written(&Ok(reply)), format!("01 05 00 {expected}"), "{message:?}");
    }
}

#[test]
fn every_refusal() {
    for (refusal, expected) in refusals() {
        let message = DeviceMessage::Response(Response { id: 5, result: Err(refusal) });
        assert_eq!(bytes(&message), format!("01 05 01 {expected}"), "{message:?}");
        assert_eq!(written(&Err(refusal)), format!("01 05 01 {expected}"), "{message:?}");
    }
}

#[test]
fn batch_headers_and_the_end_of_a_session() {
    let header = BatchHeader { sequence: 300, base_ticks: 1 << 32, frames_before: [128, 1] };
    assert_eq!(bytes(&DeviceMessage::Batch(header)), "00 ac 02 80 80 80 80 10 80 01 01");
    let end = SessionEnd { reason: EndReason::Suspended, header };
    assert_eq!(bytes(&DeviceMessage::Ended(end)), "02 00 ac 02 80 80 80 80 10 80 01 01");
    for (reason, expected) in
        [(EndReason::BoardLost, "01"), (EndReason::ServerEnded, "02"), (EndReason::Configured, "03")]
    {
        let bytes = bytes(&DeviceMessage::Ended(SessionEnd { reason, header }));
        assert_eq!(bytes, format!("02 {expected} ac 02 80 80 80 80 10 80 01 01"));
    }
}

/// What a device reads by hand must be what the whole type reads.
#[test]
fn frames_to_be_sent_are_read_as_the_request_has_them_and_no_other_request_is() {
    let tx = |tag: u32| TxFrame {
        tag,
        frame: frame(if tag.is_multiple_of(2) { "1F334455#R8_F" } else { "123#DEADBEEF" }),
        at_ticks: tag.is_multiple_of(3).then_some(u64::MAX - u64::from(tag)),
    };
    let read = |request: &[u8]| {
        let mut frames = heapless::Vec::new();
        read_send(request, &mut frames).map(|(id, channel)| (id, channel, frames))
    };
    let encoded = |id, command| {
        let mut out = [0; MAX_REQUEST];
        postcard::to_slice(&Request { id, command }, &mut out).unwrap().to_vec()
    };
    for count in 0..=MAX_SEND as u32 {
        let frames: heapless::Vec<_, MAX_SEND> = (0..count).map(|n| tx(n * 1000)).collect();
        let request = encoded(300, Command::Send { channel: Can2, frames: frames.clone() });
        assert_eq!(read(&request), Some((300, Can2, frames)));
        for cut in 0..request.len() {
            assert_eq!(read(&request[..cut]), None, "{cut} bytes of {count} frames");
        }
    }
    let too_many = MAX_SEND + 1;
    let one_more = [&[5, 6, 0, too_many as u8][..], &[1, 1, 0, 0, 0].repeat(too_many)].concat();
    assert_eq!(read(&one_more), None);
    assert_eq!(read(&encoded(5, Command::Close { channel: Can1 })), None);
}

/// Requests, byte by byte, of a client that does not respect the ranges.
#[test]
fn a_frame_that_cannot_be_is_refused_by_its_fault_and_all_else_as_malformed() {
    let refusal = |text: &str| {
        let request: Vec<u8> = text.split(' ').map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect();
        assert!(postcard::from_bytes::<Request>(&request).is_err(), "{text} is a good request");
        why_unreadable(&request)
    };
    for (text, expected) in [
        // Send: a good frame and one with the standard identifier 800.
        ("05 06 00 02 01 a3 02 01 01 11 00 02 80 10 00 00 00", Refusal::BadId),
        // DLC 16, and two bytes of data for DLC 1.
        ("05 06 00 01 01 a3 02 10 08 01 02 03 04 05 06 07 08 00", Refusal::BadDlc),
        ("05 06 00 01 01 a3 02 01 02 01 02 00", Refusal::BadDlc),
        ("05 08 00 00 01 80 10 00 00 ac 02 00 00", Refusal::BadId),
        ("05 08 00 00 01 a3 02 10 00 ac 02 00 00", Refusal::BadDlc),
        ("05 09 00 00 01 00 02 01 01 80 10 00 00 00", Refusal::BadId),
        // A third channel, a command that does not exist, one that is cut off, and an empty request.
        ("05 06 02 00", Refusal::Malformed),
        ("05 7f", Refusal::Malformed),
        ("05 06 00 01 01", Refusal::Malformed),
        ("05", Refusal::Malformed),
    ] {
        assert_eq!(refusal(text), expected, "{text}");
    }
}

/// Every possible request fits into what a device can hold.
#[test]
fn the_longest_request_fits() {
    let filter = Filter { extended: true, kind: FrameKind::Any, id: 0x1FFF_FFFF, mask: 0x1FFF_FFFF };
    let filters = [filter; MAX_FILTERS].into_iter().collect();
    let request = Request { id: u16::MAX, command: Command::SetFilters { channel: Can2, filters } };
    assert!(postcard::to_slice(&request, &mut [0; MAX_REQUEST]).is_ok());
    let frame = FdFrame::new(Id::extended(Id::MAX_EXTENDED).unwrap(), true, true, &[0xFF; 64]).unwrap();
    let frames =
        [TxFdFrame { tag: u32::MAX, frame, at_ticks: Some(u64::MAX) }; MAX_SEND_FD].into_iter().collect();
    let request = Request { id: u16::MAX, command: Command::SendFd { channel: Can2, frames } };
    assert!(postcard::to_slice(&request, &mut [0; MAX_REQUEST]).is_ok());
}
