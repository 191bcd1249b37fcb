//! pcap, the older format of Wireshark and tcpdump, with SocketCAN packets, including captures of the "any"
//! interface.
//!
//! It can only be read: pcapng carries channels and losses, pcap does not.

use std::io;

use super::codec::Decode;
use super::found::Found;
use super::input::Input;
use super::interfaces::Interfaces;
use super::issue::{Fault, Place};
use super::seek;
use super::socketcan_packet::{Link, Packet, Packets};
use super::text::NS_PER_S;
use cantap_trace::TraceRecord;
use cantap_trace::counted;
use serde::{Deserialize, Serialize};

const MICROSECONDS: u32 = 0xA1B2_C3D4;
const NANOSECONDS: u32 = 0xA1B2_3C4D;

const FILE_HEAD_BYTES: usize = 24;
const PACKET_HEAD_BYTES: usize = 16;

/// Longest packet; programs truncate at a quarter of a megabyte.
const MAX_PACKET_BYTES: u32 = 1 << 18;

/// Whether a file begins like one of these.
pub(crate) fn is_head(head: &[u8]) -> bool {
    order(head).is_some()
}

/// Byte order, and nanoseconds per unit.
fn order(head: &[u8]) -> Option<(bool, i64)> {
    let magic: [u8; 4] = *head.first_chunk()?;
    [(true, u32::from_be_bytes(magic)), (false, u32::from_le_bytes(magic))].into_iter().find_map(
        |(big_endian, magic)| match magic {
            MICROSECONDS => Some((big_endian, 1000)),
            NANOSECONDS => Some((big_endian, 1)),
            _ => None,
        },
    )
}

/// Reads pcap.
#[derive(Default)]
pub(crate) struct Decoder {
    open: Option<Capture>,
    interfaces: Interfaces,
    packets: Packets,
}

/// The content of a file's header.
#[derive(Clone, Copy, Serialize, Deserialize)]
struct Capture {
    big_endian: bool,
    ns_per_unit: i64,
    link: Option<Link>,
    /// The seconds of the last packet, used to find the next one after damage.
    last_s: u32,
}

/// The header of a packet.
struct PacketHead {
    seconds: u32,
    units: u32,
    captured: u32,
    original: u32,
}

impl Capture {
    fn u32(self, bytes: &[u8], at: usize) -> u32 {
        let bytes = bytes.get(at..).and_then(|rest| rest.first_chunk()).copied().unwrap_or_default();
        if self.big_endian { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) }
    }

    fn head(self, bytes: &[u8]) -> PacketHead {
        let [seconds, units, captured, original] = [0, 4, 8, 12].map(|at| self.u32(bytes, at));
        PacketHead { seconds, units, captured, original }
    }

    /// Whether a packet's header is plausible.
    fn is_sane(self, head: &PacketHead) -> bool {
        i64::from(head.units) * self.ns_per_unit < NS_PER_S
            && head.captured <= head.original
            && head.captured <= MAX_PACKET_BYTES
    }

    /// Whether a CAN packet that follows the last one begins here.
    fn is_packet(self, bytes: &[u8]) -> bool {
        const S_PER_DAY: u32 = 86_400;
        const LONGEST: u32 = 128;
        let head = self.head(bytes);
        self.is_sane(&head)
            && (8..=LONGEST).contains(&head.captured)
            && head.original <= LONGEST
            && head.seconds.abs_diff(self.last_s) <= S_PER_DAY
    }
}

impl Decode for Decoder {
    fn needs_one_line(&self) -> bool {
        false
    }

    fn save(&self, state: &mut Vec<u8>) -> bool {
        self.packets.errors.is_over() && seek::save(&(self.open, &self.interfaces, self.packets.dirty), state)
    }

