//! How fast one core of the host turns a device's bytes into trace records.

use std::hint::black_box;
use std::time::Instant;

use cantap::bits_on_bus;
use cantap::device::{Intake, PIECE_BYTES, UtcNs};
use cantap_wire::framing::{self, CRC_LEN, MAX_ENCODED, MAX_MESSAGE};
use cantap_wire::message::DeviceMessage;
use cantap_wire::{Decoded, Decoder, Hello, PROTOCOL_VERSION, Record, Reply, Response};

use super::wire::{KINDS, encode};

/// Frames of each kind: a stream too long for a cache.
const FRAMES: u64 = 2_000_000;
/// Each measurement is the best of this many, because the machine may be busy with something else.
const ROUNDS: usize = 5;
/// What the design requires, in million frames per second.
const WANTED_MILLIONS: f64 = 10.0;

/// Measures each kind of frame.
pub fn run() {
    println!(
        "host: {FRAMES} frames of each kind, best of {ROUNDS}, in million frames per second on one core"
    );
    println!("records: with stamps tightened by exact lengths, times in UTC, losses counted");
    println!("(a busy machine halves every column; compare within one run)");
    println!("{:<6} {:>10} {:>10} {:>10} {:>8}", "kind", "lengths", "decode", "records", "wanted");
    let hello = hello();
    for kind in &KINDS {
        let mut stream = Vec::new();
        encode(kind, FRAMES, |batch| stream.extend_from_slice(batch));
        let lengths = lengths(&stream);
        let decode = best(|| decode(&stream));
        let records = best(|| records(&hello, &stream));
        let name = kind.name;
        println!("{name:<6} {lengths:>10.1} {decode:>10.1} {records:>10.1} {WANTED_MILLIONS:>8.1}");
    }
}

/// The fastest of several rounds, in million frames per second.
fn best(mut round: impl FnMut() -> u64) -> f64 {
    let mut best = 0.0_f64;
    for _ in 0..ROUNDS {
        let begin = Instant::now();
        let frames = round();
        assert_eq!(frames, FRAMES, "the decoder lost frames");
        best = best.max(frames as f64 / begin.elapsed().as_secs_f64() / 1e6);
    }
    best
}

/// Exact lengths only.
fn lengths(stream: &[u8]) -> f64 {
    let mut frames = Vec::with_capacity(FRAMES as usize);
    Decoder::new().push(stream, |decoded| {
        if let Decoded::Record { record: Record::Received(received), .. } = decoded {
            frames.push(received.frame);
        }
    });
    best(|| {
        let bits: u64 = frames.iter().map(|frame| u64::from(bits_on_bus(frame))).sum();
        black_box(bits);
        frames.len() as u64
    })
}

/// The wire's decoder only.
fn decode(stream: &[u8]) -> u64 {
    let mut decoder = Decoder::new();
    let mut frames = 0;
    for piece in stream.chunks(PIECE_BYTES) {
        decoder.push(piece, |decoded| {
            if let Decoded::Record { ticks, record: Record::Received(received) } = decoded {
                black_box((ticks, received));
                frames += 1;
            }
        });
    }
    frames
}

/// Everything that the reader thread does.
fn records(hello: &[u8], stream: &[u8]) -> u64 {
    let mut intake = Intake::new();
    intake.push(hello, UtcNs(0), |_| {});
    for channel in 0..2 {
        intake.lengths().set(channel, 36, 36_000_000, 12_000_000);
    }
    let mut frames = 0;
    for piece in stream.chunks(PIECE_BYTES) {
        let records = intake.push(piece, UtcNs(0), |_| {});
        frames += records.len() as u64;
        black_box(&records[..]);
        records.clear();
    }
    frames
}

/// The answer that begins a session.
fn hello() -> Vec<u8> {
    let hello = Hello {
        protocol: PROTOCOL_VERSION,
        firmware: [0; 3],
        board: "bench".try_into().unwrap_or_default(),
        serial: "0".try_into().unwrap_or_default(),
        channels: 2,
        tick_hz: 12_000_000,
        can_clock_hz: 36_000_000,
        queue_bytes: 0,
        tx_queue: 0,
        periodic_slots: 0,
        trigger_slots: 0,
        filter_banks: 0,
        capabilities: 0,
    };
    let response = DeviceMessage::Response(Response { id: 1, result: Ok(Reply::Hello(hello)) });
    let mut message = [0; MAX_MESSAGE + CRC_LEN];
    let mut out = [0; MAX_ENCODED];
    // Cannot fail: both buffers fit the longest message.
    let len = framing::encode(&response, &mut message, &mut out).unwrap_or(0);
    out[..len].to_vec()
}
