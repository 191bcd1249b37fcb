//! Writing pcapng.

use std::time::{Duration, Instant, SystemTime};

use super::super::channel_info::ChannelInfo;
use super::super::codec::Encode;
use super::super::left_out::LeftOut;
use super::super::socketcan_packet::{EXTENDED, FD_PACKET_BYTES, LINK_TYPE, PACKET_BYTES, REMOTE};
use super::super::writer::WriteOptions;
use super::{
    BLOCK_FRAME_BYTES, BYTE_ORDER_MAGIC, COMMENT, DEVICE_NS_MAGIC, END, ENHANCED_PACKET, EPB_DEVICE_NS,
    EPB_DROPCOUNT, EPB_FLAGS, IF_DESCRIPTION, IF_NAME, IF_SPEED, IF_TSRESOL, INTERFACE_DESCRIPTION,
    ISB_IFDROP, ISB_IFRECV, ISB_USRDELIV, LATE, OUTBOUND, SECTION_HEADER, SHB_USERAPPL, STATISTICS,
};
use cantap_can::LossStage;
use cantap_trace::fd::FLAG_FDF;
use cantap_trace::socketcan::{ERROR_FLAG, ErrorFrame};
use cantap_trace::{Direction, FdFrame, TraceEvent, TraceFrame, TraceRecord};

/// Length of one interface's statistics: number, time, three counts, the end of the options.
const STATISTICS_BYTES: usize = BLOCK_FRAME_BYTES + 12 + 3 * 12 + 4;

/// Times are in nanoseconds: 10 to the power of minus this.
const RESOLUTION: u8 = 9;

/// Writes pcapng.
#[derive(Default)]
pub(crate) struct Encoder {
    started: bool,
    /// In the order of their descriptions in the file.
    interfaces: Vec<Interface>,
    /// What is known of channels in advance.
    known: Vec<ChannelInfo>,
    /// For anyone who reads meanwhile.
    statistics_every: Option<Duration>,
    /// When the statistics were last written.
    counted: Option<Instant>,
    /// The last record's time.
    latest_ns: Option<i64>,
}

/// A channel that has been described.
struct Interface {
    channel: u8,
    /// Number of frames written, and of frames lost before that.
    delivered: u64,
    lost: u64,
    /// For the next packet.
    remarks: Vec<String>,
}

/// Appends a block around what `body` appends, padded to 32 bits.
#[inline]
fn block(out: &mut Vec<u8>, kind: u32, body: impl FnOnce(&mut Vec<u8>)) {
    let at = out.len();
    out.extend_from_slice(&kind.to_le_bytes());
    out.extend_from_slice(&[0; 4]);
    body(out);
    let len = (out.len() - at + 4) as u32;
    debug_assert!(len as usize >= BLOCK_FRAME_BYTES && len.is_multiple_of(4));
    out[at + 4..at + 8].copy_from_slice(&len.to_le_bytes());
    out.extend_from_slice(&len.to_le_bytes());
}

fn option(out: &mut Vec<u8>, code: u16, value: &[u8]) {
    out.extend_from_slice(&code.to_le_bytes());
    out.extend_from_slice(&(value.len() as u16).to_le_bytes());
    out.extend_from_slice(value);
    out.resize(out.len() + value.len().wrapping_neg() % 4, 0);
}

/// A time in two halves, as in blocks.
fn halves(time_ns: i64) -> [u32; 2] {
    let time = time_ns.cast_unsigned();
    [(time >> 32) as u32, time as u32]
}

impl Encoder {
    pub(crate) fn new(options: &WriteOptions) -> Self {
        Self {
            known: options.channels.clone(),
            statistics_every: options.statistics_every,
            ..Self::default()
        }
    }

    fn start(&mut self, out: &mut Vec<u8>) {
        self.started = true;
        block(out, SECTION_HEADER, |out| {
            out.extend_from_slice(&BYTE_ORDER_MAGIC.to_le_bytes());
            // Version 1.0, and a section of unknown length.
            out.extend_from_slice(&[1, 0, 0, 0]);
            out.extend_from_slice(&[0xFF; 8]);
            option(out, SHB_USERAPPL, b"cantap");
            option(out, END, &[]);
        });
        for channel in self.known.iter().map(|known| known.channel).collect::<Vec<_>>() {
            self.interface(channel, out);
        }
    }

