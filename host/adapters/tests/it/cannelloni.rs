//! The other end of a cannelloni tunnel.

use std::net::UdpSocket;

use cantap::transmit::Stream;
use cantap::wire::Refusal;
use cantap::wire::message::TxFdFrame;
use cantap::{Channel, DeviceError, TraceFrame};
use cantap_adapters::{OpenError, Place};

use crate::{frames, losses, open, send, until_frame};

/// A datagram with this number, this count and these frames.
fn datagram(sequence: u8, count: u16, frames: &[(u32, &[u8])]) -> Vec<u8> {
    let mut bytes = vec![2, 0, sequence];
    bytes.extend_from_slice(&count.to_be_bytes());
    for (id, data) in frames {
        bytes.extend_from_slice(&id.to_be_bytes());
        bytes.push(data.len() as u8);
        bytes.extend_from_slice(data);
    }
    bytes
}

#[test]
fn datagrams_that_are_missing_cut_or_strange_are_losses_or_counted() {
    let peer = UdpSocket::bind("127.0.0.1:0").unwrap();
    // The port of a socket that is closed again is free.
    let listen = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let device = open(&format!("cannelloni://{}?listen={listen}", peer.local_addr().unwrap()));
    device.join(Channel::Can1, 500_000).unwrap();
    let here = ("127.0.0.1", listen);
    for bytes in [
        datagram(250, 2, &[(0x123, &[0xAA]), (0x8000_0001, &[])]),
        // Two are missing.
        datagram(253, 1, &[(0x124, &[1; 8])]),
        // Four frames are announced, and one is there.
        datagram(254, 4, &[(0x125, &[])]),
        // A length that no frame has, a CAN FD frame, and one of a length that CAN FD has no code for.
        datagram(255, 1, &[(0x126, &[0; 9])]),
        [
            &datagram(0, 2, &[])[..],
            &[0, 0, 1, 0x27, 0x8C, 1],
            &[0xEE; 12],
            &[0, 0, 1, 0x28, 0x89, 0],
            &[0; 9],
        ]
        .concat(),
        // Of another version, and too short.
        vec![1, 0, 1, 0, 0],
        vec![2],
        datagram(1, 1, &[(0x7FF, &[])]),
    ] {
        peer.send_to(&bytes, here).unwrap();
    }
    let records = until_frame(&device, "7FF#");
    let fd = format!("127##1{}", "EE".repeat(12));
    assert_eq!(frames(&records), ["123#AA", "00000001#", "124#0101010101010101", "125#", &fd, "7FF#"]);
    assert_eq!(losses(&records), [("link", 2), ("link", 3), ("link", 1), ("link", 1)]);
    assert_eq!(send(&device, "1ABCDEF0#11").result.unwrap().to_string(), "1ABCDEF0#11");
    let mut bytes = [0; 64];
    let (len, _) = peer.recv_from(&mut bytes).unwrap();
    assert_eq!(bytes[..len], [2, 0, 0, 0, 1, 0x9A, 0xBC, 0xDE, 0xF0, 1, 0x11]);
}

/// Frames of both kinds leave in the order in which they were given, each as what it is, and come back as confirmed.
#[test]
fn fd_frames_are_sent_in_order_with_classical_ones() {
    let peer = UdpSocket::bind("127.0.0.1:0").unwrap();
    let listen = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let device = open(&format!("cannelloni://{}?listen={listen}", peer.local_addr().unwrap()));
    assert!(device.hello().sends_fd());
    device.join(Channel::Can1, 500_000).unwrap();
    let long = format!("18DAF110##1{}", "A5".repeat(64));
    let texts =
        ["123##1", "123#11", "123##2112233445566778899AABBCC", &long, "123#R4", "123#0102030405060708"];
    let mut stream = Stream::new(&device);
    for text in texts {
        let frame: TraceFrame = text.parse().unwrap();
        assert!(stream.push(Channel::Can1, frame, None, |_| true).unwrap().is_some());
    }
    assert!(stream.finish(|_| true).unwrap());
    let ends = stream.take_ended();
    assert_eq!(ends.iter().map(|end| end.result.unwrap().to_string()).collect::<Vec<_>>(), texts);
    let records = until_frame(&device, texts[5]);
    assert_eq!(frames(&records), texts);
    let mut bytes = [0; 100];
    let mut received = |want: &[u8]| {
        let (len, _) = peer.recv_from(&mut bytes).unwrap();
        assert_eq!(&bytes[5..len], want);
    };
    received(&[0, 0, 1, 0x23, 0x80, 1]);
    received(&[0, 0, 1, 0x23, 1, 0x11]);
    received(
        &[
            &[0, 0, 1, 0x23, 0x8C, 2][..],
            &[0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88, 0x99, 0xAA, 0xBB, 0xCC],
        ]
        .concat(),
    );
    received(&[&[0x98, 0xDA, 0xF1, 0x10, 0xC0, 1][..], &[0xA5; 64]].concat());
    received(&[0x40, 0, 1, 0x23, 4]);
    received(&[0, 0, 1, 0x23, 8, 1, 2, 3, 4, 5, 6, 7, 8]);
}

