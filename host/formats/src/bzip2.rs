//! Unpacks bzip2: blocks of up to 900 kB, each sorted by Burrows and Wheeler's transform and coded by Huffman's; streams one after another
//! are one file, as parallel packers make them. Nothing is packed here.
//!
//! Written after the description of the format by Joe Tsai ("bzip2: Format Specification", 2016). Memory: 4 bytes for each of a block.

use std::io::{self, Read};

/// How a stream begins. A digit follows: the size of its blocks.
pub(crate) const MAGIC: &[u8] = b"BZh";
const BLOCK: u64 = 0x3141_5926_5359;
const END: u64 = 0x1772_4538_5090;
/// A block's greatest size is a multiple of this.
const SIZE_STEP: usize = 100_000;
/// Codes are not longer than this.
const MOST_BITS: usize = 20;
/// So many symbols are coded by the same table.
const GROUP: usize = 50;

/// Unpacked bytes of a source.
pub(crate) struct Bzip2<R> {
    bits: Bits<R>,
    block: Block,
    /// The greatest size of a block, 0 outside a stream.
    most: usize,
    /// The checks of the blocks so far, combined.
    check: u32,
    /// Whether a block has begun whose check was not compared.
    within: bool,
    ended: bool,
}

fn damaged(what: &'static str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, what)
}

impl<R: Read> Bzip2<R> {
    pub(crate) fn new(source: R) -> Self {
        let bits = Bits { source, buffer: vec![0; 16 << 10], at: 0, end: 0, value: 0, count: 0 };
        Self { bits, block: Block::default(), most: 0, check: 0, within: false, ended: false }
    }

    /// Goes to the next block; false at the end of the last stream.
    fn next_block(&mut self) -> io::Result<bool> {
        if std::mem::take(&mut self.within) {
            if !self.block.check != self.block.expected {
                return Err(damaged("a block's check does not fit"));
            }
            self.check = self.check.rotate_left(1) ^ self.block.expected;
        }
        loop {
            if self.most == 0 && !self.begin_stream()? {
                return Ok(false);
            }
            match self.bits.take_48()? {
                BLOCK => {
                    self.block.read(&mut self.bits, self.most)?;
                    self.within = true;
                    return Ok(true);
                }
                END => {
                    if self.bits.take(32)? != self.check {
                        return Err(damaged("a stream's check does not fit"));
                    }
                    self.bits.align();
                    (self.most, self.check) = (0, 0);
                }
                _ => return Err(damaged("neither a block nor the end of the stream follows")),
            }
        }
    }

    fn begin_stream(&mut self) -> io::Result<bool> {
        if self.bits.is_at_end()? {
            return Ok(false);
        }
        for expected in MAGIC {
            if self.bits.take(8)? != u32::from(*expected) {
                return Err(damaged("something else follows the end of a stream"));
            }
        }
        match self.bits.take(8)? as u8 {
            digit @ b'1'..=b'9' => self.most = SIZE_STEP * usize::from(digit - b'0'),
            _ => return Err(damaged("a stream's head has no size of blocks")),
        }
        Ok(true)
    }
}

impl<R: Read> Read for Bzip2<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        while !out.is_empty() && !self.ended {
            let written = self.block.write(out);
            if written > 0 {
                return Ok(written);
            }
            self.ended = !self.next_block()?;
        }
        Ok(0)
    }
}

/// Bits from the most significant one.
struct Bits<R> {
    source: R,
    buffer: Vec<u8>,
    at: usize,
    end: usize,
    value: u64,
    count: u32,
}

impl<R: Read> Bits<R> {
    /// Whether no byte is left. Only between whole bytes.
    fn is_at_end(&mut self) -> io::Result<bool> {
        if self.count == 0 && self.at == self.end {
            (self.at, self.end) = (0, 0);
            loop {
                match self.source.read(&mut self.buffer) {
                    Ok(read) => {
                        self.end = read;
                        break;
                    }
                    Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                    Err(error) => return Err(error),
                }
            }
        }
        Ok(self.count == 0 && self.at == self.end)
    }

