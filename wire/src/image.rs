//! What a firmware image says about itself, so that it is not written to another board, and not half.
//!
//! The firmware contains an [`ImageInfo`]; the tool that turns the ELF into an image fills in its length and CRC. It has no fixed place: its
//! first bytes, [`MAGIC`], occur once.

use crate::PROTOCOL_VERSION;
use crate::framing::checksum;

/// How an [`ImageInfo`] begins.
pub const MAGIC: [u8; 16] = *b"cantap\xD7\x1E\x93\xA8\x5C\x02\xF1\x64\xBB\x0F";
/// Bytes of a board's name.
const BOARD: usize = 24;
/// Bytes of an [`ImageInfo`], and where its fields are.
const SIZE: usize = 60;
const LAYOUT_AT: usize = 16;
const PROTOCOL_AT: usize = 18;
const VERSION_AT: usize = 20;
const BOARD_AT: usize = 28;
const LENGTH_AT: usize = 52;
const CRC_AT: usize = 56;
/// The layout described here.
const LAYOUT: u16 = 1;

/// The part of a firmware that says what it is. All numbers are little-endian, as on the chip.
#[repr(C)]
pub struct ImageInfo {
    magic: [u8; 16],
    layout: u16,
    protocol: u16,
    version: [u16; 3],
    unused: u16,
    /// UTF-8, filled up with zeros.
    board: [u8; BOARD],
    /// Of the image, in bytes; 0 in the ELF.
    length: u32,
    /// CRC-32 (ISO-HDLC) of the image with zeros in its place; 0 in the ELF.
    crc: u32,
}

const _: () = assert!(size_of::<ImageInfo>() == SIZE);

impl ImageInfo {
    /// For a firmware of this version (major, minor, patch), for the board that has this name in `Hello`.
    #[must_use]
    pub const fn new(name: &str, version: [u16; 3]) -> Self {
        let name = name.as_bytes();
        assert!(name.len() <= BOARD, "the board's name is too long");
        let mut board = [0; BOARD];
        let mut at = 0;
        while at < name.len() {
            board[at] = name[at];
            at += 1;
        }
        Self {
            magic: MAGIC,
            layout: LAYOUT,
            protocol: PROTOCOL_VERSION,
            version,
            unused: 0,
            board,
            length: 0,
            crc: 0,
        }
    }
}

/// What an image is, as far as it can be trusted: its length and its CRC are right.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Image<'i> {
    /// The board's name, as in `Hello`.
    pub board: &'i str,
    /// Major, minor, patch.
    pub version: [u16; 3],
    /// The protocol version that it speaks.
    pub protocol: u16,
}

/// Why bytes are not an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ImageFault {
    /// There is no [`ImageInfo`], or more than one.
    Unknown,
    /// A later layout.
    OtherLayout,
    /// It was not finished: length and CRC are not filled in.
    Unfinished,
    /// There are fewer bytes, or more.
    Length {
        /// Bytes that there are.
        found: usize,
        /// Bytes that there should be.
        expected: u32,
    },
    /// The CRC is not right.
    Damaged,
}

/// Where the only [`ImageInfo`] begins.
fn place(image: &[u8]) -> Result<usize, ImageFault> {
    let mut places = image.windows(MAGIC.len()).enumerate().filter(|(_, window)| *window == MAGIC);
    match (places.next(), places.next()) {
        (Some((at, _)), None) if at + SIZE <= image.len() => Ok(at),
        _ => Err(ImageFault::Unknown),
    }
}

fn half(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

fn word(bytes: &[u8], at: usize) -> u32 {
    u32::from(half(bytes, at)) | u32::from(half(bytes, at + 2)) << 16
}

fn crc_without_itself(image: &[u8], at: usize) -> u32 {
    let bytes = |part: core::ops::Range<usize>| image[part].iter().copied();
    checksum(bytes(0..at + CRC_AT).chain([0; 4]).chain(bytes(at + SIZE..image.len())))
}

/// What an image is.
pub fn read(image: &[u8]) -> Result<Image<'_>, ImageFault> {
    let at = place(image)?;
    let info = &image[at..at + SIZE];
    if half(info, LAYOUT_AT) != LAYOUT {
        return Err(ImageFault::OtherLayout);
    }
    let (expected, crc) = (word(info, LENGTH_AT), word(info, CRC_AT));
    if expected == 0 {
        return Err(ImageFault::Unfinished);
    }
    if expected as usize != image.len() {
        return Err(ImageFault::Length { found: image.len(), expected });
    }
    if crc != crc_without_itself(image, at) {
        return Err(ImageFault::Damaged);
    }
    let board = &info[BOARD_AT..BOARD_AT + BOARD];
    let end = board.iter().position(|byte| *byte == 0).unwrap_or(BOARD);
    Ok(Image {
        board: core::str::from_utf8(&board[..end]).map_err(|_| ImageFault::Damaged)?,
        version: [0, 1, 2].map(|part| half(info, VERSION_AT + 2 * part)),
        protocol: half(info, PROTOCOL_AT),
    })
}

