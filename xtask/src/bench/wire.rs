//! What a frame costs on USB, in bytes, and in the encoder, in time.

use std::time::Instant;

use anyhow::{Result, ensure};
use cantap_wire::batch::BatchWriter;
use cantap_wire::framing::MAX_ENCODED;
use cantap_wire::record::{MAX_RECORD, Stamp, encode_received};
use cantap_wire::{Channel, Frame, Id, Received};

/// Frames of each kind.
const FRAMES: u64 = 1_000_000;
/// Ticks between two frames at 1 Mbit/s and 12 MHz: 48, 111, 68 and 131 bits, the shortest of their kind.
pub const KINDS: [Kind; 4] = [
    Kind { name: "std0", extended: false, len: 0, ticks: 48 * 12, budget: 5.5 },
    Kind { name: "std8", extended: false, len: 8, ticks: 111 * 12, budget: 13.5 },
    Kind { name: "ext0", extended: true, len: 0, ticks: 68 * 12, budget: 7.5 },
    Kind { name: "ext8", extended: true, len: 8, ticks: 131 * 12, budget: 15.5 },
];

/// A kind of frames.
pub struct Kind {
    /// Its name in `cantap demo`.
    pub name: &'static str,
    extended: bool,
    len: usize,
    ticks: i64,
    /// Most bytes per frame that the design allows (for ext0, that of ext8 minus its data).
    budget: f64,
}

/// Encodes full batches of each kind.
pub fn run() -> Result<()> {
    println!("wire: {FRAMES} frames of each kind in full batches");
    println!("{:<6} {:>12} {:>8} {:>14}", "kind", "bytes/frame", "at most", "encode ns/frame");
    for kind in &KINDS {
        let begin = Instant::now();
        let mut bytes = 0;
        encode(kind, FRAMES, |batch| bytes += batch.len());
        let nanos = begin.elapsed().as_nanos() as f64 / FRAMES as f64;
        let per_frame = bytes as f64 / FRAMES as f64;
        println!("{:<6} {:>12.2} {:>8.1} {:>14.1}", kind.name, per_frame, kind.budget, nanos);
        ensure!(per_frame <= kind.budget, "{} takes more bytes per frame than allowed", kind.name);
    }
    Ok(())
}

/// Encodes frames of a kind as the device does, and passes on each batch as it goes over the wire.
pub fn encode(kind: &Kind, frames: u64, mut batch: impl FnMut(&[u8])) {
    let mut writer = BatchWriter::new();
    let mut out = [0; MAX_ENCODED];
    let mut record = [0; MAX_RECORD];
    for number in 0..frames {
        let raw = (number as u32).wrapping_mul(0x9E37_79B9);
        let id = if kind.extended { Id::extended_truncated(raw) } else { Id::standard_truncated(raw) };
        let data = u64::from(raw).wrapping_mul(0x9E37_79B9_7F4A_7C15).to_le_bytes();
        let frame = Frame::from_bus(id, false, kind.len as u8, data);
        let channel = Channel::ALL[(number % 2) as usize];
        let received = Received { channel, frame, stamp: Stamp::Exact, data_omitted: false };
        let len = encode_received(&received, kind.ticks, &mut record);
        let base_ticks = number * kind.ticks as u64;
        if !writer.push(&record[..len], base_ticks, Some(channel)) {
            let len_out = writer.finish(&mut out);
            batch(&out[..len_out]);
            writer.push(&record[..len], base_ticks, Some(channel));
        }
    }
    let len_out = writer.finish(&mut out);
    batch(&out[..len_out]);
}
