//! The records of a device descriptor object pool (ISO 11783-10, annex A): what a task controller's client has and can do.

use super::identifiers;
use super::tables::FILE;
use crate::Field;
use crate::table::Table;

static ELEMENT_TYPES: Table = Table::new(FILE, "element_type");

/// More records of one pool are not shown.
const MOST_RECORDS: usize = 1000;

/// What is left of a pool.
struct Pool<'a>(&'a [u8]);

impl<'a> Pool<'a> {
    fn take(&mut self, bytes: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(bytes)?;
        self.0 = rest;
        Some(taken)
    }

    fn byte(&mut self) -> Option<u8> {
        Some(self.take(1)?[0])
    }

    fn word(&mut self) -> Option<u16> {
        self.take(2).map(|bytes| u16::from_le_bytes([bytes[0], bytes[1]]))
    }

    fn long(&mut self) -> Option<[u8; 4]> {
        self.take(4)?.try_into().ok()
    }

    /// A text behind its length.
    fn text(&mut self) -> Option<String> {
        let length = self.byte()?;
        let bytes = self.take(length.into())?;
        Some(
            String::from_utf8_lossy(bytes)
                .chars()
                .filter(|letter| !cantap_trace::clean::is_harmful(*letter))
                .collect(),
        )
    }

    /// A record's kind and what it says.
    fn record(&mut self) -> Option<(&'static str, String)> {
        let kind = self.take(3)?;
        let object = self.word()?;
        Some(match kind {
            b"DVC" => {
                let (designator, software) = (self.text()?, self.text()?);
                let name = self.take(8)?.iter().rev().fold(0, |name: u64, byte| name << 8 | u64::from(*byte));
                let serial = self.text()?;
                // The labels of structure and localization.
                self.take(14)?;
                // From version 4 on, an extended structure label, which may be empty.
                if !matches!(self.0, [b'D', b'V' | b'E' | b'P', ..] | []) {
                    self.text()?;
                }
                (
                    "device",
                    format!(
                        "{object}: {designator}, software {software}, name {name:016X}, serial number {serial}"
                    ),
                )
            }
            b"DET" => {
                let kind = self.byte()?;
                let kind = ELEMENT_TYPES.get(kind).map_or_else(|| format!("type {kind}"), str::to_owned);
                let (designator, number, parent, count) =
                    (self.text()?, self.word()?, self.word()?, self.word()?);
                let children: Option<Vec<_>> =
                    (0..count).map(|_| self.word().map(|child| child.to_string())).collect();
                let children = children?.join(" ");
                let has = if children.is_empty() { String::new() } else { format!(", has {children}") };
                ("element", format!("{object}: {designator}, element {number}, {kind}, in {parent}{has}"))
            }
            b"DPD" => {
                let (ddi, properties, triggers) = (self.word()?, self.byte()?, self.byte()?);
                let (designator, presentation) = (self.text()?, self.word()?);
                let settable = if properties & 2 == 0 { "" } else { ", settable" };
                let shown = presented(presentation);
                (
                    "process_data",
                    format!("{object}: {designator}, {}{settable}, triggers {triggers:02X}{shown}", of(ddi)),
                )
            }
            b"DPT" => {
                let (ddi, value) = (self.word()?, i32::from_le_bytes(self.long()?));
                let (designator, presentation) = (self.text()?, self.word()?);
                (
                    "property",
                    format!("{object}: {designator}, {}, {value}{}", of(ddi), presented(presentation)),
                )
            }
            b"DVP" => {
                let (offset, scale) = (i32::from_le_bytes(self.long()?), f32::from_le_bytes(self.long()?));
                let (decimals, unit) = (self.byte()?, self.text()?);
                (
                    "presentation",
                    format!("{object}: (value + {offset}) * {scale} {unit}, {decimals} decimals"),
                )
            }
            _ => return None,
        })
    }
}

fn of(ddi: u16) -> String {
    match identifiers::get(ddi) {
        Some(known) => format!("DDI {ddi} ({})", known.name),
        None => format!("DDI {ddi}"),
    }
}

/// Object FFFF is none.
fn presented(object: u16) -> String {
    if object == 0xFFFF { String::new() } else { format!(", shown by {object}") }
}

/// Adds a field for each record, and how many bytes at the end were not understood, or were too many.
pub fn fields(data: &[u8], fields: &mut Vec<Field>) {
    let mut pool = Pool(data);
    for _ in 0..MOST_RECORDS {
        let before = pool.0;
        let Some((kind, text)) = pool.record() else {
            pool.0 = before;
            break;
        };
        fields.push(Field::text(kind, text));
    }
    if !pool.0.is_empty() {
        fields.push(Field::number("not_read", pool.0.len() as i64).unit("bytes"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(data: &[u8]) -> Vec<String> {
        let mut all = Vec::new();
        fields(data, &mut all);
        all.iter().map(ToString::to_string).collect()
    }

    /// In the order of AgIsoStack++'s `get_binary_object`.
    fn pool() -> Vec<u8> {
        [
            &b"DVC\x00\x00\x07Sprayer\x031.0\x01\x02\x03\x04\x05\x06\x07\xA0\x0242"[..],
            b"LABEL01en\x00\x00\x00\x00\xFF\x00",
            b"DET\x01\x00\x03\x04Tank\x02\x00\x00\x00\x01\x00\x02\x00",
            b"DPD\x02\x00\x48\x00\x03\x09\x07Content\x04\x00",
            b"DPT\x03\x00\x86\x00\xFE\xFF\xFF\xFF\x01X\xFF\xFF",
            b"DVP\x04\x00\x00\x00\x00\x00\x6F\x12\x83\x3A\x01\x01l",
        ]
        .concat()
    }

    #[test]
    fn each_record_says_what_it_is() {
        assert_eq!(
            text(&pool()),
            [
                "device \"0: Sprayer, software 1.0, name A007060504030201, serial number 42\"",
                "element \"1: Tank, element 2, bin, in 0, has 2\"",
                "process_data \"2: Content, DDI 72 (Actual Volume Content), settable, triggers 09, shown by 4\"",
                "property \"3: X, DDI 134 (Device Element Offset X), -2\"",
                "presentation \"4: (value + 0) * 0.001 l, 1 decimals\"",
            ]
        );
    }

    #[test]
    fn what_is_cut_is_counted_at_every_place() {
        let pool = pool();
        let whole = text(&pool);
        for end in 0..pool.len() {
            let cut = text(&pool[..end]);
            assert!(
                cut.len() <= whole.len()
                    && cut.iter().all(|line| whole.contains(line) || line.starts_with("not_read"))
            );
        }
    }
}
