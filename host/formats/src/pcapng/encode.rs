//! Writing pcapng.

use super::super::codec::Encode;
use super::super::left_out::LeftOut;
use super::super::socketcan_packet::{EXTENDED, FD_PACKET_BYTES, LINK_TYPE, PACKET_BYTES, REMOTE};
use super::{
    BLOCK_FRAME_BYTES, BYTE_ORDER_MAGIC, END, ENHANCED_PACKET, EPB_DROPCOUNT, EPB_FLAGS, IF_NAME, IF_TSRESOL,
    INTERFACE_DESCRIPTION, OUTBOUND, SECTION_HEADER, SHB_USERAPPL,
};
use cantap_trace::fd::FLAG_FDF;
use cantap_trace::socketcan::{ERROR_FLAG, ErrorFrame};
use cantap_trace::{Direction, FdFrame, TraceEvent, TraceFrame, TraceRecord};

/// Times are in nanoseconds: 10 to the power of minus this.
const RESOLUTION: u8 = 9;

/// Writes pcapng.
#[derive(Default)]
pub(crate) struct Encoder {
    started: bool,
    /// The channels that have an interface, in the order of the interfaces.
    channels: Vec<u8>,
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

impl Encoder {
    fn start(&mut self, out: &mut Vec<u8>) {
        self.started = true;
        block(out, SECTION_HEADER, |out| {
            out.extend_from_slice(&BYTE_ORDER_MAGIC.to_le_bytes());
            // Version 1.0, and a section whose length is not known.
            out.extend_from_slice(&[1, 0, 0, 0]);
            out.extend_from_slice(&[0xFF; 8]);
            option(out, SHB_USERAPPL, b"cantap");
            option(out, END, &[]);
        });
    }

    /// The number of a channel's interface, described before its first packet.
    #[inline]
    fn interface(&mut self, channel: u8, out: &mut Vec<u8>) -> u32 {
        if let Some(at) = self.channels.iter().position(|known| *known == channel) {
            return at as u32;
        }
        self.channels.push(channel);
        block(out, INTERFACE_DESCRIPTION, |out| {
            out.extend_from_slice(&LINK_TYPE.to_le_bytes());
            // Reserved, and no limit to a packet's length.
            out.extend_from_slice(&[0; 6]);
            option(out, IF_NAME, cantap_trace::Interface(channel).to_string().as_bytes());
            option(out, IF_TSRESOL, &[RESOLUTION]);
            option(out, END, &[]);
        });
        self.channels.len() as u32 - 1
    }
}

/// A CAN FD frame as SocketCAN's packet, always of the full length: readers tell the two kinds by it.
fn fd_packet(frame: &FdFrame) -> [u8; FD_PACKET_BYTES] {
    let mut packet = [0; FD_PACKET_BYTES];
    let extended = if frame.id().is_extended() { EXTENDED } else { 0 };
    packet[..4].copy_from_slice(&(frame.id().raw() | extended).to_be_bytes());
    packet[4] = frame.data_len() as u8;
    packet[5] = FLAG_FDF | frame.flags();
    packet[8..8 + frame.data_len()].copy_from_slice(frame.data());
    packet
}

/// A record as SocketCAN's packet; a CAN FD frame is [`fd_packet`]'s.
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
        let interface = self.interface(record.channel, out);
        block(out, ENHANCED_PACKET, |out| {
            let time = record.time_ns.cast_unsigned();
            let fd = record.frame().and_then(TraceFrame::fd);
            let len = if fd.is_some() { FD_PACKET_BYTES } else { PACKET_BYTES } as u32;
            for field in [interface, (time >> 32) as u32, time as u32, len, len] {
                out.extend_from_slice(&field.to_le_bytes());
            }
            match fd {
                Some(frame) => out.extend_from_slice(&fd_packet(frame)),
                None => out.extend_from_slice(&packet(&record.event)),
            }
            match &record.event {
                TraceEvent::Frame { direction: Direction::Tx, .. } => {
                    option(out, EPB_FLAGS, &OUTBOUND.to_le_bytes());
                    option(out, END, &[]);
                }
                TraceEvent::Lost { count, .. } => {
                    option(out, EPB_DROPCOUNT, &u64::from(*count).to_le_bytes());
                    option(out, END, &[]);
                }
                _ => {}
            }
        });
    }

    fn finish(&mut self, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        if !self.started {
            self.start(out);
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
