//! What is to be written to an ECU's memory: Intel HEX, Motorola S-records, or plain bytes.
//!
//! Every line's checksum is compared, every line belongs to the format, and no byte is given twice: a file that is damaged is refused before
//! anything is sent.

use std::collections::BTreeMap;

/// Bytes with their addresses.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct MemoryImage {
    /// Consecutive bytes by the address of their first, in order; none touches the next.
    pub segments: Vec<Segment>,
}

/// Consecutive bytes.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Segment {
    /// Of the first byte.
    pub address: u32,
    /// At least one byte.
    pub data: Vec<u8>,
}

/// Why a file is no image.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ImageError {
    /// A line that does not belong to the format.
    #[error("line {line}: {what}")]
    Line {
        /// From 1.
        line: usize,
        /// What is wrong with it.
        what: &'static str,
    },
    /// The end of the file is missing.
    #[error("it has no end record, so its end may be missing")]
    NoEnd,
    /// It has no bytes.
    #[error("it has no bytes to write")]
    Empty,
    /// Two lines are for the same address.
    #[error("address {0:08X} is given twice")]
    Twice(u32),
    /// Plain bytes do not say where they belong.
    #[error(
        "it is neither Intel HEX nor S-records, and plain bytes do not say where they belong; give --memory-address"
    )]
    NoAddress,
    /// An address was given for a file that has its own.
    #[error("it has its own addresses; leave --memory-address out, or convert it to plain bytes first")]
    OwnAddresses,
    /// Bytes end after the last 32-bit address.
    #[error("its bytes would end after address FFFFFFFF")]
    TooHigh,
}

impl MemoryImage {
    /// Reads a file. Plain bytes need an `address`; the other two formats have their own.
    ///
    /// # Errors
    ///
    /// Anything that is not as the format has it, with its line.
    pub fn read(file: &[u8], address: Option<u32>) -> Result<Self, ImageError> {
        let text = std::str::from_utf8(file).ok().filter(|text| text.is_ascii());
        let first = text.and_then(|text| text.trim_start().chars().next());
        let is_records = |text: &str| text.trim_start().as_bytes().get(1).is_some_and(u8::is_ascii_digit);
        match (first, text) {
            (Some(':'), Some(text)) if address.is_none() => intel_hex(text),
            (Some('S'), Some(text)) if address.is_none() && is_records(text) => s_records(text),
            (Some(':'), Some(text)) if intel_hex(text).is_ok() => Err(ImageError::OwnAddresses),
            (Some('S'), Some(text)) if s_records(text).is_ok() => Err(ImageError::OwnAddresses),
            _ => {
                let address = address.ok_or(ImageError::NoAddress)?;
                let mut bytes = Bytes::default();
                bytes.put(u64::from(address), file)?;
                bytes.joined()
            }
        }
    }

    /// How many bytes it has.
    pub fn len(&self) -> usize {
        self.segments.iter().map(|segment| segment.data.len()).sum()
    }

    /// Whether it has none.
    pub const fn is_empty(&self) -> bool {
        self.segments.is_empty()
    }
}

/// Bytes by address, as lines give them.
#[derive(Default)]
struct Bytes {
    parts: BTreeMap<u32, Vec<u8>>,
}

impl Bytes {
    fn put(&mut self, address: u64, data: &[u8]) -> Result<(), ImageError> {
        if data.is_empty() {
            return Ok(());
        }
        let end = address + data.len() as u64;
        let address = u32::try_from(address).ok().filter(|_| end <= 1 << 32).ok_or(ImageError::TooHigh)?;
        match self.parts.insert(address, data.to_vec()) {
            None => Ok(()),
            Some(_) => Err(ImageError::Twice(address)),
        }
    }

    /// Parts that follow each other become one.
    fn joined(self) -> Result<MemoryImage, ImageError> {
        let mut segments: Vec<Segment> = Vec::new();
        for (address, data) in self.parts {
            if let Some(last) = segments.last_mut() {
                let end = u64::from(last.address) + last.data.len() as u64;
                if u64::from(address) < end {
                    return Err(ImageError::Twice(address));
                }
                if u64::from(address) == end {
                    last.data.extend(data);
                    continue;
                }
            }
            segments.push(Segment { address, data });
        }
        if segments.is_empty() { Err(ImageError::Empty) } else { Ok(MemoryImage { segments }) }
    }
}

