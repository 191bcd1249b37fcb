//! pcapng with SocketCAN packets (link type 227), as Wireshark and tcpdump write and read them.
//!
//! The few blocks that matter are read and written here and not by the `pcap-file` crate: a file may grow
//! while it is read, reading must go on behind a damaged block, and times may lie before 1970. Each
//! channel is an interface `can0`, `can1`…; what is not a frame is an error frame as SocketCAN has
//! them, and a loss also a drop count.

mod decode;
mod encode;

pub(crate) use decode::Decoder;
pub(crate) use encode::Encoder;

/// Type of the block that begins a file, the same in both byte orders.
pub(crate) const SECTION_HEADER: u32 = 0x0A0D_0D0A;
const INTERFACE_DESCRIPTION: u32 = 1;
const OBSOLETE_PACKET: u32 = 2;
const SIMPLE_PACKET: u32 = 3;
const ENHANCED_PACKET: u32 = 6;

/// How a section header shows its byte order.
const BYTE_ORDER_MAGIC: u32 = 0x1A2B_3C4D;

/// A block's type and length in front, and its length again behind.
const BLOCK_FRAME_BYTES: usize = 12;

// Options.
const END: u16 = 0;
const IF_NAME: u16 = 2;
const IF_TSRESOL: u16 = 9;
const IF_TSOFFSET: u16 = 14;
const EPB_FLAGS: u16 = 2;
const EPB_DROPCOUNT: u16 = 4;
const SHB_USERAPPL: u16 = 4;

/// The direction's bits in a packet's flags, and the value for a sent packet.
const DIRECTION: u32 = 3;
const OUTBOUND: u32 = 2;

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::{Format, WriteOptions};
    use cantap_trace::testing::{data_record, record_or_fd};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn any_trace_round_trips(records in prop::collection::vec(record_or_fd(1), 0..20)) {
            prop_assert_eq!(tests::round_trip(Format::Pcapng, &records), records);
        }
    }

    #[test]
    fn damage_costs_a_packet_and_a_cut_file_gives_everything_before() {
        let records: Vec<_> = (0..100).map(data_record).collect();
        let options = WriteOptions { format: Some(Format::Pcapng), ..WriteOptions::default() };
        let (whole, _) = tests::write_with(&options, &records);
        let (read, issues) = tests::read(Format::Pcapng, &whole[..whole.len() - 10]);
        assert_eq!((read.len(), issues.len()), (99, 1));
        assert!(issues[0].contains("ends inside a block"), "{issues:?}");
        let mut damaged = whole.clone();
        let block = whole.len() - 50 * 48;
        damaged[block + 4..block + 8].copy_from_slice(&[0xFF; 4]);
        let (read, issues) = tests::read(Format::Pcapng, &damaged);
        assert_eq!((read.len(), issues.len()), (99, 1), "{issues:?}");
    }

    /// A section in the other byte order with microseconds, as a router might write it.
    #[test]
    fn both_byte_orders_and_any_resolution_are_read() {
        let mut file = Vec::new();
        let mut block = |kind: u32, body: &[u8]| {
            let len = (body.len() as u32 + 12).to_be_bytes();
            file.extend([&kind.to_be_bytes()[..], &len, body, &len].concat());
        };
        block(0x0A0D_0D0A, &[&0x1A2B_3C4D_u32.to_be_bytes()[..], &[0, 1, 0, 0], &[0xFF; 8]].concat());
        block(1, &[0, 227, 0, 0, 0, 0, 0, 0]);
        let packet = [0x80, 0, 1, 0x23, 2, 0, 0, 0, 0xAB, 0xCD];
        let head = [0_u32, 0, 1_500_000, 10, 10].map(u32::to_be_bytes).concat();
        block(6, &[&head[..], &packet, &[0, 0]].concat());
        // Four lost, then a sent CAN FD frame.
        let fd = [0, 0, 1, 0x23, 2, 4, 0, 0, 0xAB, 0xCD, 0, 0];
        let options = [0, 2, 0, 4, 0, 0, 0, 2, 0, 4, 0, 8, 0, 0, 0, 0, 0, 0, 0, 4, 0, 0, 0, 0];
        block(6, &[&head[..], &fd, &options].concat());
        // And four more, then an error frame that says two things: error-passive, by a stuff error.
        let error = [0x20, 0, 0, 0x8C, 8, 0, 0, 0, 0, 0x20, 4, 0, 0, 0, 0, 0];
        let head = [0_u32, 0, 1_500_000, 16, 16].map(u32::to_be_bytes).concat();
        block(6, &[&head[..], &error, &options].concat());
        let (records, issues) = tests::read(Format::Pcapng, &file);
        assert_eq!(
            tests::write(Format::Candump, &records),
            "(1.500000) can0 00000123#ABCD\n(1.500000) can0 20000084#0001040000000000\n\
             (1.500000) can0 123##0ABCD T\n\
             (1.500000) can0 20000084#0001040000000000\n(1.500000) can0 20000084#0030000000000000\n\
             (1.500000) can0 20000088#0000040000000000\n"
        );
        assert_eq!(issues, Vec::<String>::new());
    }
}