    #[inline]
    fn take(&mut self, count: u32) -> io::Result<u32> {
        while self.count < count {
            let byte = match self.buffer[..self.end].get(self.at) {
                Some(byte) => *byte,
                None => self.refill()?,
            };
            self.at += 1;
            self.value = self.value << 8 | u64::from(byte);
            self.count += 8;
        }
        self.count -= count;
        let mask = (1_u64 << count) - 1;
        Ok((self.value >> self.count & mask) as u32)
    }

    /// The first byte of more.
    #[cold]
    fn refill(&mut self) -> io::Result<u8> {
        let count = std::mem::take(&mut self.count);
        let is_at_end = self.is_at_end();
        self.count = count;
        if is_at_end? { Err(io::ErrorKind::UnexpectedEof.into()) } else { Ok(self.buffer[self.at]) }
    }

    fn take_48(&mut self) -> io::Result<u64> {
        let high = self.take(24)?;
        Ok(u64::from(high) << 24 | u64::from(self.take(24)?))
    }

    fn flag(&mut self) -> io::Result<bool> {
        self.take(1).map(|bit| bit == 1)
    }

    /// Drops what is left of a byte.
    fn align(&mut self) {
        self.count -= self.count % 8;
    }
}

/// The codes of a table: those of each length follow each other.
#[derive(Clone)]
struct Codes {
    /// The first code of each length, how many there are, and where their symbols begin.
    first: [u32; MOST_BITS + 1],
    counts: [u32; MOST_BITS + 1],
    offsets: [u32; MOST_BITS + 1],
    symbols: Vec<u16>,
}

impl Codes {
    fn of(lengths: &[u8]) -> Self {
        let mut counts = [0; MOST_BITS + 1];
        for len in lengths {
            counts[usize::from(*len)] += 1;
        }
        let (mut first, mut offsets) = ([0; MOST_BITS + 1], [0; MOST_BITS + 1]);
        let (mut code, mut offset) = (0_u32, 0);
        for len in 1..=MOST_BITS {
            code = (code + counts[len - 1]) << 1;
            first[len] = code;
            offsets[len] = offset;
            offset += counts[len];
        }
        let mut symbols: Vec<u16> = (0..lengths.len() as u16).collect();
        symbols.sort_by_key(|symbol| lengths[usize::from(*symbol)]);
        Self { first, counts, offsets, symbols }
    }

    #[inline]
    fn symbol<R: Read>(&self, bits: &mut Bits<R>) -> io::Result<u16> {
        let mut code = 0;
        for len in 1..=MOST_BITS {
            code = code << 1 | bits.take(1)?;
            let at = code.wrapping_sub(self.first[len]);
            if at < self.counts[len] {
                return Ok(self.symbols[(self.offsets[len] + at) as usize]);
            }
        }
        Err(damaged("a code stands for nothing"))
    }
}

/// A block while it is written out.
#[derive(Default)]
struct Block {
    /// For each position a byte, and above it the position that follows.
    chain: Vec<u32>,
    next: u32,
    left: usize,
    /// The last byte, how often it stood here in a row, and how often it is still to be repeated.
    last: u8,
    run: u8,
    repeat: u8,
    /// The check of what was written so far, inverted, and what it must become.
    check: u32,
    expected: u32,
}