    /// The number of a channel's interface, which is described before its first packet.
    #[inline]
    fn interface(&mut self, channel: u8, out: &mut Vec<u8>) -> usize {
        if let Some(at) = self.interfaces.iter().position(|interface| interface.channel == channel) {
            return at;
        }
        self.describe(channel, out);
        self.interfaces.push(Interface { channel, delivered: 0, lost: 0, remarks: Vec::new() });
        self.interfaces.len() - 1
    }

    fn describe(&self, channel: u8, out: &mut Vec<u8>) {
        let known = self.known.iter().find(|known| known.channel == channel);
        block(out, INTERFACE_DESCRIPTION, |out| {
            out.extend_from_slice(&LINK_TYPE.to_le_bytes());
            // Reserved, and no limit on a packet's length.
            out.extend_from_slice(&[0; 6]);
            option(out, IF_NAME, cantap_trace::Interface(channel).to_string().as_bytes());
            if let Some(known) = known.filter(|known| !known.description.is_empty()) {
                option(out, IF_DESCRIPTION, cut(&known.description).as_bytes());
            }
            if let Some(bitrate_bps) = known.and_then(|known| known.bitrate_bps) {
                option(out, IF_SPEED, &u64::from(bitrate_bps).to_le_bytes());
            }
            option(out, IF_TSRESOL, &[RESOLUTION]);
            option(out, END, &[]);
        });
    }

    /// The totals of each channel up to now. Wireshark adds up nothing: an interface's last block counts.
    fn statistics(&mut self, time_ns: i64, out: &mut Vec<u8>) {
        // A target without a clock writes files, too.
        self.counted = self.statistics_every.map(|_| Instant::now());
        for (number, Interface { delivered, lost, .. }) in (0_u32..).zip(&self.interfaces) {
            block(out, STATISTICS, |out| {
                let [high, low] = halves(time_ns);
                for field in [number, high, low] {
                    out.extend_from_slice(&field.to_le_bytes());
                }
                for (code, count) in
                    [(ISB_IFRECV, delivered + lost), (ISB_IFDROP, *lost), (ISB_USRDELIV, *delivered)]
                {
                    option(out, code, &count.to_le_bytes());
                }
                option(out, END, &[]);
            });
        }
    }
}

/// As much of a text as certainly fits an option.
fn cut(text: &str) -> &str {
    const MOST: usize = 1024;
    let end = (0..=text.len().min(MOST)).rev().find(|end| text.is_char_boundary(*end));
    &text[..end.unwrap_or(0)]
}

/// Now, by this computer's clock.
fn now_ns() -> i64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}

/// Describes a loss for anyone who reads packets.
fn loss(stage: Option<LossStage>, count: u32, at_least: bool) -> String {
    let place = match stage {
        Some(LossStage::Controller) => " in the CAN controller",
        Some(LossStage::Queue) => " in the device's queue",
        Some(LossStage::Link) => " between device and computer",
        Some(LossStage::Host) => " in the computer",
        Some(LossStage::Gateway) => " on the way through the gateway",
        None => "",
    };
    match (count, at_least) {
        (0, true) => format!("an unknown number of frames was lost here{place}"),
        (1, true) => format!("at least 1 frame was lost here{place}"),
        (1, false) => format!("1 frame was lost here{place}"),
        (count, true) => format!("at least {count} frames were lost here{place}"),
        (count, false) => format!("{count} frames were lost here{place}"),
    }
}

/// A CAN FD frame as SocketCAN's packet, always at full length, by which readers distinguish the two kinds.
fn fd_packet(frame: &FdFrame) -> [u8; FD_PACKET_BYTES] {
    let mut packet = [0; FD_PACKET_BYTES];
    let extended = if frame.id().is_extended() { EXTENDED } else { 0 };
    packet[..4].copy_from_slice(&(frame.id().raw() | extended).to_be_bytes());
    packet[4] = frame.data_len() as u8;
    packet[5] = FLAG_FDF | frame.flags();
    packet[8..8 + frame.data_len()].copy_from_slice(frame.data());
    packet
}

