//! The wire's decoder against any bytes, in any pieces, both raw and as the contents of messages with a valid CRC: no panic,
//! and what is understood does not depend on how the bytes arrive.
#![no_main]

use cantap_wire::framing::{CRC_LEN, MAX_ENCODED, MAX_MESSAGE, seal};
use cantap_wire::{Decoded, Decoder};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: (u8, Vec<&[u8]>, &[u8])| {
    let (piece, messages, tail) = input;
    let mut stream = Vec::new();
    for contents in messages {
        let contents = &contents[..contents.len().min(MAX_MESSAGE)];
        let mut message = [0; MAX_MESSAGE + CRC_LEN];
        message[..contents.len()].copy_from_slice(contents);
        let mut sealed = [0; MAX_ENCODED];
        let len = seal(&mut message, contents.len(), &mut sealed).expect("both buffers are as long as can be");
        stream.extend_from_slice(&sealed[..len]);
    }
    stream.extend_from_slice(tail);
    let (mut whole, mut pieces) = (Vec::new(), Vec::new());
    Decoder::new().push(&stream, |decoded| whole.push(describe(&decoded)));
    let mut decoder = Decoder::new();
    for bytes in stream.chunks(usize::from(piece).max(1)) {
        decoder.push(bytes, |decoded| pieces.push(describe(&decoded)));
    }
    // Overlong garbage is reported at the moment it becomes too long, so only what was understood is compared.
    whole.retain(|line| !line.starts_with("Corrupt"));
    pieces.retain(|line| !line.starts_with("Corrupt"));
    assert_eq!(whole, pieces);
});

fn describe(decoded: &Decoded<'_>) -> String {
    format!("{decoded:?}")
}
