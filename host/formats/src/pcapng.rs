//! pcapng with SocketCAN packets (link type 227), as Wireshark and tcpdump write and read them.
//!
//! The few blocks that matter are read and written here rather than by the `pcap-file` crate: a file may grow while it is read, reading
//! must continue after a damaged block, and times may be before 1970. Each channel is an interface `can0`, `can1`…; everything that is
//! not a frame is an error frame as in SocketCAN. A loss is also a drop count and a comment, and the totals received and lost on a
//! channel are in statistics blocks: at the end, and regularly for anyone who reads meanwhile.

mod decode;
mod encode;

pub(crate) use decode::Decoder;
pub(crate) use encode::Encoder;

/// Type of the block that begins a file, the same in both byte orders.
pub(crate) const SECTION_HEADER: u32 = 0x0A0D_0D0A;
const INTERFACE_DESCRIPTION: u32 = 1;
const OBSOLETE_PACKET: u32 = 2;
const SIMPLE_PACKET: u32 = 3;
const NAME_RESOLUTION: u32 = 4;
const STATISTICS: u32 = 5;
const ENHANCED_PACKET: u32 = 6;
const SECRETS: u32 = 0xA;
/// Blocks that programs add for themselves; the second kind must not be copied to other files.
const CUSTOM: u32 = 0xBAD;
const CUSTOM_NOT_COPIED: u32 = 0x4000_0BAD;

/// How a section header shows its byte order.
const BYTE_ORDER_MAGIC: u32 = 0x1A2B_3C4D;

/// A block's type and length at its beginning, and its length again at its end.
const BLOCK_FRAME_BYTES: usize = 12;

// Options.
const END: u16 = 0;
const COMMENT: u16 = 1;
const IF_NAME: u16 = 2;
const IF_DESCRIPTION: u16 = 3;
const IF_SPEED: u16 = 8;
const IF_TSRESOL: u16 = 9;
const IF_TSOFFSET: u16 = 14;
const EPB_FLAGS: u16 = 2;
const EPB_DROPCOUNT: u16 = 4;
/// Of a packet: the device's own time. Codes with the highest bit are for each program's own use, and are passed over by all others; so that it is
/// not another program's, the value begins with [`DEVICE_NS_MAGIC`], and then has the nanoseconds in eight bytes.
const EPB_DEVICE_NS: u16 = 0x8CA7;
const DEVICE_NS_MAGIC: [u8; 4] = *b"ctns";
const ISB_IFRECV: u16 = 4;
const ISB_IFDROP: u16 = 5;
const ISB_USRDELIV: u16 = 8;
const SHB_USERAPPL: u16 = 4;

/// The comment that marks a frame whose time is only an upper bound.
const LATE: &str = "the time is only an upper bound";

/// The direction's bits in a packet's flags, and the value for a sent packet.
const DIRECTION: u32 = 3;
const OUTBOUND: u32 = 2;

#[cfg(test)]
mod tests {
    use std::io::{self, Write};
    use std::sync::{Arc, Mutex};
    use std::time::Duration;

