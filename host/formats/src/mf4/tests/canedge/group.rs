//! Groups of records and their channels, as blocks of a file.

use super::super::super::encode::{Blocks, Part};

/// A channel: its type, its field, and what its values are made of.
pub struct Channel {
    pub name: &'static str,
    pub kind: u8,
    pub part: Part,
    pub conversion: u64,
    /// The number of the group with its values, or 0.
    pub values: u8,
}

/// A group and its records.
pub struct Group {
    pub number: u8,
    pub name: String,
    pub bytes: u32,
    pub time: (Part, u64),
    pub channels: Vec<Channel>,
    pub records: u64,
    pub data: Vec<u8>,
    pub values: Vec<u8>,
}

pub const VARIABLE: u8 = 1;
pub const VIRTUAL: u8 = 6;
pub const UNSIGNED: u8 = 0;
pub const FLOAT: u8 = 4;
pub const BYTES: u8 = 10;

pub fn conversion(blocks: &mut Blocks, kind: u8, values: &[f64]) -> u64 {
    let mut data = vec![kind, 0, 0, 0, 0, 0, values.len() as u8, 0];
    data.resize(24, 0);
    data.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    blocks.push(*b"##CC", &[0; 4], &data)
}

pub fn field(name: &'static str, byte: u32, bit: u8, bits: u32) -> Channel {
    Channel { name, kind: 0, part: ("", byte, bit, bits, UNSIGNED), conversion: 0, values: 0 }
}

impl Group {
    /// What its channels are parts of.
    pub fn prefix(&self) -> &str {
        match (self.name.contains("RTR"), self.name.split_once('_')) {
            (true, _) => "CAN_RemoteFrame",
            (_, Some((bus, _))) if bus.starts_with("CAN") && bus.len() == 4 => "CAN_DataFrame",
            _ => &self.name,
        }
    }

    /// Its block; `values`: where those of a variable channel are.
    pub fn block(&self, blocks: &mut Blocks, next: u64, values: u64, is_counted: bool) -> u64 {
        let prefix = self.prefix();
        let mut parts = 0;
        for channel in self.channels.iter().rev() {
            let name = blocks.text(*b"##TX", &format!("{prefix}.{}", channel.name));
            parts = blocks.channel(parts, name, [channel.kind, 0], &channel.part, [0, channel.conversion, 0]);
            if channel.values > 0 {
                super::super::patch(blocks, parts, super::super::LINK_TO_DATA, values as u32);
            }
        }
        let whole = ("", self.time.0.3 / 8, 0, 8 * self.bytes - self.time.0.3, BYTES);
        let name = blocks.text(*b"##TX", prefix);
        let whole = blocks.channel(0, name, [0, 0], &whole, [parts, 0, 0]);
        let name = blocks.text(*b"##TX", "Timestamp");
        let time = blocks.channel(whole, name, [2, 1], &self.time.0, [0, self.time.1, 0]);
        let name = blocks.text(*b"##TX", &self.name);
        let bus = if prefix.starts_with("LIN") { 3 } else { 2 };
        let source = blocks.push(*b"##SI", &[name, name, 0], &[2, bus, 0, 0, 0, 0, 0, 0]);
        let mut data = u64::from(self.number).to_le_bytes().to_vec();
        data.extend(if is_counted { self.records } else { 0 }.to_le_bytes());
        data.extend([6, 0, b'.', 0, 0, 0, 0, 0]);
        data.extend(self.bytes.to_le_bytes());
        data.extend([0; 4]);
        blocks.push(*b"##CG", &[next, time, name, source, 0, 0], &data)
    }

    pub fn has_values(&self) -> bool {
        self.channels.iter().any(|channel| channel.values > 0)
    }

    /// Its records, each with its number before it and the value behind it, by the time in the first six bytes of layouts of counters or as a
    /// floating-point number.
    pub fn rows(&self) -> Vec<(u64, Vec<u8>)> {
        let mut values = &self.values[..];
        let of_record = |record: &[u8]| {
            let time: [u8; 8] = *record.first_chunk().unwrap();
            let us = if self.time.0.4 == FLOAT {
                (f64::from_le_bytes(time) / 1000.0).round() as u64
            } else {
                u64::from_le_bytes(time) & ((1 << 48) - 1)
            };
            let mut row = [&[self.number][..], record].concat();
            if self.has_values() {
                let len = 4 + u32::from_le_bytes(*values.first_chunk().unwrap()) as usize;
                let (value, rest) = values.split_at(len);
                row.push(self.channels.iter().map(|channel| channel.values).max().unwrap());
                row.extend(value);
                values = rest;
            }
            (us, row)
        };
        self.data.chunks_exact(self.bytes as usize).map(of_record).collect()
    }
}