    fn restore(&mut self, state: &[u8]) -> Option<()> {
        (self.open, self.interfaces, self.packets.dirty) = seek::load(state)?;
        Some(())
    }

    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        if let Some(found) = self.packets.errors.next() {
            return Ok(found);
        }
        if self.open.is_none()
            && let Some(found) = self.begin(input)?
        {
            return Ok(found);
        }
        let Some(mut capture) = self.open else { return Ok(Found::End) };
        let place = Place::Offset(input.offset());
        let bytes = input.peek(PACKET_HEAD_BYTES)?;
        if bytes.is_empty() {
            return Ok(Found::End);
        }
        if bytes.len() < PACKET_HEAD_BYTES {
            let rest = bytes.len();
            input.consume(rest);
            return Ok(Found::Issue(place, Fault::Truncated("a packet")));
        }
        let head = capture.head(bytes);
        if !capture.is_sane(&head) {
            let found = format!("{} of {}", head.captured, counted(head.original, "byte"));
            resync(capture, input)?;
            return Ok(Found::Issue(place, Fault::malformed("a packet", found.as_bytes())));
        }
        let len = PACKET_HEAD_BYTES + head.captured as usize;
        let bytes = input.peek(len)?;
        let Some(packet) = bytes.get(PACKET_HEAD_BYTES..len) else {
            let rest = bytes.len();
            input.consume(rest);
            return Ok(Found::Issue(place, Fault::Truncated("a packet")));
        };
        let Some(link) = capture.link else {
            input.consume(len);
            return Ok(Found::LeftOut("packets that are not SocketCAN"));
        };
        let name = link.interface(packet).map(|number| format!("interface {number}: "));
        let channel = name.map_or(1, |name| self.interfaces.channel(name.as_bytes()));
        let time_ns = i64::from(head.seconds) * NS_PER_S + i64::from(head.units) * capture.ns_per_unit;
        let result = self.packets.read(link, packet, None);
        input.consume(len);
        capture.last_s = head.seconds;
        self.open = Some(capture);
        Ok(match result {
            Ok(Packet::Events(event, second)) => {
                let record = |event| TraceRecord { time_ns, device_ns: None, channel, event };
                self.packets.errors.keep(second.map(record));
                Found::Record(record(event))
            }
            Ok(Packet::LeftOut(what)) => Found::LeftOut(what),
            Err(fault) => Found::Issue(place, fault),
        })
    }
}

impl Decoder {
    /// Reads the file's header; returns what to report if there is none.
    fn begin(&mut self, input: &mut Input) -> io::Result<Option<Found>> {
        /// The bits with the link type; those above are for other purposes.
        const LINK: u32 = 0x0FFF_FFFF;
        let place = Place::Offset(input.offset());
        let head = input.peek(FILE_HEAD_BYTES)?;
        let len = head.len();
        let fault = match order(head) {
            Some((big_endian, ns_per_unit)) if len >= FILE_HEAD_BYTES => {
                let mut capture = Capture { big_endian, ns_per_unit, link: None, last_s: 0 };
                capture.link = Link::of(capture.u32(head, 20) & LINK, big_endian);
                input.consume(FILE_HEAD_BYTES);
                self.open = Some(capture);
                return Ok(None);
            }
            Some(_) => Fault::Truncated("the head of a pcap file"),
            None if len == 0 => return Ok(Some(Found::End)),
            None => Fault::malformed("a pcap file, which begins with a magic number", &head[..len.min(4)]),
        };
        // Nothing after a wrong header can be trusted.
        while !input.buffered().is_empty() {
            let rest = input.peek(1)?.len();
            input.consume(rest);
            input.peek(1)?;
        }
        Ok(Some(Found::Issue(place, fault)))
    }
}

