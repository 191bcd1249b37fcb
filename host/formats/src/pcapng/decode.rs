//! Reading pcapng.

use std::io;

use super::super::bit_rates::{self, BitRates};
use super::super::codec::Decode;
use super::super::found::Found;
use super::super::input::{Input, MAX_ITEM_BYTES};
use super::super::interfaces::Interfaces;
use super::super::issue::{Fault, Place};
use super::super::seek;
use super::super::socketcan_packet::{Link, Packet, Packets};
use super::super::text::NS_PER_S;
use super::{
    BLOCK_FRAME_BYTES, BYTE_ORDER_MAGIC, COMMENT, CUSTOM, CUSTOM_NOT_COPIED, DEVICE_NS_MAGIC, DIRECTION, END,
    ENHANCED_PACKET, EPB_DEVICE_NS, EPB_DROPCOUNT, EPB_FLAGS, IF_NAME, IF_SPEED, IF_TSOFFSET, IF_TSRESOL,
    INTERFACE_DESCRIPTION, LATE, NAME_RESOLUTION, OBSOLETE_PACKET, OUTBOUND, SECRETS, SECTION_HEADER,
    SIMPLE_PACKET, STATISTICS,
};
use cantap_trace::counted;
use cantap_trace::{DeviceNs, Direction, TraceEvent, TraceRecord};
use serde::{Deserialize, Serialize};

/// Longest block of a trace; far longer than a CAN packet.
const MAX_BLOCK_BYTES: usize = MAX_ITEM_BYTES;
/// Longest block of a packet of CAN: such a packet, and a comment of the greatest length. What claims more is damaged, and from a pipe nothing
/// so long may ever come.
const MAX_CAN_BLOCK_BYTES: usize = (1 << 16) + 4096;
/// Interfaces beyond this number are damage, not channels.
const MAX_INTERFACES: usize = 4096;

/// Reads pcapng.
#[derive(Default)]
pub(crate) struct Decoder {
    big_endian: bool,
    started: bool,
    interfaces: Vec<Interface>,
    names: Interfaces,
    /// For captures of the "any" interface: the interfaces that the packets name.
    cooked: Interfaces,
    packets: Packets,
    bit_rates: BitRates,
}

/// The content of an interface description.
#[derive(Clone, Copy, Serialize, Deserialize)]
struct Interface {
    /// `None` if it does not carry CAN.
    link: Option<Link>,
    channel: u8,
    /// Units per second.
    resolution: u64,
    offset_s: i64,
}

/// A block's fields in its byte order.
#[derive(Clone, Copy)]
struct Fields<'a> {
    bytes: &'a [u8],
    big_endian: bool,
}

impl<'a> Fields<'a> {
    fn array<const N: usize>(self, at: usize) -> Option<[u8; N]> {
        self.bytes.get(at..)?.first_chunk().copied()
    }

    #[inline]
    fn u16(self, at: usize) -> Option<u16> {
        let bytes = self.array(at)?;
        Some(if self.big_endian { u16::from_be_bytes(bytes) } else { u16::from_le_bytes(bytes) })
    }

    #[inline]
    fn u32(self, at: usize) -> Option<u32> {
        let bytes = self.array(at)?;
        Some(if self.big_endian { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) })
    }

    fn u64(self, at: usize) -> Option<u64> {
        let bytes = self.array(at)?;
        Some(if self.big_endian { u64::from_be_bytes(bytes) } else { u64::from_le_bytes(bytes) })
    }

    /// Where the list of codes and values from `at` on ends (options and names are such lists); `None` if it is
    /// not one.
    fn end_of_list(self, mut at: usize) -> Option<usize> {
        while at < self.bytes.len() {
            let (code, len) = (self.u16(at)?, usize::from(self.u16(at + 2)?));
            at += 4 + len.next_multiple_of(4);
            if code == END {
                return Some(at);
            }
        }
        Some(at)
    }

    /// Whether a block without a packet has valid content: its kind may be damaged.
    fn is_filled(self, kind: u32) -> bool {
        let options = match kind {
            INTERFACE_DESCRIPTION => Some(8),
            STATISTICS => Some(12),
            NAME_RESOLUTION => self.end_of_list(0),
            SECRETS => self.u32(4).map(|len| 8 + (len as usize).next_multiple_of(4)),
            _ => return true,
        };
        options.and_then(|at| self.end_of_list(at)) == Some(self.bytes.len())
    }

    /// The options from `at` on: code and value.
    fn options(self, mut at: usize) -> impl Iterator<Item = (u16, Fields<'a>)> {
        std::iter::from_fn(move || {
            let (code, len) = (self.u16(at)?, usize::from(self.u16(at + 2)?));
            let bytes = self.bytes.get(at + 4..at + 4 + len)?;
            at += 4 + len.next_multiple_of(4);
            (code != END).then_some((code, Fields { bytes, ..self }))
        })
    }
}

