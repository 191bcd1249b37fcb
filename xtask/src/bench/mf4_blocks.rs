//! An MF4 file whose data is in many blocks that lists name, as loggers write it: ours has a single block.

use std::fs::File;
use std::io::{BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::Path;

use anyhow::{Result, ensure};

/// Where a file has its header, and there the link to the first group of data, which has its own link to the data.
const FIRST_GROUP_AT: u64 = 64 + HEAD_BYTES;
const DATA_LINK: u64 = HEAD_BYTES + 2 * 8;
/// Of every block: name, four bytes, length, number of links.
const HEAD_BYTES: u64 = 24;
/// Blocks that one list names.
const IN_A_LIST: usize = 4096;

fn head(name: [u8; 4], links: u64, len: u64) -> Vec<u8> {
    let mut head = name.to_vec();
    head.extend([0; 4]);
    head.extend((HEAD_BYTES + 8 * links + len).to_le_bytes());
    head.extend(links.to_le_bytes());
    head
}

/// Writes a file of ours with its data in blocks of this many bytes, a multiple of eight; returns how many these are.
pub fn in_blocks(from: &Path, to: &Path, block_bytes: u64) -> Result<usize> {
    let mut from = BufReader::with_capacity(1 << 20, File::open(from)?);
    let mut link_at = |at: u64| -> Result<u64> {
        let mut bytes = [0; 8];
        from.seek(SeekFrom::Start(at))?;
        from.read_exact(&mut bytes)?;
        Ok(u64::from_le_bytes(bytes))
    };
    let group = link_at(FIRST_GROUP_AT)?;
    let data = link_at(group + DATA_LINK)?;
    let mut left = link_at(data + 8)? - HEAD_BYTES;
    from.seek(SeekFrom::Start(0))?;
    let mut out = BufWriter::with_capacity(1 << 20, File::create(to)?);
    ensure!(std::io::copy(&mut from.by_ref().take(data), &mut out)? == data, "the file is too short");
    from.seek(SeekFrom::Start(data + HEAD_BYTES))?;
    let (mut at, mut blocks) = (data, Vec::new());
    while left > 0 {
        let len = left.min(block_bytes);
        out.write_all(&head(*b"##DT", 0, len))?;
        ensure!(std::io::copy(&mut from.by_ref().take(len), &mut out)? == len, "the file is too short");
        blocks.push(at);
        let filled = (HEAD_BYTES + len).next_multiple_of(8);
        out.write_all(&vec![0; (filled - HEAD_BYTES - len) as usize])?;
        (at, left) = (at + filled, left - len);
    }
    let lists = at;
    for (place, list) in blocks.chunks(IN_A_LIST).enumerate() {
        let links = 1 + list.len() as u64;
        // All blocks but the last one are equally long: this flag, the number of blocks, the length.
        let mut fields = vec![1, 0, 0, 0];
        fields.extend((list.len() as u32).to_le_bytes());
        fields.extend(block_bytes.to_le_bytes());
        at += HEAD_BYTES + 8 * links + fields.len() as u64;
        let is_last = (place + 1) * IN_A_LIST >= blocks.len();
        let next = if is_last { 0 } else { at };
        out.write_all(&head(*b"##DL", links, fields.len() as u64))?;
        for link in std::iter::once(&next).chain(list) {
            out.write_all(&link.to_le_bytes())?;
        }
        out.write_all(&fields)?;
    }
    out.flush()?;
    out.seek(SeekFrom::Start(group + DATA_LINK))?;
    out.write_all(&lists.to_le_bytes())?;
    out.flush()?;
    Ok(blocks.len())
}