    use super::super::tests;
    use super::{ISB_IFDROP, ISB_IFRECV, ISB_USRDELIV, STATISTICS};
    use crate::{ChannelInfo, Format, ReadOptions, TraceReader, WriteOptions, create_stream_writer};
    use cantap_can::LossStage;
    use cantap_trace::testing::{data_record, record_or_fd, with_device_time};
    use cantap_trace::{Direction, TraceEvent, TraceRecord};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn any_trace_round_trips(
            records in prop::collection::vec(with_device_time(record_or_fd(1)), 0..20),
        ) {
            prop_assert_eq!(tests::round_trip(Format::Pcapng, &records), records);
        }
    }

    #[test]
    fn damage_costs_a_packet_and_a_cut_file_gives_everything_before() {
        let records: Vec<_> = (0..100).map(data_record).collect();
        let options = WriteOptions { format: Some(Format::Pcapng), ..WriteOptions::default() };
        let (whole, _) = tests::write_with(&options, &records);
        let (read, issues) = tests::read(Format::Pcapng, &whole[..whole.len() - 10]);
        assert_eq!((read.len(), issues.len()), (100, 1));
        assert!(issues[0].contains("ends inside a block"), "{issues:?}");
        let (read, issues) = tests::read(Format::Pcapng, &whole[..whole.len() - 64 - 10]);
        assert_eq!((read.len(), issues.len()), (99, 1));
        let mut damaged = whole.clone();
        // The statistics of one channel follow the packets.
        let block = whole.len() - 64 - 50 * 48;
        damaged[block + 4..block + 8].copy_from_slice(&[0xFF; 4]);
        let (read, issues) = tests::read(Format::Pcapng, &damaged);
        assert_eq!((read.len(), issues.len()), (99, 1), "{issues:?}");
    }

    /// Found by random files: how many issues there were depended on how much was read at a time.
    #[test]
    fn a_damaged_beginning_is_one_issue_and_the_next_section_is_read() {
        let records: Vec<_> = (0..20_000).map(data_record).collect();
        let options = WriteOptions { format: Some(Format::Pcapng), ..WriteOptions::default() };
        let (mut file, _) = tests::write_with(&options, &records);
        let next = file.clone();
        file[0] ^= 0x40;
        let (read, issues) = tests::read(Format::Pcapng, &file);
        assert_eq!((read.len(), issues.len()), (0, 1), "{issues:?}");
        file.extend(next);
        let (read, issues) = tests::read(Format::Pcapng, &file);
        assert_eq!((read.len(), issues.len()), (20_000, 1), "{issues:?}");
    }

    /// Found by random damage: the block was skipped as one of an unknown kind.
    #[test]
    fn a_packet_whose_kind_is_damaged_is_counted() {
        let records: Vec<_> = (0..10).map(data_record).collect();
        let options = WriteOptions { format: Some(Format::Pcapng), ..WriteOptions::default() };
        let (mut file, _) = tests::write_with(&options, &records);
        let block = file.len() - 64 - 5 * 48;
        assert_eq!(file[block..block + 4], [6, 0, 0, 0]);
        file[block + 2] = 0x9D;
        let source = std::io::Cursor::new(file);
        let mut reader =
            TraceReader::from_source("damaged", source, Format::Pcapng, &ReadOptions::default()).unwrap();
        assert_eq!(reader.by_ref().flatten().count(), 9);
        let left_out: Vec<_> = reader.left_out().iter().collect();
        assert_eq!(left_out, [("blocks of kinds that are not known", 1)]);
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
        // Four more, then an error frame with two events: error-passive, by a stuff error.
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

    /// What has gone through a pipe so far.
    #[derive(Clone, Default)]
    struct Pipe(Arc<Mutex<Vec<u8>>>);

    impl Write for Pipe {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().unwrap().extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    /// Types and contents of blocks.
    fn blocks(mut bytes: &[u8]) -> Vec<(u32, Vec<u8>)> {
        let mut blocks = Vec::new();
        while let Some((head, _)) = bytes.split_first_chunk::<8>() {
            let [kind, len] = [0, 4].map(|at| u32::from_le_bytes(head[at..at + 4].try_into().unwrap()));
            let (block, rest) = bytes.split_at(len as usize);
            blocks.push((kind, block[8..block.len() - 4].to_vec()));
            bytes = rest;
        }
        blocks
    }

    /// Interface, received, dropped, delivered.
    fn statistics(blocks: &[(u32, Vec<u8>)]) -> Vec<[u64; 4]> {
        let of = blocks.iter().filter(|(kind, _)| *kind == STATISTICS).map(|(_, body)| {
            let option = |code: u16| {
                let wanted = [code.to_le_bytes(), 8_u16.to_le_bytes()].concat();
                let at =
                    12 + body[12..].chunks(12).position(|option| option.starts_with(&wanted)).unwrap() * 12;
                u64::from_le_bytes(body[at + 4..at + 12].try_into().unwrap())
            };
            let interface = u32::from_le_bytes(body[..4].try_into().unwrap());
            [u64::from(interface), option(ISB_IFRECV), option(ISB_IFDROP), option(ISB_USRDELIV)]
        });
        of.collect()
    }

    fn event(channel: u8, event: TraceEvent) -> TraceRecord {
        TraceRecord { time_ns: 5, device_ns: None, channel, event }
    }

    #[test]
    fn whoever_reads_along_has_the_head_at_once_and_the_counts_regularly() {
        let channels = [1, 2].map(|channel| ChannelInfo {
            channel,
            bitrate_bps: Some(500_000),
            description: "listening".to_owned(),
        });
        let options = WriteOptions {
            format: Some(Format::Pcapng),
            channels: channels.to_vec(),
            statistics_every: Some(Duration::ZERO),
            ..WriteOptions::default()
        };
        let pipe = Pipe::default();
        let mut writer = create_stream_writer(Box::new(pipe.clone()), &options).unwrap();
        let seen = || blocks(&pipe.0.lock().unwrap());
        writer.flush().unwrap();
        assert_eq!(seen().iter().map(|(kind, _)| *kind).collect::<Vec<_>>(), [0x0A0D_0D0A, 1, 1, 5, 5]);
        assert_eq!(statistics(&seen()), [[0, 0, 0, 0], [1, 0, 0, 0]]);
        assert!(seen()[1].1.windows(9).any(|text| text == b"listening"));
        writer.write(&data_record(0)).unwrap();
        let lost = TraceEvent::Lost { stage: Some(LossStage::Queue), count: 7, at_least: false };
        writer.write(&event(2, lost)).unwrap();
        writer.flush().unwrap();
        let channel = u64::from(data_record(0).channel - 1);
        assert_eq!(channel, 0);
        assert_eq!(statistics(&seen())[2..], [[0, 1, 0, 1], [1, 7, 7, 0]]);
        writer.finish().unwrap();
        assert_eq!(statistics(&seen())[4..], [[0, 1, 0, 1], [1, 7, 7, 0]]);
        let trace = std::io::Cursor::new(pipe.0.lock().unwrap().clone());
        let options = crate::ReadOptions::default();
        let mut reader = crate::TraceReader::from_source("a", trace, Format::Pcapng, &options).unwrap();
        assert_eq!(reader.by_ref().flatten().count(), 2);
        assert_eq!(reader.bit_rates(), [(1, 500_000), (2, 500_000)]);
    }

    /// Wireshark shows drop counts only to users who look for them.
    #[test]
    fn a_loss_is_said_in_words_and_a_remark_stands_on_the_next_packet() {
        let options = WriteOptions { format: Some(Format::Pcapng), ..WriteOptions::default() };
        let pipe = Pipe::default();
        let mut writer = create_stream_writer(Box::new(pipe.clone()), &options).unwrap();
        let loss = |stage, count, at_least| TraceEvent::Lost { stage, count, at_least };
        writer.write(&event(1, loss(Some(LossStage::Controller), 3, true))).unwrap();
        writer.remark(1, "from here on at 250000 bit/s");
        writer.write(&event(2, loss(None, 1, false))).unwrap();
        writer.write(&event(1, TraceEvent::GAP)).unwrap();
        writer.finish().unwrap();
        let blocks = blocks(&pipe.0.lock().unwrap());
        let packets: Vec<String> = blocks
            .iter()
            .filter(|(kind, _)| *kind == 6)
            .map(|(_, body)| String::from_utf8_lossy(&body[36..]).into_owned())
            .collect();
        assert!(packets[0].contains("at least 3 frames were lost here in the CAN controller"), "{packets:?}");
        assert!(
            packets[1].contains("1 frame was lost here") && !packets[1].contains("250000"),
            "{packets:?}"
        );
        assert!(packets[2].contains("from here on at 250000 bit/s"), "{packets:?}");
        assert!(
            packets[2].contains("an unknown number of frames was lost here between device and computer"),
            "{packets:?}"
        );
    }

    #[test]
    fn a_time_that_is_only_an_upper_bound_is_still_one_when_it_is_read() {
        let frame =
            |late| TraceEvent::Frame { frame: "123#11".parse().unwrap(), direction: Direction::Tx, late };
        let records = [event(1, frame(true)), event(1, frame(false))];
        assert_eq!(tests::round_trip(Format::Pcapng, &records), records);
    }
}