impl Decode for Decoder {
    fn needs_one_line(&self) -> bool {
        false
    }

    fn bit_rates(&self) -> &[(u8, u32)] {
        &self.bit_rates
    }

    fn save(&self, state: &mut Vec<u8>) -> bool {
        /// With more interfaces reading begins nowhere else: each place has them all.
        const MOST_INTERFACES: usize = 256;
        let Self { big_endian, started, interfaces, names, cooked, packets, bit_rates } = self;
        packets.errors.is_over()
            && interfaces.len() <= MOST_INTERFACES
            && seek::save(&(big_endian, started, interfaces, names, cooked, packets.dirty, bit_rates), state)
    }

    fn restore(&mut self, state: &[u8]) -> Option<()> {
        let Self { big_endian, started, interfaces, names, cooked, packets, bit_rates } = self;
        (*big_endian, *started, *interfaces, *names, *cooked, packets.dirty, *bit_rates) = seek::load(state)?;
        Some(())
    }

    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        if let Some(found) = self.packets.errors.next() {
            return Ok(found);
        }
        loop {
            let place = Place::Offset(input.offset());
            let head = input.peek(BLOCK_FRAME_BYTES)?;
            if head.is_empty() {
                return Ok(Found::End);
            }
            let have = head.len();
            let Some(first) = head.first_chunk::<BLOCK_FRAME_BYTES>().copied() else {
                input.consume(have);
                return Ok(Found::Issue(place, Fault::Truncated("a block")));
            };
            if !self.byte_order(first) {
                self.skip_to_section(input)?;
                let fault =
                    Fault::malformed("a pcapng file, which begins with a section header", &first[..4]);
                return Ok(Found::Issue(place, fault));
            }
            let fields = Fields { bytes: &first, big_endian: self.big_endian };
            let (kind, len) = (fields.u32(0).unwrap_or(0), fields.u32(4).unwrap_or(0) as usize);
            let most = if self.is_packet_of_can(fields) { MAX_CAN_BLOCK_BYTES } else { MAX_BLOCK_BYTES };
            let sane = (BLOCK_FRAME_BYTES..=most).contains(&len) && len.is_multiple_of(4);
            if sane {
                let block = input.peek(len)?;
                let have = block.len();
                if have < len && !self.looks_cut(block) {
                    self.resync(input)?;
                    return Ok(Found::Issue(place, damaged(len)));
                }
                if have < len {
                    input.consume(have);
                    return Ok(Found::Issue(place, Fault::Truncated("a block")));
                }
                let big_endian = self.big_endian;
                let fields = Fields { bytes: &block[8..len - 4], big_endian };
                let behind = Fields { bytes: &block[len - 4..len], big_endian };
                if behind.u32(0) == Some(len as u32) {
                    let result = self.block(kind, fields);
                    input.consume(len);
                    match result {
                        Ok(Some(found)) => return Ok(found),
                        Ok(None) => continue,
                        Err(fault) => return Ok(Found::Issue(place, fault)),
                    }
                }
            }
            self.resync(input)?;
            return Ok(Found::Issue(place, damaged(len)));
        }
    }
}

fn damaged(len: usize) -> Fault {
    Fault::malformed("a block with the same length at both ends", format!("a length of {len}").as_bytes())
}

fn not_filled() -> Fault {
    Fault::malformed("a block whose options end where it does", b"another end; a packet may have been in it")
}

impl Decoder {
    /// Takes the byte order from a section header. False if the file does not begin with one.
    fn byte_order(&mut self, head: [u8; BLOCK_FRAME_BYTES]) -> bool {
        if head[..4] != SECTION_HEADER.to_le_bytes() {
            return self.started;
        }
        let magic = &head[8..];
        if magic == BYTE_ORDER_MAGIC.to_be_bytes() {
            self.big_endian = true;
        } else if magic == BYTE_ORDER_MAGIC.to_le_bytes() {
            self.big_endian = false;
        } else {
            return self.started;
        }
        self.started = true;
        true
    }

    /// Skips to a section header, or to the end: nothing before one can be understood.
    fn skip_to_section(&mut self, input: &mut Input) -> io::Result<()> {
        loop {
            input.consume(4);
            match input.peek(BLOCK_FRAME_BYTES)?.first_chunk().copied() {
                Some(head) if self.byte_order(head) => return Ok(()),
                Some(_) => {}
                None => {
                    let rest = input.buffered().len();
                    input.consume(rest);
                    return Ok(());
                }
            }
        }
    }

