//! The other end of a cannelloni tunnel.

use std::net::UdpSocket;

use cantap::Channel;

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