/// Skips to what looks like a CAN packet, or to the end.
fn resync(capture: Capture, input: &mut Input) -> io::Result<()> {
    input.consume(1);
    loop {
        let bytes = input.peek(PACKET_HEAD_BYTES)?;
        if bytes.len() < PACKET_HEAD_BYTES {
            let rest = bytes.len();
            input.consume(rest);
            return Ok(());
        }
        let heads = bytes.windows(PACKET_HEAD_BYTES);
        let known = heads.len();
        let next = bytes.windows(PACKET_HEAD_BYTES).position(|bytes| capture.is_packet(bytes));
        input.consume(next.unwrap_or(known));
        if next.is_some() {
            return Ok(());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::Format;

    fn capture(magic: u32, link: u32, big_endian: bool, packets: &[Vec<u8>]) -> Vec<u8> {
        let word = |value: u32| if big_endian { value.to_be_bytes() } else { value.to_le_bytes() };
        let mut file = [magic, 0x0004_0002, 0, 0, 65535, link].map(word).concat();
        for (at, packet) in packets.iter().enumerate() {
            let len = packet.len() as u32;
            file.extend([1_410_714_882, 1000 + at as u32, len, len].map(word).concat());
            file.extend(packet);
        }
        file
    }

    fn as_log(file: &[u8]) -> (String, Vec<String>) {
        tests::as_log(Format::Pcap, file)
    }

    /// As tshark reads the same bytes.
    #[test]
    fn every_link_byte_order_and_resolution_is_read() {
        let data = [2, 0, 0, 0, 0x11, 0x22, 0, 0, 0, 0, 0, 0];
        let frame = |id: [u8; 4]| [&id[..], &data].concat();
        let plain = vec![frame([0, 0, 1, 0x23]), frame([0x98, 0xDA, 0xF1, 0x10])];
        let expected = "(1410714882.001000) can0 123#1122\n(1410714882.001001) can0 18DAF110#1122\n";
        for big_endian in [false, true] {
            assert_eq!(as_log(&capture(0xA1B2_C3D4, 227, big_endian, &plain)), (expected.into(), vec![]));
        }
        let (log, _) = as_log(&capture(0xA1B2_3C4D, 227, true, &plain));
        assert!(
            log.starts_with("(1410714882.000001000) can0") || log.starts_with("(1410714882.000001) can0"),
            "{log}"
        );
        let cooked = |kind: u8, protocol: u8, rest: &[u8]| {
            [&[0, kind, 1, 0x18, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, protocol], rest].concat()
        };
        let packets = vec![
            cooked(0, 12, &frame([0x23, 1, 0, 0])),
            cooked(4, 12, &frame([0x23, 1, 0, 0])),
            cooked(0, 13, &[&[0x23, 1, 0, 0, 2, 1, 0, 0, 0xAB, 0xCD][..], &[0; 62]].concat()),
            cooked(0, 8, &[0x45; 40]),
        ];
        let (log, issues) = as_log(&capture(0xA1B2_C3D4, 113, false, &packets));
        assert_eq!(
            log,
            "(1410714882.001000) can0 123#1122\n(1410714882.001001) can0 123#1122 T\n\
             (1410714882.001002) can0 123##1ABCD\n"
        );
        assert_eq!(issues, Vec::<String>::new());
        let cooked2 = |interface: u8| {
            let head = [0, 12, 0, 0, 0, 0, 0, interface, 1, 0x18, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
            [&head[..], &frame([0x23, 1, 0, 0])].concat()
        };
        let (log, _) = as_log(&capture(0xA1B2_C3D4, 276, false, &[cooked2(3), cooked2(7), cooked2(3)]));
        assert_eq!(
            log,
            "(1410714882.001000) can0 123#1122\n(1410714882.001001) can1 123#1122\n(1410714882.001002) can0 123#1122\n"
        );
    }

    #[test]
    fn damage_costs_a_packet_and_a_cut_file_gives_everything_before() {
        let packets: Vec<_> =
            (0..100).map(|at| vec![0, 0, 1, 0x23, 8, 0, 0, 0, at, 2, 3, 4, 5, 6, 7, 8]).collect();
        let whole = capture(0xA1B2_C3D4, 227, false, &packets);
        let (log, issues) = as_log(&whole[..whole.len() - 3]);
        assert_eq!((log.lines().count(), issues.len()), (99, 1), "{issues:?}");
        let mut damaged = whole.clone();
        damaged[24 + 50 * 32 + 8..][..4].fill(0xFF);
        let (log, issues) = as_log(&damaged);
        assert_eq!((log.lines().count(), issues.len()), (99, 1), "{issues:?}");
    }
}
