//! Container PDUs: frames that say themselves which messages are in them.
//!
//! In front of each contained PDU stands a header with its identifier and its length. So the places of its signals count from its own
//! first byte, and which of them a frame carries shows only when it is there.

use super::layout::ByteOrder;

/// The part of a frame that contained PDUs stand in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Container {
    /// Its first byte in the frame.
    pub at: u16,
    /// How many bytes it has at most.
    pub length: u16,
    /// What stands in front of each contained PDU.
    pub header: ContainerHeader,
    /// The order of the header's bytes.
    pub order: ByteOrder,
    /// The PDUs that it may contain, in the file's order.
    pub pdus: Vec<ContainedPdu>,
}

/// The form of a header in a container.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ContainerHeader {
    /// An identifier of three bytes, a length of one.
    Short,
    /// An identifier of four bytes, a length of four.
    Long,
}

/// A PDU that a container may contain.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ContainedPdu {
    /// The identifier in its header.
    pub header_id: u32,
    /// Its name.
    pub name: String,
    /// What it is for; may be empty.
    pub description: String,
    /// Its length in bytes.
    pub length: u16,
    /// How often it is sent, in milliseconds, if that is known.
    pub cycle_ms: Option<u32>,
}

/// Which contained PDU a signal is in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InPdu {
    /// Its index in [`Container::pdus`].
    pub place: usize,
    /// Its name.
    pub name: String,
}

/// A contained PDU in a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Part<'a> {
    /// The identifier in its header.
    pub header_id: u32,
    /// Its index in [`Container::pdus`]; `None` if the database does not have it.
    pub pdu: Option<usize>,
    /// Its bytes, as far as the frame has them.
    pub data: &'a [u8],
    /// Whether its header says that there are more.
    pub is_cut: bool,
}

impl ContainerHeader {
    /// Bytes of identifier and length.
    const fn bytes(self) -> (usize, usize) {
        match self {
            Self::Short => (3, 1),
            Self::Long => (4, 4),
        }
    }
}

impl Container {
    /// The PDUs that a frame's data contains, in their order.
    pub fn parts<'a>(&'a self, data: &'a [u8]) -> impl Iterator<Item = Part<'a>> + Clone {
        let end = data.len().min(usize::from(self.at) + usize::from(self.length));
        let mut rest = data.get(usize::from(self.at)..end).unwrap_or_default();
        std::iter::from_fn(move || {
            let (part, behind) = self.first(rest)?;
            rest = behind;
            Some(part)
        })
    }

    fn first<'a>(&self, rest: &'a [u8]) -> Option<(Part<'a>, &'a [u8])> {
        let (id_bytes, length_bytes) = self.header.bytes();
        let (header, body) = rest.split_at_checked(id_bytes + length_bytes)?;
        let (id, length) = header.split_at(id_bytes);
        let join = |value: u32, byte: &u8| value << 8 | u32::from(*byte);
        let number = |bytes: &[u8]| match self.order {
            ByteOrder::Big => bytes.iter().fold(0, join),
            ByteOrder::Little => bytes.iter().rev().fold(0, join),
        };
        let (header_id, length) = (number(id), number(length) as usize);
        let pdu = self.pdus.iter().position(|pdu| pdu.header_id == header_id);
        // CAN FD has frames of 8, 12, 16… bytes: what a container does not need of them is filled with equal bytes.
        if pdu.is_none() && rest.iter().all(|byte| *byte == rest[0]) {
            return None;
        }
        let (data, behind) = body.split_at(length.min(body.len()));
        Some((Part { header_id, pdu, data, is_cut: length > body.len() }, behind))
    }
}

/// What of frames' containers is in no value.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NotDecoded {
    /// PDUs that the database does not have.
    pub unknown: u64,
    /// PDUs that stand in the same frame once more, behind them: the last one counts.
    pub repeated: u64,
    /// PDUs of which the frame has fewer bytes than their header says.
    pub cut: u64,
}