/// A record as SocketCAN's packet; CAN FD frames are handled by [`fd_packet`].
#[inline]
fn packet(event: &TraceEvent) -> [u8; PACKET_BYTES] {
    let mut packet = [0; PACKET_BYTES];
    let id = match event {
        TraceEvent::Frame { frame: TraceFrame::Classic(frame), .. } => {
            packet[4] = frame.dlc().min(8);
            if frame.dlc() > 8 {
                packet[7] = frame.dlc();
            }
            packet[8..].copy_from_slice(&frame.padded_data());
            let extended = if frame.id().is_extended() { EXTENDED } else { 0 };
            frame.id().raw() | extended | if frame.is_remote() { REMOTE } else { 0 }
        }
        event => {
            let error = ErrorFrame::of(event);
            packet[4] = 8;
            packet[8..].copy_from_slice(&error.map_or([0; 8], |error| error.data));
            ERROR_FLAG | error.map_or(0, |error| error.classes)
        }
    };
    packet[..4].copy_from_slice(&id.to_be_bytes());
    packet
}

impl Encode for Encoder {
    #[inline]
    fn record(&mut self, record: &TraceRecord, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        if !self.started {
            self.start(out);
        }
        self.latest_ns = Some(record.time_ns);
        let number = self.interface(record.channel, out);
        let interface = &mut self.interfaces[number];
        let remarks = std::mem::take(&mut interface.remarks);
        let (mut comment, mut flags, mut dropped) = (None, None, None);
        match record.event {
            TraceEvent::Frame { direction, late, .. } => {
                interface.delivered += 1;
                comment = late.then(|| LATE.to_owned());
                flags = (direction == Direction::Tx).then_some(OUTBOUND);
            }
            TraceEvent::Lost { stage, count, at_least } => {
                interface.lost += u64::from(count);
                comment = Some(loss(stage, count, at_least));
                dropped = Some(u64::from(count));
            }
            _ => {}
        }
        block(out, ENHANCED_PACKET, |out| {
            let [high, low] = halves(record.time_ns);
            let fd = record.frame().and_then(TraceFrame::fd);
            let len = if fd.is_some() { FD_PACKET_BYTES } else { PACKET_BYTES } as u32;
            for field in [number as u32, high, low, len, len] {
                out.extend_from_slice(&field.to_le_bytes());
            }
            match fd {
                Some(frame) => out.extend_from_slice(&fd_packet(frame)),
                None => out.extend_from_slice(&packet(&record.event)),
            }
            let before = out.len();
            for text in remarks.iter().chain(&comment) {
                option(out, COMMENT, cut(text).as_bytes());
            }
            if let Some(flags) = flags {
                option(out, EPB_FLAGS, &flags.to_le_bytes());
            }
            if let Some(dropped) = dropped {
                option(out, EPB_DROPCOUNT, &dropped.to_le_bytes());
            }
            if let Some(device_ns) = record.device_ns {
                let mut value = [0; 12];
                value[..4].copy_from_slice(&DEVICE_NS_MAGIC);
                value[4..].copy_from_slice(&device_ns.get().to_le_bytes());
                option(out, EPB_DEVICE_NS, &value);
            }
            if out.len() > before {
                option(out, END, &[]);
            }
        });
    }

    fn carries_late(&self) -> bool {
        true
    }

    fn flush(&mut self, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        let Some(every) = self.statistics_every else { return };
        if !self.started {
            self.start(out);
        }
        if self.counted.is_none_or(|counted| counted.elapsed() >= every) {
            self.statistics(now_ns(), out);
        }
    }

    fn held_back(&self) -> usize {
        self.interfaces.len() * STATISTICS_BYTES
    }

    fn remark(&mut self, channel: u8, text: &str) {
        if let Some(interface) = self.interfaces.iter_mut().find(|interface| interface.channel == channel) {
            interface.remarks.push(text.to_owned());
        }
    }

    fn finish(&mut self, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        if !self.started {
            self.start(out);
        }
        // A file's end is at its last record.
        let end_ns = if self.statistics_every.is_some() { Some(now_ns()) } else { self.latest_ns };
        if let Some(end_ns) = end_ns {
            self.statistics(end_ns, out);
        }
    }

    fn whole(&self, bytes: &[u8]) -> usize {
        // What was written before ended with a whole block, so blocks can be walked from here.
        let mut at = 0;
        while let Some(len) = bytes.get(at + 4..at + 8) {
            let len = u32::from_le_bytes([len[0], len[1], len[2], len[3]]) as usize;
            if len < BLOCK_FRAME_BYTES || bytes.len() - at < len {
                break;
            }
            at += len;
        }
        at
    }
}