    /// Whether the file's last bytes can be the beginning of a block, or a damaged length points beyond the
    /// end.
    fn looks_cut(&self, rest: &[u8]) -> bool {
        (1..rest.len() / 4).all(|word| !self.is_block(&rest[4 * word..]))
    }

    /// Whether a packet's block begins here, of an interface that carries CAN.
    fn is_packet_of_can(&self, head: Fields) -> bool {
        let interface = || self.interfaces.get(head.u32(8)? as usize)?.link;
        head.u32(0) == Some(ENHANCED_PACKET) && interface().is_some()
    }

    /// Whether a whole, known block begins here.
    fn is_block(&self, bytes: &[u8]) -> bool {
        let fields = Fields { bytes, big_endian: self.big_endian };
        self.length_of_known(bytes).is_some_and(|len| fields.u32(len - 4) == Some(len as u32))
    }

    /// How long the block is that begins here, if it is of a known kind and can be a packet's.
    fn length_of_known(&self, bytes: &[u8]) -> Option<usize> {
        let fields = Fields { bytes, big_endian: self.big_endian };
        let known = matches!(
            fields.u32(0),
            Some(SECTION_HEADER | INTERFACE_DESCRIPTION | ENHANCED_PACKET | STATISTICS)
        );
        let len = fields.u32(4)? as usize;
        (known && (BLOCK_FRAME_BYTES..=4096).contains(&len)).then_some(len)
    }

    /// Skips to the next whole block, or to the end. A block that is not there to its end is not waited for while a later one is whole:
    /// four bytes of a frame can look like the head of a block, and what has come through a pipe may be all there is for a while.
    fn resync(&self, input: &mut Input) -> io::Result<()> {
        input.consume(4);
        loop {
            let bytes = input.buffered();
            let rests = || (0..bytes.len()).step_by(4).map(|at| (at, &bytes[at..]));
            if let Some((at, _)) = rests().find(|(_, rest)| self.is_block(rest)) {
                input.consume(at);
                return Ok(());
            }
            let is_open = |rest: &[u8]| {
                rest.len() < BLOCK_FRAME_BYTES
                    || self.length_of_known(rest).is_some_and(|len| rest.len() < len)
            };
            let open = rests().find(|(_, rest)| is_open(rest)).map_or(bytes.len(), |(at, _)| at);
            input.consume(open);
            let have = input.buffered().len();
            if input.peek(have + 1)?.len() == have {
                input.consume(have);
                return Ok(());
            }
        }
    }

    #[inline]
    fn block(&mut self, kind: u32, fields: Fields) -> Result<Option<Found>, Fault> {
        let short = || Fault::malformed("a longer block", counted(fields.bytes.len(), "byte").as_bytes());
        match kind {
            SECTION_HEADER => {
                self.interfaces.clear();
                Ok(None)
            }
            INTERFACE_DESCRIPTION => {
                self.describe(fields).ok_or_else(short)?;
                if fields.is_filled(kind) { Ok(None) } else { Err(not_filled()) }
            }
            ENHANCED_PACKET | OBSOLETE_PACKET => {
                let interface = match kind {
                    ENHANCED_PACKET => fields.u32(0).ok_or_else(short)?,
                    _ => u32::from(fields.u16(0).ok_or_else(short)?),
                };
                let high = fields.u32(4).ok_or_else(short)?;
                let low = fields.u32(8).ok_or_else(short)?;
                let len = fields.u32(12).ok_or_else(short)? as usize;
                let packet = fields.bytes.get(20..).and_then(|rest| rest.get(..len)).ok_or_else(short)?;
                let options = 20 + len.next_multiple_of(4);
                let known = self.interfaces.get(interface as usize).copied();
                let interface = known.ok_or_else(|| {
                    Fault::malformed("a described interface", interface.to_string().as_bytes())
                })?;
                let time_ns = interface.time_ns(u64::from(high) << 32 | u64::from(low));
                self.packet(interface, time_ns, packet, fields, options).map(Some)
            }
            // It has no time.
            SIMPLE_PACKET => Err(Fault::Unsupported("a packet without a time".into())),
            NAME_RESOLUTION | STATISTICS | SECRETS | CUSTOM | CUSTOM_NOT_COPIED => {
                if fields.is_filled(kind) {
                    Ok(None)
                } else {
                    Err(not_filled())
                }
            }
            // It could have contained a packet.
            _ => Ok(Some(Found::LeftOut("blocks of kinds that are not known"))),
        }
    }