impl NotDecoded {
    /// Counts what a frame's data has of these.
    pub(super) fn add(&mut self, container: &Container, data: &[u8]) {
        let mut parts = container.parts(data);
        while let Some(part) = parts.next() {
            self.cut += u64::from(part.is_cut);
            match part.pdu {
                None => self.unknown += 1,
                Some(_) => self.repeated += u64::from(parts.clone().any(|later| later.pdu == part.pdu)),
            }
        }
    }

    /// Descriptions with their counts, of those that there are.
    pub fn iter(self) -> impl Iterator<Item = (&'static str, u64)> {
        let kinds = [
            ("contained PDUs that the databases do not have", self.unknown),
            ("contained PDUs that came again in the same frame", self.repeated),
            ("contained PDUs that their frame cuts short", self.cut),
        ];
        kinds.into_iter().filter(|(_, count)| *count > 0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn container(header: ContainerHeader, order: ByteOrder) -> Container {
        let pdu = |header_id, name: &str| ContainedPdu {
            header_id,
            name: name.to_owned(),
            description: String::new(),
            length: 2,
            cycle_ms: None,
        };
        Container {
            at: 1,
            length: 20,
            header,
            order,
            pdus: vec![pdu(0x0001_0203, "A"), pdu(0x00AA_AAAA, "B")],
        }
    }

    fn parts(container: &Container, data: &[u8]) -> Vec<(u32, Option<usize>, Vec<u8>, bool)> {
        let parts = container.parts(data);
        parts.map(|part| (part.header_id, part.pdu, part.data.to_vec(), part.is_cut)).collect()
    }

    #[test]
    fn headers_of_either_form_and_order_say_what_follows() {
        let (short, long) = (ContainerHeader::Short, ContainerHeader::Long);
        let expected = vec![(0x0001_0203, Some(0), vec![7, 8], false), (0x0001_0204, None, vec![9], false)];
        for (header, order, data) in [
            (short, ByteOrder::Big, &[99, 1, 2, 3, 2, 7, 8, 1, 2, 4, 1, 9, 0][..]),
            (short, ByteOrder::Little, &[99, 3, 2, 1, 2, 7, 8, 4, 2, 1, 1, 9, 0]),
            (long, ByteOrder::Big, &[99, 0, 1, 2, 3, 0, 0, 0, 2, 7, 8, 0, 1, 2, 4, 0, 0, 0, 1, 9, 0]),
            (long, ByteOrder::Little, &[99, 3, 2, 1, 0, 2, 0, 0, 0, 7, 8, 4, 2, 1, 0, 1, 0, 0, 0, 9, 0]),
        ] {
            assert_eq!(parts(&container(header, order), data), expected, "{header:?} {order:?}");
        }
    }

    #[test]
    fn padding_is_no_pdu_and_what_the_frame_cuts_is_told() {
        let container = container(ContainerHeader::Short, ByteOrder::Big);
        for padding in [0, 0x55, 0xCC, 0xFF] {
            let data = [99, 1, 2, 3, 2, 7, 8, padding, padding, padding, padding, padding];
            assert_eq!(parts(&container, &data).len(), 1, "{padding:#x}");
        }
        // Equal bytes that the database has a name for.
        assert_eq!(parts(&container, &[99, 0xAA, 0xAA, 0xAA, 0xAA]), [(0x00AA_AAAA, Some(1), vec![], true)]);
        assert_eq!(parts(&container, &[99, 1, 2, 3, 2, 7]), [(0x0001_0203, Some(0), vec![7], true)]);
        // Behind the container's own bytes is something else.
        let mut long = vec![99, 9, 9, 9, 16];
        long.extend([0; 16]);
        long.extend([1, 2, 3, 0]);
        assert_eq!(parts(&container, &long), [(0x0009_0909, None, vec![0; 16], false)]);
        assert!(parts(&container, &[]).is_empty() && parts(&container, &[1, 2, 3]).is_empty());
        let mut counts = NotDecoded::default();
        counts.add(&container, &[99, 1, 2, 3, 0, 9, 9, 9, 0, 1, 2, 3, 5, 1]);
        assert_eq!(counts, NotDecoded { unknown: 1, repeated: 1, cut: 1 });
        assert_eq!(counts.iter().count(), 3);
    }
}
