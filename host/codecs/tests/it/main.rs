//! What both ends of a cannelloni tunnel rely on, for any bytes; the fuzz target of this name looks further.

use cantap_codecs::cannelloni::{BadStream, GREETING, Item, Stream, put, put_error, put_fd};
use proptest::prelude::*;

/// The frames of a stream that comes in pieces of so many bytes.
fn read(bytes: &[u8], piece: usize) -> (Vec<Item>, Result<(), BadStream>) {
    let (mut stream, mut items) = (Stream::default(), Vec::new());
    stream.push(GREETING);
    for bytes in bytes.chunks(piece) {
        stream.push(bytes);
        if let Err(fault) = stream.frames(|item| items.push(item)) {
            return (items, Err(fault));
        }
    }
    (items, Ok(()))
}

/// Bytes that are often frames.
fn likely() -> impl Strategy<Value = Vec<u8>> {
    let frame = (0..8_u8, any::<[u8; 3]>(), 0..9_u8, any::<bool>(), any::<[u8; 10]>()).prop_map(
        |(high, id, len, is_fd, data)| {
            let [a, b, c] = if high & 4 == 0 { [0, id[1] & 7, id[2]] } else { id };
            let head = [high << 5, a, b, c, len | u8::from(is_fd) << 7];
            let end = if high & 2 == 2 && !is_fd { 0 } else { usize::from(len) + usize::from(is_fd) };
            [&head[..], &data[..end]].concat()
        },
    );
    proptest::collection::vec(frame, 0..20).prop_map(|frames| frames.concat())
}

proptest! {
    #[test]
    fn the_frames_do_not_depend_on_how_a_stream_is_cut(
        bytes in prop_oneof![any::<Vec<u8>>(), likely()],
        piece in 1..20_usize,
    ) {
        prop_assert_eq!(read(&bytes, piece), read(&bytes, usize::MAX));
    }

    #[test]
    fn what_is_understood_is_written_as_it_is_read(bytes in likely()) {
        let (items, _) = read(&bytes, usize::MAX);
        let mut again = Vec::new();
        for item in &items {
            match item {
                Item::Frame(frame) => put(frame, &mut again),
                Item::Fd(frame) => put_fd(frame, &mut again),
                Item::Error => put_error(0, [0; 8], &mut again),
                Item::Impossible => prop_assert!(false, "a stream ends there"),
            }
        }
        prop_assert_eq!(read(&again, usize::MAX), (items, Ok(())));
    }
}
