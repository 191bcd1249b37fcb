//! The decoder against everything that a cable, a driver or another program can do to a stream: it never panics,
//! accepts no wrong frame, recovers, and counts every missing frame where it is missing.

use cantap_wire::batch::BatchWriter;
use cantap_wire::framing::MAX_ENCODED;
use cantap_wire::record::{MAX_RECORD, encode_received};
use cantap_wire::{CHANNELS, Channel, Decoded, Decoder, Frame, Id, Received, Record, Stamp};
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::sample::Index;

/// What happens to a stream.
#[derive(Clone, Debug)]
enum Damage {
    /// A bit changes.
    Flip(Index, u8),
    /// Bytes are removed.
    Cut(Index, usize),
    /// Bytes are inserted.
    Insert(Index, Vec<u8>),
    /// A batch arrives before its predecessor.
    Swap(Index),
    /// A batch arrives twice.
    Repeat(Index),
    /// A batch does not arrive.
    Drop(Index),
}

fn damage() -> impl Strategy<Value = Damage> {
    prop_oneof![
        (any::<Index>(), 0..8u8).prop_map(|(at, bit)| Damage::Flip(at, bit)),
        (any::<Index>(), 1..40usize).prop_map(|(at, len)| Damage::Cut(at, len)),
        (any::<Index>(), vec(any::<u8>(), 1..8)).prop_map(|(at, bytes)| Damage::Insert(at, bytes)),
        any::<Index>().prop_map(Damage::Swap),
        any::<Index>().prop_map(Damage::Repeat),
        any::<Index>().prop_map(Damage::Drop),
    ]
}

/// A frame whose contents say its channel and its number among that channel's frames.
fn numbered(channel: Channel, number: u32) -> Frame {
    let id = Id::standard_truncated(number * 7 + channel.index() as u32);
    Frame::data_frame(id, &number.to_be_bytes()[..=number as usize % 4]).unwrap()
}

/// Makes batches of numbered frames.
struct Sender {
    writer: BatchWriter,
    sent: [u32; CHANNELS],
}

impl Sender {
    fn batch(&mut self, channels: &[bool]) -> Vec<u8> {
        for second in channels {
            let channel = Channel::ALL[usize::from(*second)];
            let sent = &mut self.sent[channel.index()];
            let received = Received {
                channel,
                frame: numbered(channel, *sent),
                stamp: Stamp::Exact,
                data_omitted: false,
            };
            *sent += 1;
            let mut record = [0; MAX_RECORD];
            let len = encode_received(&received, 600, &mut record);
            assert!(self.writer.push(&record[..len], 1 << 40, Some(channel)));
        }
        let mut out = [0; MAX_ENCODED];
        let len = self.writer.finish(&mut out);
        out[..len].to_vec()
    }
}

/// Follows what the decoder reports and insists that every frame is either delivered once or counted as lost, in
/// its place.
#[derive(Default)]
struct Books {
    next: [u32; CHANNELS],
    lost: u32,
}

impl Books {
    fn take(&mut self, decoded: &Decoded<'_>) -> Result<(), TestCaseError> {
        match decoded {
            Decoded::Record { record: Record::Received(received), .. } => {
                let next = &mut self.next[received.channel.index()];
                prop_assert_eq!(
                    received.frame,
                    numbered(received.channel, *next),
                    "a wrong frame was accepted"
                );
                *next += 1;
            }
            Decoded::BatchesLost { frames, .. } => {
                for (next, lost) in self.next.iter_mut().zip(frames) {
                    *next += lost;
                    self.lost += lost;
                }
            }
            Decoded::Corrupt(_) => {}
            other => prop_assert!(false, "made up: {other:?}"),
        }
        Ok(())
    }
}

fn apply(batches: &mut Vec<Vec<u8>>, damages: &[Damage]) -> Vec<u8> {
    for damage in damages {
        match damage {
            Damage::Swap(at) if batches.len() > 1 => {
                let at = at.index(batches.len() - 1);
                batches.swap(at, at + 1);
            }
            Damage::Repeat(at) if !batches.is_empty() => {
                let at = at.index(batches.len());
                batches.insert(at, batches[at].clone());
            }
            Damage::Drop(at) if !batches.is_empty() => {
                batches.remove(at.index(batches.len()));
            }
            _ => {}
        }
    }
    let mut stream = batches.concat();
    for damage in damages {
        match damage {
            Damage::Flip(at, bit) if !stream.is_empty() => {
                let at = at.index(stream.len());
                stream[at] ^= 1 << bit;
            }
            Damage::Cut(at, len) if !stream.is_empty() => {
                let at = at.index(stream.len());
                stream.drain(at..(at + len).min(stream.len()));
            }
            Damage::Insert(at, bytes) => {
                let at = at.index(stream.len() + 1);
                stream.splice(at..at, bytes.iter().copied());
            }
            _ => {}
        }
    }
    stream
}

fn config(cases: u32) -> ProptestConfig {
    ProptestConfig { cases, failure_persistence: None, ..ProptestConfig::default() }
}

proptest! {
    #![proptest_config(config(100_000))]
    #[test]
    fn a_damaged_stream_delivers_each_frame_once_or_counts_it_lost(
        frames in vec(vec(any::<bool>(), 1..5), 1..6),
        damages in vec(damage(), 0..4),
        piece in 1..64usize,
    ) {
        let mut sender = Sender { writer: BatchWriter::new(), sent: [0; CHANNELS] };
        let mut batches: Vec<Vec<u8>> = frames.iter().map(|frames| sender.batch(frames)).collect();
        let mut stream = apply(&mut batches, &damages);
        // A good batch after everything else: then everything must be accounted for.
        stream.push(0);
        stream.extend(sender.batch(&[false, true]));
        let (mut decoder, mut books, mut verdict) = (Decoder::new(), Books::default(), Ok(()));
        for bytes in stream.chunks(piece) {
            decoder.push(bytes, |decoded| {
                let taken = books.take(&decoded);
                if verdict.is_ok() {
                    verdict = taken;
                }
            });
        }
        verdict?;
        prop_assert_eq!(books.next, sender.sent);
        if damages.is_empty() {
            prop_assert_eq!(books.lost, 0);
        }
    }
}

proptest! {
    #![proptest_config(config(20_000))]
    #[test]
    fn random_bytes_are_no_message(bytes in vec(any::<u8>(), 0..600), piece in 1..64usize) {
        let mut decoder = Decoder::new();
        let mut made_up = 0;
        for bytes in bytes.chunks(piece) {
            decoder.push(bytes, |decoded| made_up += u32::from(!matches!(decoded, Decoded::Corrupt(_))));
        }
        prop_assert_eq!(made_up, 0);
    }
}

#[test]
fn a_stream_without_an_end_is_thrown_away_and_what_follows_is_found() {
    let mut sender = Sender { writer: BatchWriter::new(), sent: [0; CHANNELS] };
    let mut stream = vec![1; 10 * MAX_ENCODED];
    stream.push(0);
    stream.extend(sender.batch(&[false, true]));
    let (mut decoder, mut books) = (Decoder::new(), Books::default());
    decoder.push(&stream, |decoded| books.take(&decoded).unwrap());
    assert_eq!((books.next, books.lost), (sender.sent, 0));
}