    fn describe(&mut self, fields: Fields) -> Option<()> {
        let link_type = fields.u16(0)?;
        fields.u32(4)?;
        if self.interfaces.len() >= MAX_INTERFACES {
            return Some(());
        }
        let mut name = format!("can{}", self.interfaces.len()).into_bytes();
        let (mut resolution, mut offset_s, mut bit_rate) = (1_000_000, 0, None);
        for (code, value) in fields.options(8) {
            match code {
                IF_NAME if !value.bytes.is_empty() => name = value.bytes.to_vec(),
                IF_TSRESOL => {
                    let exponent = value.bytes.first().copied().unwrap_or(6);
                    let base: u64 = if exponent & 0x80 != 0 { 2 } else { 10 };
                    resolution = base.checked_pow(u32::from(exponent & 0x7F)).unwrap_or(u64::MAX);
                }
                IF_TSOFFSET => offset_s = value.u64(0).unwrap_or(0).cast_signed(),
                IF_SPEED => bit_rate = value.u64(0).and_then(|speed| u32::try_from(speed).ok()),
                _ => {}
            }
        }
        let channel = self.names.channel(&name);
        if let Some(bit_rate) = bit_rate {
            bit_rates::learn(&mut self.bit_rates, channel, bit_rate);
        }
        let link = Link::of(u32::from(link_type), self.big_endian);
        self.interfaces.push(Interface { link, channel, resolution, offset_s });
        Some(())
    }

    /// A packet and its options.
    #[inline]
    fn packet(
        &mut self,
        interface: Interface,
        time_ns: i64,
        packet: &[u8],
        fields: Fields,
        options: usize,
    ) -> Result<Found, Fault> {
        let Some(link) = interface.link else {
            return Ok(Found::LeftOut("packets that are not SocketCAN"));
        };
        let (mut flags, mut dropped, mut is_late, mut device_ns) = (0, 0, false, None);
        for (code, value) in fields.options(options) {
            match code {
                EPB_FLAGS => flags = value.u32(0).unwrap_or(0),
                EPB_DROPCOUNT => dropped = value.u64(0).unwrap_or(0),
                EPB_DEVICE_NS if value.bytes.len() == 12 && value.bytes.starts_with(&DEVICE_NS_MAGIC) => {
                    device_ns = value.u64(4).and_then(DeviceNs::new);
                }
                COMMENT => is_late |= value.bytes == LATE.as_bytes(),
                _ => {}
            }
        }
        let named = link.interface(packet).map(|number| format!("interface {number}: "));
        let channel = named.map_or(interface.channel, |name| self.cooked.channel(name.as_bytes()));
        let record = |event| TraceRecord { time_ns, device_ns, channel, event };
        let count = u32::try_from(dropped).unwrap_or(u32::MAX);
        let lost = record(TraceEvent::Lost { stage: None, count, at_least: u64::from(count) < dropped });
        match self.packets.read(link, packet, direction(flags)) {
            Ok(Packet::Events(mut event, second)) => {
                if let TraceEvent::Frame { late, .. } = &mut event {
                    *late = is_late;
                }
                // Our own error frame for a loss has the same count and contains more.
                if dropped > 0 && !matches!(event, TraceEvent::Lost { .. }) {
                    self.packets.errors.keep([event].into_iter().chain(second).map(record));
                    return Ok(Found::Record(lost));
                }
                self.packets.errors.keep(second.map(record));
                Ok(Found::Record(record(event)))
            }
            Ok(Packet::LeftOut(what)) => {
                self.packets.errors.keep((dropped > 0).then_some(lost));
                Ok(Found::LeftOut(what))
            }
            Err(fault) => {
                self.packets.errors.keep((dropped > 0).then_some(lost));
                Err(fault)
            }
        }
    }
}

/// The direction in the flags of a packet's block.
fn direction(flags: u32) -> Option<Direction> {
    const INBOUND: u32 = 1;
    match flags & DIRECTION {
        OUTBOUND => Some(Direction::Tx),
        INBOUND => Some(Direction::Rx),
        _ => None,
    }
}

impl Interface {
    /// A packet's time as nanoseconds since the epoch.
    #[inline]
    fn time_ns(&self, units: u64) -> i64 {
        let ns_per_s = i128::from(NS_PER_S);
        let ns = if self.resolution == NS_PER_S as u64 {
            // Ours: times before 1970 wrap.
            i128::from(units.cast_signed())
        } else {
            i128::from(units) * ns_per_s / i128::from(self.resolution)
        };
        let ns = ns + i128::from(self.offset_s) * ns_per_s;
        i64::try_from(ns).unwrap_or(if ns < 0 { i64::MIN } else { i64::MAX })
    }
}