/// The bytes that a line's hexadecimal digits stand for.
fn digits(text: &str) -> Option<Vec<u8>> {
    let pairs = text.as_bytes().chunks(2);
    pairs
        .map(|pair| {
            let pair = std::str::from_utf8(pair).ok().filter(|pair| pair.len() == 2)?;
            pair.bytes().all(|digit| digit.is_ascii_hexdigit()).then(|| u8::from_str_radix(pair, 16).ok())?
        })
        .collect()
}

/// Intel's "Hexadecimal Object File Format Specification", revision A (1988): `:`, length, address, type, data, checksum.
fn intel_hex(text: &str) -> Result<MemoryImage, ImageError> {
    let mut bytes = Bytes::default();
    let (mut base, mut is_segmented, mut has_end) = (0_u64, false, false);
    for (line, record) in (1..).zip(text.lines().map(str::trim)).filter(|(_, record)| !record.is_empty()) {
        let wrong = |what| ImageError::Line { line, what };
        if has_end {
            return Err(wrong("it comes after the end record"));
        }
        let record = record.strip_prefix(':').ok_or_else(|| wrong("it does not begin with ':'"))?;
        let record = digits(record).ok_or_else(|| wrong("it is not in pairs of hexadecimal digits"))?;
        if record.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte)) != 0 {
            return Err(wrong("its checksum is wrong"));
        }
        let [length, high, low, kind, data @ .., _] = &record[..] else {
            return Err(wrong("it is too short"));
        };
        if usize::from(*length) != data.len() {
            return Err(wrong("it does not have the length that it says"));
        }
        let offset = u64::from(u16::from_be_bytes([*high, *low]));
        match (kind, data) {
            (0, data) if is_segmented => {
                // Within a segment, addresses wrap at 64 KiB.
                let (before, after) = data.split_at(data.len().min((0x1_0000 - offset) as usize));
                bytes.put(base + offset, before)?;
                bytes.put(base, after)?;
            }
            (0, data) => bytes.put(base + offset, data)?,
            (1, []) => has_end = true,
            (2, [high, low]) => {
                (base, is_segmented) = (u64::from(u16::from_be_bytes([*high, *low])) << 4, true);
            }
            (4, [high, low]) => {
                (base, is_segmented) = (u64::from(u16::from_be_bytes([*high, *low])) << 16, false);
            }
            // Where a program starts.
            (3 | 5, [_, _, _, _]) => {}
            _ => return Err(wrong("there is no record of this type and length")),
        }
    }
    if has_end { bytes.joined() } else { Err(ImageError::NoEnd) }
}

