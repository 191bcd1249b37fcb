//! The blocks of an MF4 file.

use super::super::issue::Fault;
use super::super::whole::Whole;

/// Longest block of the file's own description. Comments can be long, but only short parts of them are
/// needed.
const MAX_BLOCK_BYTES: u64 = 1 << 20;

/// A block begins with its name, four reserved bytes, its length and the number of its links.
pub(super) const BLOCK_HEAD_BYTES: u64 = 24;

/// A block: links to others, and its own fields.
#[derive(Clone, Debug)]
pub(super) struct Block {
    pub name: [u8; 4],
    pub links: Vec<u64>,
    pub data: Vec<u8>,
}

/// A block's header.
pub(super) struct Head {
    pub name: [u8; 4],
    /// Of the whole block.
    pub len: u64,
    pub links: u64,
}

/// Reads a block's fields, which are little-endian.
pub(super) fn u16_at(bytes: &[u8], at: usize) -> u16 {
    bytes.get(at..).and_then(|rest| rest.first_chunk()).map_or(0, |chunk| u16::from_le_bytes(*chunk))
}

pub(super) fn u32_at(bytes: &[u8], at: usize) -> u32 {
    bytes.get(at..).and_then(|rest| rest.first_chunk()).map_or(0, |chunk| u32::from_le_bytes(*chunk))
}

pub(super) fn u64_at(bytes: &[u8], at: usize) -> u64 {
    bytes.get(at..).and_then(|rest| rest.first_chunk()).map_or(0, |chunk| u64::from_le_bytes(*chunk))
}

impl Whole {
    /// The header of the block at an address.
    pub(super) fn head(&mut self, at: u64) -> Result<Head, Fault> {
        let bytes = self.read_at(at, BLOCK_HEAD_BYTES as usize)?;
        let damaged = || Fault::malformed(format!("a block of MDF at {at:#x}"), &bytes);
        if bytes.len() < BLOCK_HEAD_BYTES as usize {
            return Err(Fault::Truncated("what describes the measurement"));
        }
        let name: [u8; 4] = bytes.first_chunk().copied().unwrap_or_default();
        let head = Head { name, len: u64_at(&bytes, 8), links: u64_at(&bytes, 16) };
        let links_fit = head.links.checked_mul(8).is_some_and(|links| links <= head.len - head.len.min(24));
        if !name.starts_with(b"##") || head.len < BLOCK_HEAD_BYTES || !links_fit {
            return Err(damaged());
        }
        Ok(head)
    }

    /// The block at an address, which must have this name.
    pub(super) fn block(&mut self, at: u64, name: [u8; 4]) -> Result<Block, Fault> {
        /// The least number of links in these blocks: a missing one would look as if nothing followed.
        const LEAST_LINKS: [(&[u8; 4], usize); 4] = [(b"##HD", 6), (b"##DG", 4), (b"##CG", 6), (b"##CN", 8)];
        let block = self.any_block(at)?;
        let least = LEAST_LINKS.iter().find(|(of, _)| **of == name).map_or(0, |(_, least)| *least);
        if block.name == name && block.links.len() < least {
            let expected =
                format!("{least} links in the block {} at {at:#x}", String::from_utf8_lossy(&name));
            Err(Fault::malformed(expected, block.links.len().to_string().as_bytes()))
        } else if block.name == name {
            Ok(block)
        } else {
            let expected = format!("the block {} at {at:#x}", String::from_utf8_lossy(&name));
            Err(Fault::malformed(expected, &block.name))
        }
    }

    /// The block at an address, whatever its name.
    pub(super) fn any_block(&mut self, at: u64) -> Result<Block, Fault> {
        let head = self.head(at)?;
        if head.len > MAX_BLOCK_BYTES {
            return Err(Fault::malformed(format!("a block of MDF of up to 1 MiB at {at:#x}"), &head.name));
        }
        let body = self.read_at(at + BLOCK_HEAD_BYTES, (head.len - BLOCK_HEAD_BYTES) as usize)?;
        if (body.len() as u64) < head.len - BLOCK_HEAD_BYTES {
            return Err(Fault::Truncated("what describes the measurement"));
        }
        let (links, data) = body.split_at(8 * head.links as usize);
        let links = links.chunks_exact(8).map(|link| u64_at(link, 0)).collect();
        Ok(Block { name: head.name, links, data: data.to_vec() })
    }

    /// The text of a text or comment block; empty for the link 0.
    pub(super) fn text(&mut self, at: u64) -> Result<String, Fault> {
        if at == 0 {
            return Ok(String::new());
        }
        let block = self.any_block(at)?;
        let text = block.data.split(|byte| *byte == 0).next().unwrap_or_default();
        Ok(String::from_utf8_lossy(text).into_owned())
    }
}

impl Block {
    /// A link; 0, which links to nothing, if the block does not have it.
    pub(super) fn link(&self, at: usize) -> u64 {
        self.links.get(at).copied().unwrap_or(0)
    }
}
