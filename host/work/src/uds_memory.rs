//! Memory of an ECU over UDS: download (34, 36, 37) and upload (35, 36, 37), ISO 14229-1.

use anyhow::{anyhow, bail, ensure};
use cantap_trace::counted;

use crate::memory_image::Segment;
use crate::uds::Client;

/// A block is a message of ISO 15765-2, of which classical CAN has at most so many bytes.
const MOST_MESSAGE_BYTES: usize = 4095;
/// Service and counter come before a block's data.
const BLOCK_HEAD_BYTES: usize = 2;

/// How an address and a size are written, and how data are encoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryFormat {
    /// Bytes of addresses and sizes: the low digit for addresses, the high one for sizes, as the service has it; usually 44.
    pub lengths: u8,
    /// Compression (high digit) and encryption (low digit), as the maker has them; 00 is neither.
    pub encoding: u8,
}

impl MemoryFormat {
    /// The request that begins a transfer.
    ///
    /// # Errors
    ///
    /// The address or the size needs more bytes than the format has.
    pub fn request(self, service: u8, address: u32, size: usize) -> anyhow::Result<Vec<u8>> {
        let mut request = vec![service, self.encoding, self.lengths];
        for (name, number, bytes) in [
            ("address", u64::from(address), usize::from(self.lengths & 15)),
            ("size", size as u64, usize::from(self.lengths >> 4)),
        ] {
            ensure!((1..=8).contains(&bytes), "{name}s have 1 to 8 bytes, not {bytes}: check --lengths");
            let all = number.to_be_bytes();
            let (before, own) = all.split_at(all.len() - bytes);
            ensure!(
                before.iter().all(|byte| *byte == 0),
                "the {name} {number:X} needs more than {bytes}: check --lengths",
                bytes = counted(bytes, "byte")
            );
            request.extend(own);
        }
        Ok(request)
    }
}

/// The data bytes of a block, by the answer to the request that begins a transfer.
fn block_bytes(answer: &[u8]) -> anyhow::Result<usize> {
    let wrong = || anyhow!("the ECU's answer does not say how long a block may be");
    let [_, lengths, rest @ ..] = answer else { return Err(wrong()) };
    let number =
        rest.get(..usize::from(lengths >> 4)).filter(|number| !number.is_empty()).ok_or_else(wrong)?;
    let longest =
        number.iter().fold(0_usize, |number, byte| number.saturating_mul(256).saturating_add((*byte).into()));
    ensure!(
        longest > BLOCK_HEAD_BYTES,
        "the ECU takes blocks of {longest}, which have no room for data",
        longest = counted(longest, "byte")
    );
    Ok(longest.min(MOST_MESSAGE_BYTES) - BLOCK_HEAD_BYTES)
}

/// Writes bytes to memory.
///
/// # Errors
///
/// A refusal, an answer to another block, or a transfer that broke off; says how much of it was taken.
pub fn download(client: &mut Client<'_>, segment: &Segment, format: MemoryFormat) -> anyhow::Result<()> {
    let begun = client.ask_and_show(&format.request(0x34, segment.address, segment.data.len())?)?;
    let each = block_bytes(&begun.data)?;
    let mut counter = 0_u8;
    for (number, block) in segment.data.chunks(each).enumerate() {
        counter = counter.wrapping_add(1);
        let taken = || format!("{} of {} taken", number * each, counted(segment.data.len(), "byte"));
        let answer = client
            .ask_and_show(&[&[0x36, counter], block].concat())
            .map_err(|error| anyhow!("{error}; {}", taken()))?;
        ensure!(
            answer.data.get(1) == Some(&counter),
            "the ECU answered another block than {counter:02X}; {}",
            taken()
        );
    }
    client.ask_and_show(&[0x37]).map(drop)
}

/// Reads bytes from memory.
///
/// # Errors
///
/// A refusal, an answer to another block, or more or fewer bytes than were asked for.
pub fn upload(
    client: &mut Client<'_>,
    address: u32,
    size: usize,
    format: MemoryFormat,
) -> anyhow::Result<Vec<u8>> {
    let begun = client.ask_and_show(&format.request(0x35, address, size)?)?;
    block_bytes(&begun.data)?;
    let mut data = Vec::new();
    let mut counter = 0_u8;
    while data.len() < size {
        counter = counter.wrapping_add(1);
        let answer = client.ask_and_show(&[0x36, counter]).map_err(|error| {
            anyhow!("{error}; {} of {size} had come", data.len(), size = counted(size, "byte"))
        })?;
        match &answer.data[..] {
            [_, number, block @ ..] if *number == counter && !block.is_empty() => data.extend(block),
            _ => bail!(
                "the ECU answered another block than {counter:02X}, or without bytes; {} of {size} had come",
                data.len(),
                size = counted(size, "byte")
            ),
        }
    }
    ensure!(data.len() == size, "the ECU sent {} in place of {size}", counted(data.len(), "byte"));
    client.ask_and_show(&[0x37])?;
    Ok(data)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_has_as_many_bytes_as_its_format_says() {
        let format = MemoryFormat { lengths: 0x24, encoding: 0x11 };
        let request = format.request(0x34, 0x0800_1234, 0x1000).unwrap();
        assert_eq!(request, [0x34, 0x11, 0x24, 0x08, 0, 0x12, 0x34, 0x10, 0]);
        assert!(format.request(0x34, 0, 0x1_0000).unwrap_err().to_string().contains("--lengths"));
        let none = MemoryFormat { lengths: 0x04, encoding: 0 };
        assert!(none.request(0x34, 0, 1).unwrap_err().to_string().contains("not 0"));
    }

    #[test]
    fn blocks_are_as_long_as_the_ecu_says_and_a_message_may_be() {
        assert_eq!(block_bytes(&[0x74, 0x20, 0x01, 0x02]).unwrap(), 0x100);
        assert_eq!(block_bytes(&[0x74, 0x40, 0xFF, 0xFF, 0xFF, 0xFF]).unwrap(), 4093);
        for answer in [&[0x74][..], &[0x74, 0x00], &[0x74, 0x20, 0x01], &[0x74, 0x10, 0x02]] {
            assert!(block_bytes(answer).is_err(), "{answer:02X?}");
        }
    }
}
