//! Bytes per frame on the wire, averaged over full batches, with stamps, sequence numbers and CRC.

use cantap_wire::batch::BatchWriter;
use cantap_wire::framing::MAX_ENCODED;
use cantap_wire::record::{MAX_RECORD, encode_received};
use cantap_wire::{Channel, Frame, Received, Stamp};

/// 12 ticks per µs.
const TICKS_PER_BIT: i64 = 12;

/// Fills batches with the same frame repeated, on one channel at 1 Mbit/s and full load, three days after
/// the start.
fn bytes_per_frame(text: &str, bits_on_bus: i64) -> f64 {
    let frame: Frame = text.parse().unwrap();
    let received = Received { channel: Channel::Can1, frame, stamp: Stamp::Exact, data_omitted: false };
    let mut record = [0; MAX_RECORD];
    let len = encode_received(&received, bits_on_bus * TICKS_PER_BIT, &mut record);
    let mut now = 3 * 24 * 3600 * 12_000_000u64;
    let mut writer = BatchWriter::new();
    let mut out = [0; MAX_ENCODED];
    let (mut frames, mut bytes) = (0, 0);
    while frames < 1_000_000 {
        while writer.push(&record[..len], now, Some(Channel::Can1)) {
            now += (bits_on_bus * TICKS_PER_BIT) as u64;
            frames += 1;
        }
        bytes += writer.finish(&mut out);
    }
    f64::from(bytes as u32) / f64::from(frames)
}

#[test]
fn the_four_frame_kinds_keep_their_budget() {
    for (kind, text, bits, budget) in [
        ("standard, no data", "555#", 48, 5.5),
        ("standard, 8 bytes", "555#5555555555555555", 111, 13.5),
        ("extended, no data", "15555555#", 68, 7.5),
        ("extended, 8 bytes", "15555555#5555555555555555", 131, 15.5),
    ] {
        let bytes = bytes_per_frame(text, bits);
        println!("{kind}: {bytes:.3} bytes per frame (budget {budget})");
        assert!(bytes <= budget, "{kind}: {bytes:.3} > {budget}");
    }
}