/// Motorola's S-records: `S`, type, length, address, data, checksum.
fn s_records(text: &str) -> Result<MemoryImage, ImageError> {
    let mut bytes = Bytes::default();
    let (mut count, mut has_end) = (0_u32, false);
    for (line, record) in (1..).zip(text.lines().map(str::trim)).filter(|(_, record)| !record.is_empty()) {
        let wrong = |what| ImageError::Line { line, what };
        if has_end {
            return Err(wrong("it comes after the end record"));
        }
        let kind = record.strip_prefix('S').and_then(|rest| rest.chars().next());
        let kind = kind
            .and_then(|kind| kind.to_digit(10))
            .ok_or_else(|| wrong("it does not begin with S0 to S9"))?;
        let record = digits(&record[2..]).ok_or_else(|| wrong("it is not in pairs of hexadecimal digits"))?;
        let [length, content @ .., sum] = &record[..] else { return Err(wrong("it is too short")) };
        if usize::from(*length) != content.len() + 1 {
            return Err(wrong("it does not have the length that it says"));
        }
        if content.iter().fold(length.wrapping_add(*sum), |sum, byte| sum.wrapping_add(*byte)) != 0xFF {
            return Err(wrong("its checksum is wrong"));
        }
        let address_bytes = match kind {
            0 | 1 | 5 | 9 => 2,
            2 | 6 | 8 => 3,
            3 | 7 => 4,
            _ => return Err(wrong("there is no record of this type")),
        };
        let (address, data) =
            content.split_at_checked(address_bytes).ok_or_else(|| wrong("it is too short"))?;
        let address = address.iter().fold(0_u64, |address, byte| address << 8 | u64::from(*byte));
        match kind {
            1..=3 => {
                count += 1;
                bytes.put(address, data)?;
            }
            5 | 6 if address != u64::from(count) => {
                return Err(wrong("so many records did not come before it: some are missing"));
            }
            7..=9 => has_end = true,
            _ => {}
        }
    }
    if has_end { bytes.joined() } else { Err(ImageError::NoEnd) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn segments(file: &str) -> Result<Vec<(u32, Vec<u8>)>, ImageError> {
        let image = MemoryImage::read(file.as_bytes(), None)?;
        Ok(image.segments.into_iter().map(|segment| (segment.address, segment.data)).collect())
    }

    /// Lines of Intel's and Motorola's own descriptions as they are reprinted everywhere.
    #[test]
    fn both_formats_are_read_with_their_addresses() {
        let hex = ":10010000214601360121470136007EFE09D2190140\n:100110002146017E17C20001FF5F16002148011928\n:00000001FF\n";
        let read = segments(hex).unwrap();
        assert_eq!((read.len(), read[0].0, read[0].1.len(), read[0].1[16]), (1, 0x100, 32, 0x21));
        let read = segments(
            ":020000040800F2\n:0200000001FFFE\n:020000021200EA\n:0100100055 9A\n:00000001FF"
                .replace(' ', "")
                .as_str(),
        );
        assert_eq!(read.unwrap(), [(0x1_2010, vec![0x55]), (0x0800_0000, vec![1, 0xFF])]);
        let records = "S00F000068656C6C6F202020202000003C\n\
                       S11F00007C0802A6900100049421FFF07C6C1B787C8C23783C6000003863000026\n\
                       S11F001C4BFFFFE5398000007D83637880010014382100107C0803A64E800020E9\n\
                       S111003848656C6C6F20776F726C642E0A0042\nS5030003F9\nS9030000FC\n";
        let read = segments(records).unwrap();
        assert_eq!((read.len(), read[0].0, read[0].1.len()), (1, 0, 70));
        assert!(read[0].1.ends_with(b"Hello world.\n\0"));
    }

    #[test]
    fn a_damaged_file_is_refused_with_its_line() {
        for (file, expected) in [
            (":0100100055 99\n:00000001FF", "line 1: its checksum is wrong"),
            (":01001000559A", "it has no end record"),
            (":0200100055 99\n:00000001FF", "line 1: it does not have the length"),
            (":01001000559A\n:01001000559A\n:00000001FF", "00000010 is given twice"),
            (":01001000559A\nhello\n:00000001FF", "line 2: it does not begin with ':'"),
            (":00000001FF", "no bytes"),
            (":00000001FF\n:01001000559A", "line 2: it comes after the end"),
            ("S1040000AA50\nS9030000FC", "line 1: its checksum is wrong"),
            ("S1040000AA51\nS5030002FA\nS9030000FC", "line 2: so many records"),
            ("S1040000AA51\nS1050000AABB95\nS9030000FC", "00000000 is given twice"),
            ("S1050000AABB95\nS1040001AA50\nS9030000FC", "00000001 is given twice"),
            ("S1040000AA51", "it has no end record"),
            ("S4040000AA51", "line 1: there is no record of this type"),
            ("\u{0}\u{1}", "give --memory-address"),
        ] {
            let error = segments(&file.replace(' ', "")).unwrap_err().to_string();
            assert!(error.contains(expected), "{file}: {error}");
        }
    }

    #[test]
    fn plain_bytes_need_an_address() {
        let image = MemoryImage::read(&[1, 2, 3], Some(0x2000)).unwrap();
        assert_eq!(image, MemoryImage { segments: vec![Segment { address: 0x2000, data: vec![1, 2, 3] }] });
        assert_eq!(MemoryImage::read(&[1, 2], Some(u32::MAX)), Err(ImageError::TooHigh));
        assert_eq!(MemoryImage::read(b":01001000559A\n:00000001FF", Some(0)), Err(ImageError::OwnAddresses));
    }
}
