//! The wire's decoder against any bytes, in any pieces: no panic, and nothing accepted twice.
#![no_main]

use cantap_wire::{Decoded, Decoder};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: (u8, &[u8])| {
    let (piece, bytes) = input;
    let piece = usize::from(piece).max(1);
    let (mut whole, mut pieces) = (Vec::new(), Vec::new());
    Decoder::new().push(bytes, |decoded| whole.push(describe(&decoded)));
    let mut decoder = Decoder::new();
    for bytes in bytes.chunks(piece) {
        decoder.push(bytes, |decoded| pieces.push(describe(&decoded)));
    }
    // Overlong garbage is reported when it becomes too long, so only what was understood is compared.
    whole.retain(|line| !line.starts_with("Corrupt"));
    pieces.retain(|line| !line.starts_with("Corrupt"));
    assert_eq!(whole, pieces);
});

fn describe(decoded: &Decoded<'_>) -> String {
    format!("{decoded:?}")
}
