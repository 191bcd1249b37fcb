//! USB/IP, version 1.1.1, as the kernel's `Documentation/usb/usbip_protocol.rst` describes it: all fields are big-endian, the
//! data is as on the bus.

use std::io::{self, Read};

use super::exported::Exported;
use super::urb::{Completion, Urb};

const VERSION: u32 = 0x0111;
const LIST: u16 = 0x8005;
const LIST_REPLY: u32 = 0x0005;
const IMPORT: u16 = 0x8003;
const IMPORT_REPLY: u32 = 0x0003;
const SUBMIT: u32 = 1;
const UNLINK: u32 = 2;
const SUBMITTED: u32 = 3;
const UNLINKED: u32 = 4;
/// A transfer that ends with a full packet is followed by an empty one (the kernel's URB_ZERO_PACKET).
const ZERO_PACKET: u32 = 0x40;
/// Longest transfer accepted. The kernel's drivers for serial ports ask for a few kilobytes.
const MAX_TRANSFER: usize = 1 << 20;
/// Bytes of a bus ID, padded with zeros.
const BUS_ID_BYTES: usize = 32;

/// What a connection is for.
#[derive(Debug, PartialEq, Eq)]
pub enum Opening {
    /// A list of what is exported.
    List,
    /// A device, by its bus ID; URBs follow.
    Import(String),
}

/// What a kernel sends once it has a device.
#[derive(Debug, PartialEq, Eq)]
pub enum Message {
    /// A transfer.
    Submit(Urb),
    /// A transfer is withdrawn.
    Unlink {
        /// This message's number.
        seq: u32,
        /// The transfer's.
        victim: u32,
    },
}

fn array<const N: usize>(from: &mut impl Read) -> io::Result<[u8; N]> {
    let mut bytes = [0; N];
    from.read_exact(&mut bytes)?;
    Ok(bytes)
}

fn word(header: &[u8], at: usize) -> u32 {
    u32::from_be_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]])
}

fn words(words: &[u32]) -> Vec<u8> {
    words.iter().flat_map(|word| word.to_be_bytes()).collect()
}

fn invalid(what: &'static str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, what)
}

/// Reads how a connection begins.
pub fn read_opening(from: &mut impl Read) -> io::Result<Opening> {
    let [_, _, high, low, ..] = array::<8>(from)?;
    match u16::from_be_bytes([high, low]) {
        LIST => Ok(Opening::List),
        IMPORT => {
            let name = array::<BUS_ID_BYTES>(from)?;
            let end = name.iter().position(|byte| *byte == 0).unwrap_or(BUS_ID_BYTES);
            Ok(Opening::Import(String::from_utf8_lossy(&name[..end]).into_owned()))
        }
        _ => Err(invalid("neither a list nor an import was asked for")),
    }
}

/// Reads a message of a kernel that has the device.
pub fn read_message(from: &mut impl Read) -> io::Result<Message> {
    let header = array::<48>(from)?;
    let seq = word(&header, 4);
    match word(&header, 0) {
        SUBMIT => {}
        UNLINK => return Ok(Message::Unlink { seq, victim: word(&header, 20) }),
        _ => return Err(invalid("neither a submission nor an unlinking")),
    }
    let (input, length) = (word(&header, 12) == 1, word(&header, 24) as usize);
    if length > MAX_TRANSFER {
        return Err(invalid("a transfer of more than a megabyte"));
    }
    let mut data = vec![0; if input { 0 } else { length }];
    from.read_exact(&mut data)?;
    let [.., s0, s1, s2, s3, s4, s5, s6, s7] = header;
    Ok(Message::Submit(Urb {
        seq,
        endpoint: word(&header, 16) as u8 & 15 | if input { 0x80 } else { 0 },
        length,
        interval: word(&header, 36),
        zero_packet: word(&header, 20) & ZERO_PACKET != 0,
        setup: [s0, s1, s2, s3, s4, s5, s6, s7],
        data,
        ..Urb::default()
    }))
}

/// The list of the one device.
pub fn list(exported: &Exported) -> Vec<u8> {
    let mut reply = words(&[VERSION << 16 | LIST_REPLY, 0, 1]);
    reply.extend(exported.record());
    reply.extend(exported.interfaces());
    reply
}

