//! cannelloni in both directions: any bytes as a datagram and as a stream in any pieces, without a panic, and with the same frames however they are
//! cut; what is understood is the same after it was written again.
#![no_main]

use cantap_codecs::cannelloni::{GREETING, Item, Sequence, Stream, Writer, datagram, item};
use cantap_wire::Frame;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: (u8, &[u8])| {
    let (piece, bytes) = input;
    if let Ok((header, _)) = datagram(bytes) {
        let mut sequence = Sequence::default();
        let _ = (sequence.take(header.sequence, bytes), sequence.take(piece, bytes));
    }
    let (whole, is_whole) = read(&[bytes]);
    let pieces: Vec<&[u8]> = bytes.chunks(usize::from(piece).max(1)).collect();
    assert_eq!((&whole, is_whole), (&read(&pieces).0, read(&pieces).1));
    again(&whole);
});

/// The items of a stream that comes in these pieces, and whether it had no fault.
fn read(pieces: &[&[u8]]) -> (Vec<Item>, bool) {
    let (mut stream, mut items) = (Stream::default(), Vec::new());
    stream.push(GREETING);
    for piece in pieces {
        stream.push(piece);
        if stream.frames(|item| items.push(item)).is_err() {
            return (items, false);
        }
    }
    (items, true)
}

/// Writes the frames into datagrams, which must hold the same.
fn again(items: &[Item]) {
    let (mut writer, mut written, mut read) = (Writer::default(), Vec::new(), Vec::new());
    let mut take = |writer: &mut Writer| {
        let Some(bytes) = writer.take() else { return };
        let (header, mut rest) = datagram(&bytes).expect("it was written so");
        for _ in 0..header.count {
            let (parsed, after) = item(rest).expect("it is whole");
            read.push(parsed);
            rest = after;
        }
        assert!(rest.is_empty());
    };
    for item in items {
        if !writer.has_room() {
            take(&mut writer);
        }
        match item {
            Item::Frame(frame) => writer.push(frame),
            Item::Fd(frame) => writer.push_fd(frame),
            Item::Error => writer.push_error(0, [0; 8]),
            Item::Impossible => unreachable!("a stream ends there"),
        }
        written.push(as_written(*item));
    }
    take(&mut writer);
    assert_eq!(written, read);
}

/// A remote frame's length is written as Linux has it: 8 at most.
fn as_written(item: Item) -> Item {
    match item {
        Item::Frame(frame) if frame.is_remote() => {
            Frame::remote_frame(frame.id(), frame.dlc().min(8)).map_or(Item::Impossible, Item::Frame)
        }
        item => item,
    }
}