impl Block {
    /// Reads a block after its beginning.
    fn read<R: Read>(&mut self, bits: &mut Bits<R>, most: usize) -> io::Result<()> {
        self.expected = bits.take(32)?;
        if bits.flag()? {
            return Err(damaged("a block of the kind that bzip2 0.9.0 made is not read here"));
        }
        let origin = bits.take(24)? as usize;
        let symbols = used_bytes(bits)?;
        let (tables, selectors) = tables(bits, symbols.len() + 2)?;
        self.chain.clear();
        unpack(bits, symbols, &tables, &selectors, most, &mut self.chain)?;
        if origin >= self.chain.len() {
            return Err(damaged("a block begins outside itself"));
        }
        // Where the bytes of each value begin when all are sorted.
        let mut starts = [0_u32; 256];
        for byte in &self.chain {
            starts[*byte as usize] += 1;
        }
        let mut sum = 0;
        for start in &mut starts {
            sum += std::mem::replace(start, sum);
        }
        for at in 0..self.chain.len() {
            let start = &mut starts[(self.chain[at] & 0xFF) as usize];
            self.chain[*start as usize] |= (at as u32) << 8;
            *start += 1;
        }
        self.next = self.chain[origin] >> 8;
        (self.left, self.run, self.repeat, self.check) = (self.chain.len(), 0, 0, u32::MAX);
        Ok(())
    }

    /// Writes more bytes out; 0 at the block's end.
    fn write(&mut self, out: &mut [u8]) -> usize {
        let mut written = 0;
        while written < out.len() {
            if self.repeat > 0 {
                self.repeat -= 1;
            } else if self.left > 0 {
                let entry = self.chain[self.next as usize];
                self.next = entry >> 8;
                self.left -= 1;
                let byte = entry as u8;
                // After four equal bytes, the next one says how many more there are.
                if self.run == 4 {
                    (self.run, self.repeat) = (0, byte);
                    continue;
                }
                self.run = if self.run > 0 && byte == self.last { self.run + 1 } else { 1 };
                self.last = byte;
            } else {
                break;
            }
            out[written] = self.last;
            written += 1;
            self.check = self.check << 8 ^ CRC[((self.check >> 24) as u8 ^ self.last) as usize];
        }
        written
    }
}

/// The bytes that a block has, in order.
fn used_bytes<R: Read>(bits: &mut Bits<R>) -> io::Result<Vec<u8>> {
    let rows = bits.take(16)?;
    let mut used = Vec::new();
    for row in (0..16).filter(|row| rows & (0x8000 >> row) != 0) {
        let columns = bits.take(16)?;
        used.extend(
            (0..16).filter(|column| columns & (0x8000 >> column) != 0).map(|column| row * 16 + column),
        );
    }
    if used.is_empty() { Err(damaged("a block has no bytes")) } else { Ok(used) }
}

/// The tables of codes, and which of them codes each group of symbols.
fn tables<R: Read>(bits: &mut Bits<R>, symbols: usize) -> io::Result<(Vec<Codes>, Vec<u8>)> {
    let count = bits.take(3)? as usize;
    let groups = bits.take(15)? as usize;
    if !(2..=6).contains(&count) || groups == 0 {
        return Err(damaged("a block has no tables"));
    }
    let mut recent: Vec<u8> = (0..count as u8).collect();
    let mut selectors = Vec::with_capacity(groups);
    for _ in 0..groups {
        let mut at = 0;
        while bits.flag()? {
            at += 1;
            if at >= count {
                return Err(damaged("a group of symbols has no table"));
            }
        }
        let selector = recent.remove(at);
        recent.insert(0, selector);
        selectors.push(selector);
    }
    let mut tables = Vec::with_capacity(count);
    for _ in 0..count {
        let mut len = bits.take(5)? as u8;
        let mut lengths = Vec::with_capacity(symbols);
        for _ in 0..symbols {
            loop {
                if !(1..=MOST_BITS as u8).contains(&len) {
                    return Err(damaged("a code has no length"));
                }
                if !bits.flag()? {
                    break;
                }
                len = if bits.flag()? { len - 1 } else { len + 1 };
            }
            lengths.push(len);
        }
        tables.push(Codes::of(&lengths));
    }
    Ok((tables, selectors))
}