/// Fills in an image's length and CRC.
pub fn finish(image: &mut [u8]) -> Result<(), ImageFault> {
    let at = place(image)?;
    let length = u32::try_from(image.len()).map_err(|_| ImageFault::Unknown)?;
    image[at + LENGTH_AT..at + CRC_AT].copy_from_slice(&length.to_le_bytes());
    let crc = crc_without_itself(image, at);
    image[at + CRC_AT..at + SIZE].copy_from_slice(&crc.to_le_bytes());
    Ok(())
}

impl core::fmt::Display for ImageFault {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Unknown => f.write_str("it is not a firmware of cantap"),
            Self::OtherLayout => {
                f.write_str("it is a firmware for a later version of cantap; update the command first")
            }
            Self::Unfinished => {
                f.write_str("it was not made by `cargo xtask dist`, which fills in its length and CRC")
            }
            Self::Length { found, expected } if *found < *expected as usize => {
                write!(f, "only {found} of its {expected} bytes are there; fetch it again")
            }
            Self::Length { found, expected } => {
                write!(f, "it has {found} bytes instead of {expected}; fetch it again")
            }
            Self::Damaged => f.write_str("it is damaged: its CRC is wrong; fetch it again"),
        }
    }
}

impl core::error::Error for ImageFault {}

#[cfg(test)]
mod tests {
    use super::*;

    extern crate std;
    use std::vec::Vec;

    /// As the linker lays it out.
    fn bytes(info: &ImageInfo) -> Vec<u8> {
        let ImageInfo { magic, layout, protocol, version, unused, board, length, crc } = info;
        let mut bytes = magic.to_vec();
        for half in [layout, protocol, &version[0], &version[1], &version[2], unused] {
            bytes.extend(half.to_le_bytes());
        }
        bytes.extend(board);
        bytes.extend(length.to_le_bytes());
        bytes.extend(crc.to_le_bytes());
        bytes
    }

    fn image() -> Vec<u8> {
        let info = ImageInfo::new("olimex-p405", [1, 2, 3]);
        let mut image = [&[0x55; 100][..], &bytes(&info), &[0xAA; 50]].concat();
        finish(&mut image).unwrap();
        image
    }

    #[test]
    fn an_image_says_what_it_is() {
        let image = image();
        assert_eq!(
            read(&image),
            Ok(Image { board: "olimex-p405", version: [1, 2, 3], protocol: PROTOCOL_VERSION })
        );
        // Pinned: other versions of the tools must find it.
        assert_eq!(&image[100..116], b"cantap\xD7\x1E\x93\xA8\x5C\x02\xF1\x64\xBB\x0F");
        assert_eq!((&image[128..139], &image[152..156]), (&b"olimex-p405"[..], &210_u32.to_le_bytes()[..]));
    }

    #[test]
    fn half_an_image_and_any_changed_bit_are_found() {
        let whole = image();
        for len in 0..whole.len() {
            let fault = read(&whole[..len]).unwrap_err();
            assert!(matches!(fault, ImageFault::Unknown | ImageFault::Length { .. }), "{len}: {fault}");
        }
        for bit in 0..whole.len() * 8 {
            let mut damaged = whole.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert!(read(&damaged).is_err(), "{bit}");
        }
        assert_eq!(read(&[&whole[..], &[0]].concat()), Err(ImageFault::Length { found: 211, expected: 210 }));
        assert_eq!(read(&[&whole[..], &whole[..]].concat()), Err(ImageFault::Unknown));
        assert_eq!(read(&bytes(&ImageInfo::new("x", [0; 3]))), Err(ImageFault::Unfinished));
    }

    /// The person who updates a board sees these.
    #[test]
    fn every_fault_says_what_to_do() {
        for (fault, words) in [
            (ImageFault::Unknown, "not a firmware of cantap"),
            (ImageFault::OtherLayout, "update the command first"),
            (ImageFault::Unfinished, "cargo xtask dist"),
            (ImageFault::Length { found: 9, expected: 10 }, "only 9 of its 10 bytes"),
            (ImageFault::Length { found: 11, expected: 10 }, "11 bytes instead of 10"),
            (ImageFault::Damaged, "fetch it again"),
        ] {
            assert!(fault.to_string().contains(words), "{fault}");
        }
    }

    #[test]
    fn a_name_that_fills_its_field_and_an_image_that_ends_with_its_information_are_read() {
        let name = "a-board-of-twenty-four-b";
        let mut image = bytes(&ImageInfo::new(name, [1, 0, 0x1234]));
        finish(&mut image).unwrap();
        assert_eq!(read(&image).map(|image| (image.board, image.version)), Ok((name, [1, 0, 0x1234])));
        let mut later = image.clone();
        later[LAYOUT_AT] = 2;
        assert_eq!(
            (read(&later), read(&image[1..])),
            (Err(ImageFault::OtherLayout), Err(ImageFault::Unknown))
        );
    }
}
