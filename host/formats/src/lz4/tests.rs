use std::io::{self, Read as _, Write as _};

use base64::Engine as _;
use lz4_flex::frame::{BlockMode, BlockSize, FrameEncoder, FrameInfo};

use super::{LEGACY_MAGIC, Unpacker};

/// What `lz4 -9 OPTIONS` 1.9.4 makes of `yes 0123456789abcdef | head -n 8000`, in Base64.
const LINKED: &str = "BCJNGERAXhwBAAD/AjAxMjM0NTY3ODlhYmNkZWYKEQD/////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////11BkZWYKMAoBAAAPEQD/////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////6FBlZgowMR0AAAAPEQD/////////////////////////O1BjZGVmCgAAAACMmJii";
const LEGACY: &str = "AiFMGDECAAD/AjAxMjM0NTY3ODlhYmNkZWYKEQD//////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////////yxQY2RlZgo=";

fn of_program(packed: &str) -> Vec<u8> {
    base64::engine::general_purpose::STANDARD.decode(packed).unwrap()
}

fn content() -> Vec<u8> {
    b"0123456789abcdef\n".repeat(8000)
}

fn unpack(bytes: &[u8]) -> (Vec<u8>, Option<io::ErrorKind>) {
    let mut out = Vec::new();
    let result = Unpacker::new(io::Cursor::new(bytes.to_vec())).read_to_end(&mut out);
    (out, result.err().map(|error| error.kind()))
}

/// Lines that do not repeat much.
fn text(lines: u64) -> Vec<u8> {
    let line = |n: u64| {
        format!(
            "({}.{:06}) can0 {:03X}#{:08X}\n",
            n / 1000,
            n % 1000,
            n % 2048,
            n * 2_654_435_761 % (1 << 32)
        )
    };
    (0..lines).flat_map(|n| line(n).into_bytes()).collect()
}

fn pack(info: FrameInfo, content: &[u8]) -> Vec<u8> {
    let mut encoder = FrameEncoder::with_frame_info(info, Vec::new());
    encoder.write_all(content).unwrap();
    encoder.finish().unwrap()
}

/// Each block with its length before it, as `lz4 -l` writes them.
fn pack_legacy(content: &[u8]) -> Vec<u8> {
    let mut file = LEGACY_MAGIC.to_vec();
    for block in content.chunks(8 << 20) {
        let block = lz4_flex::block::compress(block);
        file.extend((block.len() as u32).to_le_bytes());
        file.extend(block);
    }
    file
}

#[test]
fn files_of_the_program_are_read_whatever_its_options_and_one_after_another() {
    let skipped = [&[0x5A, 0x2A, 0x4D, 0x18, 3, 0, 0, 0][..], b"abc"].concat();
    for packed in [of_program(LINKED), of_program(LEGACY)] {
        assert_eq!(unpack(&packed), (content(), None));
        let more = [&packed[..], &skipped, &of_program(LEGACY), &skipped, &of_program(LINKED)].concat();
        assert_eq!(unpack(&more), (content().repeat(3), None));
    }
}

#[test]
fn every_kind_of_frame_gives_its_content() {
    let text = text(200_000);
    let mut all = Vec::new();
    for mode in [BlockMode::Linked, BlockMode::Independent] {
        for size in [BlockSize::Max64KB, BlockSize::Max256KB, BlockSize::Max1MB, BlockSize::Max4MB] {
            for checks in [false, true] {
                let info = FrameInfo::new().block_mode(mode).block_size(size);
                let info = info.block_checksums(checks).content_checksum(checks);
                let packed = pack(info.content_size(checks.then_some(text.len() as u64)), &text);
                assert_eq!(unpack(&packed), (text.clone(), None), "{mode:?} {size:?} {checks}");
                all.extend(packed);
            }
        }
    }
    all.extend(pack_legacy(&text));
    let (found, error) = unpack(&all);
    assert!(error.is_none() && found == text.repeat(17), "{error:?}");
}

#[test]
fn a_cut_block_gives_what_its_beginning_says() {
    let text = text(100_000);
    let linked = FrameInfo::new().block_mode(BlockMode::Linked).block_size(BlockSize::Max64KB);
    let whole = FrameInfo::new().block_size(BlockSize::Max4MB).content_checksum(true);
    for packed in [pack(linked, &text), pack(whole, &text), pack_legacy(&text)] {
        for at in (20..packed.len()).step_by(packed.len() / 97) {
            let (found, error) = unpack(&packed[..at]);
            assert_eq!(error, Some(io::ErrorKind::UnexpectedEof), "{at}");
            assert!(text.starts_with(&found), "{at}");
            // The text is uniform, so that equal fractions of it and of the file correspond.
            let least = text.len() * at / packed.len();
            assert!(found.len() + (8 << 10) > least, "{at} of {}: {} of {least}", packed.len(), found.len());
        }
    }
}

#[test]
fn every_changed_byte_with_checksums_is_noticed_and_none_is_a_panic() {
    let text = text(300);
    let checked = FrameInfo::new().block_checksums(true).content_checksum(true);
    let unchecked = FrameInfo::new().block_mode(BlockMode::Linked);
    for (packed, is_checked) in [(pack(checked, &text), true), (pack(unchecked, &text), false)] {
        for at in 4..packed.len() {
            for change in [1, 0x10, 0x80, 0xFF] {
                let mut bytes = packed.clone();
                bytes[at] ^= change;
                let (found, error) = unpack(&bytes);
                assert!(!is_checked || error.is_some() || found == text, "{at} {change}");
            }
        }
    }
    for packed in [LEGACY, LINKED].map(of_program) {
        for at in 4..packed.len() {
            let mut bytes = packed.clone();
            bytes[at] ^= 0xFF;
            assert!(unpack(&bytes).0.len() <= 16 << 20, "{at}");
        }
    }
}

/// What it says to be, not what it is: 4 GiB.
#[test]
fn a_block_larger_than_its_frame_allows_takes_no_memory() {
    let mut bytes = LEGACY_MAGIC.to_vec();
    bytes.extend(0xFFFF_FFF0_u32.to_le_bytes());
    bytes.extend([0x10; 100]);
    assert_eq!(unpack(&bytes), (Vec::new(), Some(io::ErrorKind::InvalidData)));
}