/// Unpacks a block's sorted bytes.
fn unpack<R: Read>(
    bits: &mut Bits<R>,
    mut recent: Vec<u8>,
    tables: &[Codes],
    selectors: &[u8],
    most: usize,
    bytes: &mut Vec<u32>,
) -> io::Result<()> {
    const RUN_A: u16 = 0;
    const RUN_B: u16 = 1;
    let end = recent.len() as u16 + 1;
    let too_long = || damaged("a block is longer than its stream allows");
    // A run's length is a number of two digits, 1 and 2, the least significant first.
    let (mut run, mut digit) = (0_usize, 1_usize);
    for selector in selectors {
        let table = &tables[usize::from(*selector)];
        for _ in 0..GROUP {
            let symbol = table.symbol(bits)?;
            if let RUN_A | RUN_B = symbol {
                run += digit << symbol;
                digit <<= 1;
                if run > most {
                    return Err(too_long());
                }
                continue;
            }
            if run > 0 {
                if bytes.len() + run > most {
                    return Err(too_long());
                }
                bytes.resize(bytes.len() + run, u32::from(recent[0]));
                (run, digit) = (0, 1);
            }
            if symbol == end {
                return Ok(());
            }
            if bytes.len() >= most {
                return Err(too_long());
            }
            let byte = recent.remove(usize::from(symbol) - 1);
            recent.insert(0, byte);
            bytes.push(u32::from(byte));
        }
    }
    Err(damaged("a block has no end"))
}

/// The remainders of each byte, most significant bit first, by the polynomial 04C11DB7.
const CRC: [u32; 256] = {
    let mut table = [0; 256];
    let mut byte = 0;
    while byte < 256 {
        let mut rest = (byte as u32) << 24;
        let mut bit = 0;
        while bit < 8 {
            rest = if rest & 0x8000_0000 != 0 { rest << 1 ^ 0x04C1_1DB7 } else { rest << 1 };
            bit += 1;
        }
        table[byte] = rest;
        byte += 1;
    }
    table
};

#[cfg(test)]
mod tests {
    use super::*;
    use base64::Engine;

    /// `python3 -c "import bz2; print(bz2.compress(b'(1.0) can0 123#11\n' * 3 + b'a' * 300, 1))"`, in Base64.
    const PACKED: &str =
        "QlpoMTFBWSZTWRaBmiMAAAZZAIAQSGF4ACgBAAggADEAAAj1CGj1GlFGjg+GkWTwiBCESdKLUNY+h2b4u5IpwoSAtAzRGA==";

    fn packed() -> Vec<u8> {
        base64::engine::general_purpose::STANDARD.decode(PACKED).unwrap()
    }

    fn content() -> Vec<u8> {
        [&b"(1.0) can0 123#11\n".repeat(3)[..], &[b'a'; 300]].concat()
    }

    fn unpack(bytes: &[u8]) -> (Vec<u8>, Option<io::ErrorKind>) {
        let mut out = Vec::new();
        let result = Bzip2::new(io::Cursor::new(bytes)).read_to_end(&mut out);
        (out, result.err().map(|error| error.kind()))
    }

    #[test]
    fn streams_one_after_another_are_one_file() {
        assert_eq!(unpack(&packed()), (content(), None));
        assert_eq!(unpack(&packed().repeat(3)), (content().repeat(3), None));
    }

    #[test]
    fn a_cut_is_an_unexpected_end_and_nothing_before_it_is_lost() {
        let whole = packed().repeat(2);
        for len in 1..whole.len() {
            let (out, error) = unpack(&whole[..len]);
            let is_between = len == packed().len();
            assert_eq!(error, (!is_between).then_some(io::ErrorKind::UnexpectedEof), "{len}");
            assert!(content().repeat(2).starts_with(&out), "{len}");
            assert!(len < packed().len() || out.len() >= content().len(), "{len}");
        }
    }

    #[test]
    fn every_changed_byte_is_noticed_and_none_is_a_panic() {
        let whole = packed();
        for at in 0..whole.len() {
            for change in 1..=255 {
                let mut bytes = whole.clone();
                bytes[at] ^= change;
                let (out, error) = unpack(&bytes);
                // The last bits fill a byte up, and the size of blocks may be larger than needed.
                assert!(error.is_some() || out == content(), "{at} {change}");
            }
        }
    }
}