/// The answer to an import, which is refused if there is no device.
pub fn imported(exported: Option<&Exported>) -> Vec<u8> {
    let mut reply = words(&[VERSION << 16 | IMPORT_REPLY, u32::from(exported.is_none())]);
    reply.extend(exported.into_iter().flat_map(Exported::record));
    reply
}

/// A transfer has ended.
pub fn submitted(completion: &Completion) -> Vec<u8> {
    let Completion { seq, status, actual, data } = completion;
    let mut reply = words(&[SUBMITTED, *seq, 0, 0, 0, *status as u32, *actual as u32, 0, 0, 0, 0, 0]);
    reply.extend(data);
    reply
}

/// A transfer was withdrawn (`status` is then ECONNRESET), or had already ended (0).
pub fn unlinked(seq: u32, status: i32) -> Vec<u8> {
    words(&[UNLINKED, seq, 0, 0, 0, status as u32, 0, 0, 0, 0, 0, 0])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An import of "1-1", byte by byte.
    #[test]
    fn an_import_names_a_device() {
        let mut bytes = vec![1, 0x11, 0x80, 3, 0, 0, 0, 0];
        bytes.extend(b"1-1");
        bytes.resize(40, 0);
        assert_eq!(read_opening(&mut &bytes[..]).unwrap(), Opening::Import("1-1".to_owned()));
        assert_eq!(read_opening(&mut &[1, 0x11, 0x80, 5, 0, 0, 0, 0][..]).unwrap(), Opening::List);
        assert!(read_opening(&mut &[1, 0x11, 0x80, 4, 0, 0, 0, 0][..]).is_err());
        assert!(read_opening(&mut &bytes[..39]).is_err());
    }

    #[test]
    fn a_control_transfer_that_carries_data_out_is_read_with_it() {
        let mut bytes = words(&[1, 7, 0x1_0002, 0, 0, 0x40, 2, 0, 0, 0]);
        bytes.extend([0x21, 0x20, 0, 0, 0, 0, 2, 0, 0xAB, 0xCD]);
        let Message::Submit(urb) = read_message(&mut &bytes[..]).unwrap() else { panic!() };
        assert_eq!((urb.seq, urb.endpoint, urb.length, urb.zero_packet), (7, 0, 2, true));
        assert_eq!((urb.setup, &urb.data[..]), ([0x21, 0x20, 0, 0, 0, 0, 2, 0], &[0xAB, 0xCD][..]));
        assert!(read_message(&mut &bytes[..49]).is_err());
    }

    #[test]
    fn a_read_carries_no_data_and_a_huge_one_is_refused() {
        let read = |length: u32| {
            let mut bytes = words(&[1, 8, 0x1_0002, 1, 2, 0, length, 0, 0, 16]);
            bytes.extend([0; 8]);
            read_message(&mut &bytes[..])
        };
        let Message::Submit(urb) = read(128).unwrap() else { panic!() };
        assert_eq!((urb.endpoint, urb.length, urb.interval, urb.data.len()), (0x82, 128, 16, 0));
        assert!(read(u32::MAX).is_err());
    }

    #[test]
    fn transfers_are_taken_back_by_number() {
        let bytes = words(&[2, 9, 0x1_0002, 0, 0, 8, 0, 0, 0, 0, 0, 0]);
        assert_eq!(read_message(&mut &bytes[..]).unwrap(), Message::Unlink { seq: 9, victim: 8 });
        assert_eq!(unlinked(9, -104)[..24], words(&[4, 9, 0, 0, 0, -104_i32 as u32]));
        assert_eq!(unlinked(9, 0).len(), 48);
    }

    #[test]
    fn an_end_carries_status_length_and_data() {
        let end = submitted(&Completion { seq: 3, status: -32, actual: 2, data: vec![1, 2] });
        assert_eq!(end.len(), 50);
        assert_eq!(end[..28], words(&[3, 3, 0, 0, 0, -32_i32 as u32, 2]));
        assert_eq!(end[48..], [1, 2]);
    }

    #[test]
    fn an_import_is_refused_without_a_record() {
        assert_eq!(imported(None), [1, 0x11, 0, 3, 0, 0, 0, 1]);
    }
}