/// What only listens sends nothing, and a frame of CAN FD waits for its time as others do.
#[test]
fn an_fd_frame_needs_a_channel_that_sends_and_has_its_time() {
    let peer = UdpSocket::bind("127.0.0.1:0").unwrap();
    let listen = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let device = open(&format!("cannelloni://{}?listen={listen}", peer.local_addr().unwrap()));
    let frame: TraceFrame = "123##1AA".parse().unwrap();
    let send = |at_ticks| {
        device.send_fd(Channel::Can1, &[TxFdFrame { tag: 1, frame: *frame.fd().unwrap(), at_ticks }])
    };
    let refusal = |at| match send(at) {
        Err(DeviceError::Refused { refusal }) => refusal,
        other => panic!("{other:?}"),
    };
    assert_eq!(refusal(None), Refusal::ChannelClosed);
    device.listen(Channel::Can1, 500_000).unwrap();
    assert_eq!(refusal(None), Refusal::ListenOnly);
    device.close_channel(Channel::Can1).unwrap();
    device.join(Channel::Can1, 500_000).unwrap();
    let ends = device.transmissions();
    let due = device.time().unwrap() + u64::from(device.hello().tick_hz) / 5;
    send(Some(due)).unwrap();
    assert!(ends.recv().unwrap().ticks >= due);
    // Far ahead: it is taken back.
    send(Some(due + u64::from(device.hello().tick_hz) * 3600)).unwrap();
    device.abort(Channel::Can1).unwrap();
    assert!(ends.recv().unwrap().result.is_err());
    assert_eq!(refusal(Some(u64::MAX)), Refusal::TooFarAhead);
}

/// A port that another program has is not a host that cannot be reached.
#[test]
fn a_port_that_is_taken_here_is_named_with_what_to_do() {
    let taken = UdpSocket::bind("0.0.0.0:0").unwrap();
    let place: Place =
        format!("cannelloni://127.0.0.1:9?listen={}", taken.local_addr().unwrap().port()).parse().unwrap();
    let error = cantap_adapters::open(&place).err().unwrap();
    assert!(matches!(error, OpenError::Channel { .. }), "{error}");
    assert!(
        error.to_string().contains("another program has UDP port") && error.to_string().contains("?listen="),
        "{error}"
    );
}

#[test]
fn the_other_end_may_have_an_address_of_ipv6() {
    let Ok(peer) = UdpSocket::bind("[::1]:0") else {
        println!("not tested: this computer has no IPv6");
        return;
    };
    let listen = UdpSocket::bind("[::1]:0").unwrap().local_addr().unwrap().port();
    let device = open(&format!("cannelloni://{}?listen={listen}", peer.local_addr().unwrap()));
    device.join(Channel::Can1, 500_000).unwrap();
    peer.send_to(&datagram(0, 1, &[(0x123, &[0xAA])]), ("::1", listen)).unwrap();
    assert_eq!(frames(&until_frame(&device, "123#AA")), ["123#AA"]);
    send(&device, "7FF#").result.unwrap();
    assert!(peer.recv(&mut [0; 64]).is_ok());
}

/// Datagrams of no bytes and of very many, counts that lie, and an other end that goes and begins anew.
#[test]
fn babbling_and_new_beginnings_lose_nothing_that_is_known_and_invent_nothing() {
    let peer = UdpSocket::bind("127.0.0.1:0").unwrap();
    let at = peer.local_addr().unwrap();
    let listen = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let device = open(&format!("cannelloni://{at}?listen={listen}"));
    device.join(Channel::Can1, 500_000).unwrap();
    let here = ("127.0.0.1", listen);
    peer.send_to(&datagram(199, 1, &[(0x100, &[])]), here).unwrap();
    for bytes in [vec![], vec![0; 4000], vec![0xFF; 4000], vec![2, 0], datagram(200, 0, &[])] {
        peer.send_to(&bytes, here).unwrap();
    }
    // All the frames that a datagram can announce, and one.
    peer.send_to(&datagram(201, u16::MAX, &[(0x101, &[1])]), here).unwrap();
    peer.send_to(&datagram(202, 1, &[(0x102, &[])]), here).unwrap();
    let records = until_frame(&device, "102#");
    assert_eq!(frames(&records), ["100#", "101#01", "102#"]);
    assert_eq!(losses(&records), [("link", u32::from(u16::MAX) - 1)]);
    // It is gone: what is sent is handed over to nobody, and the session goes on.
    drop(peer);
    for _ in 0..3 {
        send(&device, "7FF#").result.unwrap();
    }
    let peer = UdpSocket::bind(at).unwrap();
    peer.send_to(&datagram(0, 1, &[(0x103, &[])]), here).unwrap();
    let records = until_frame(&device, "103#");
    assert!(frames(&records).ends_with(&["103#".to_owned()]), "{:?}", frames(&records));
    // Not the 53 datagrams that its first number might be taken for.
    assert_eq!(losses(&records), [("link", 0)]);
    let failures = device.failures().unwrap().last;
    for kind in ["datagrams that are too short", "of another version", "new beginnings"] {
        assert!(failures.contains(kind), "{failures}");
    }
}

/// Numbers of eight bits cannot say how many datagrams a long outage took, but that there was one is never left out.
#[test]
fn an_outage_that_the_numbers_cannot_count_is_a_loss_of_unknown_size() {
    for missing in [1, 127, 128, 200, 239, 240, 255] {
        let peer = UdpSocket::bind("127.0.0.1:0").unwrap();
        let listen = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let device = open(&format!("cannelloni://{}?listen={listen}", peer.local_addr().unwrap()));
        device.join(Channel::Can1, 500_000).unwrap();
        let send = |number: u8, data: u8| {
            peer.send_to(&datagram(number, 1, &[(0x100, &[data])]), ("127.0.0.1", listen)).unwrap();
        };
        for number in 100..120 {
            send(number, number);
        }
        send(120_u8.wrapping_add(missing), 0xEE);
        send(121_u8.wrapping_add(missing), 0xFF);
        let records = until_frame(&device, "100#FF");
        assert_eq!(frames(&records).len(), 22, "{missing}");
        let lost = if missing < 128 { missing.into() } else { 0 };
        assert_eq!(losses(&records), [("link", lost)], "{missing}");
    }
}
