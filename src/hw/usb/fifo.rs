//! OTG_FS's FIFO RAM: how it is divided up, written and read.

use cantap_firmware::ports::PACKET;

use super::registers::{DIEPTXF, DIEPTXF0, FIFO, FIFO_STRIDE, GRXFSIZ, Registers};
use super::{BULK_IN, NOTIFY_IN};

/// Words that all FIFOs share (RM0090, "FIFO RAM allocation": 1.25 KiB).
const WORDS: usize = 320;
const PACKET_WORDS: usize = PACKET / 4;

/// The receive FIFO ("Receive data FIFO"): 5 · 1 + 8 words for SETUP packets of one control endpoint, 1 for global OUT NAK, the
/// packets with a status word each, and two status words for each of the two OUT endpoints.
const RX_WORDS: usize = 5 + 8 + 1 + RX_PACKETS * (PACKET_WORDS + 1) + 2 * 2;
/// Two, so that one can arrive while the previous one is taken out. Anything more is answered with NAK.
const RX_PACKETS: usize = 2;
/// One packet, which is also the smallest transmit FIFO allowed (16 words).
const CONTROL_WORDS: usize = PACKET_WORDS;
/// Nothing is ever sent there, but 16 words are the minimum.
const NOTIFY_WORDS: usize = PACKET_WORDS;
/// Whole packets that fit into the rest: 320 − 52 − 16 − 16 = 236 words, 14 packets.
pub const BULK_PACKETS: usize = (WORDS - RX_WORDS - CONTROL_WORDS - NOTIFY_WORDS) / PACKET_WORDS;
const BULK_WORDS: usize = BULK_PACKETS * PACKET_WORDS;

const CONTROL_START: usize = RX_WORDS;
const NOTIFY_START: usize = CONTROL_START + CONTROL_WORDS;
const BULK_START: usize = NOTIFY_START + NOTIFY_WORDS;
const _: () = assert!(BULK_START + BULK_WORDS <= WORDS);

/// Divides the RAM up. The FIFOs must be empty.
pub fn divide(registers: &mut Registers) {
    let part = |start: usize, words: usize| (words << 16 | start) as u32;
    registers.write(GRXFSIZ, RX_WORDS as u32);
    registers.write(DIEPTXF0, part(CONTROL_START, CONTROL_WORDS));
    registers.write(DIEPTXF + 4 * (NOTIFY_IN - 1), part(NOTIFY_START, NOTIFY_WORDS));
    registers.write(DIEPTXF + 4 * (BULK_IN - 1), part(BULK_START, BULK_WORDS));
    // The fourth endpoint is not used; its FIFO would overlap the others out of reset.
    registers.write(DIEPTXF + 4 * 2, part(BULK_START + BULK_WORDS, 0));
}

/// Writes a transfer's bytes to an IN endpoint's FIFO, which has room for them.
pub fn push(registers: &mut Registers, number: usize, bytes: &[u8]) {
    let fifo = FIFO + number * FIFO_STRIDE;
    let (words, rest) = bytes.as_chunks::<4>();
    for word in words {
        registers.write(fifo, u32::from_le_bytes(*word));
    }
    if !rest.is_empty() {
        let mut word = [0; 4];
        word[..rest.len()].copy_from_slice(rest);
        registers.write(fifo, u32::from_le_bytes(word));
    }
}

/// Takes a packet of `len` bytes from the receive FIFO; what does not fit `out` is dropped.
pub fn pop(registers: &Registers, len: usize, out: &mut [u8]) {
    for at in (0..len).step_by(4) {
        let word = registers.read(FIFO).to_le_bytes();
        let room = out.get_mut(at..).unwrap_or_default();
        let count = room.len().min(len - at).min(4);
        room[..count].copy_from_slice(&word[..count]);
    }
}
