//! CANboat's database of parameter groups, in `data/`.

use std::io::Read;
use std::sync::OnceLock;

use rustc_hash::FxHashMap;
use serde::Deserialize;

/// The database as published by its project.
const COMPRESSED: &[u8] = include_bytes!("../../data/canboat.json.gz");

/// All groups and the tables to which their fields refer.
#[derive(Debug, Default)]
pub struct Database {
    /// Sorted by number, then in the order of the file.
    groups: Vec<Group>,
    /// The index of the first group with a number, and how many there are.
    places: FxHashMap<u32, (usize, usize)>,
    /// The indexes of the groups for ranges of numbers, by first number.
    fallbacks: Vec<usize>,
    pub lookups: FxHashMap<String, FxHashMap<u64, String>>,
    pub bits: FxHashMap<String, FxHashMap<u64, String>>,
    /// By the value of the other field and that of this one.
    pub indirect: FxHashMap<String, FxHashMap<(u64, u64), String>>,
    pub kinds: FxHashMap<String, FxHashMap<u64, Key>>,
    /// Number of entries in the file.
    #[cfg(test)]
    pub entries: usize,
}

/// A group, or one of several that share a number.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "PascalCase")]
pub struct Group {
    #[serde(rename = "PGN")]
    pub pgn: u32,
    pub description: String,
    #[serde(rename = "Type")]
    pub kind: String,
    /// 0 to 7, where it is known.
    pub priority: Option<u8>,
    #[serde(default)]
    pub fallback: bool,
    pub fields: Vec<FieldKind>,
    #[serde(rename = "RepeatingFieldSet1Size", default)]
    pub set_1_size: usize,
    #[serde(rename = "RepeatingFieldSet1StartField", default)]
    pub set_1_start: usize,
    #[serde(rename = "RepeatingFieldSet1CountField", default)]
    pub set_1_count: usize,
    #[serde(rename = "RepeatingFieldSet2Size", default)]
    pub set_2_size: usize,
    #[serde(rename = "RepeatingFieldSet2StartField", default)]
    pub set_2_start: usize,
    #[serde(rename = "RepeatingFieldSet2CountField", default)]
    pub set_2_count: usize,
}

/// How to interpret a field's bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum Kind {
    Number,
    Lookup,
    Reserved,
    Binary,
    Duration,
    StringLau,
    Spare,
    StringFix,
    Mmsi,
    Bitlookup,
    Time,
    StringLz,
    Date,
    Pgn,
    IsoName,
    FieldIndex,
    Variable,
    Float,
    Decimal,
    DynamicFieldKey,
    DynamicFieldValue,
    IndirectLookup,
    DynamicFieldLength,
    #[serde(other)]
    Unknown,
}

/// When a field is there.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Eq)]
pub enum Condition {
    /// If the group that was named before is a manufacturer's own.
    #[serde(rename = "PGNIsProprietary")]
    PgnIsProprietary,
    #[serde(other)]
    Unknown,
}

/// A field of a group.
#[derive(Clone, Debug, Deserialize)]
#[serde(rename_all = "PascalCase")]
pub struct FieldKind {
    pub name: String,
    pub field_type: Kind,
    #[serde(default)]
    pub bit_length: usize,
    pub bit_offset: Option<usize>,
    #[serde(default)]
    pub bit_length_variable: bool,
    /// The place of the field that has its length in bits, from 1.
    pub bit_length_field: Option<usize>,
    pub resolution: Option<f64>,
    #[serde(default)]
    pub signed: bool,
    #[serde(default)]
    pub offset: f64,
    pub range_min: Option<f64>,
    pub range_max: Option<f64>,
    pub condition: Option<Condition>,
    #[serde(default)]
    pub unit: String,
    #[serde(rename = "Match")]
    pub wanted: Option<u64>,
    pub lookup_enumeration: Option<String>,
    pub lookup_bit_enumeration: Option<String>,
    pub lookup_indirect_enumeration: Option<String>,
    pub lookup_indirect_enumeration_field_order: Option<usize>,
    pub lookup_field_type_enumeration: Option<String>,
}

/// The meaning of a key in a key-value pair.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "PascalCase")]
pub struct Key {
    #[serde(rename = "name")]
    pub name: String,
    #[serde(rename = "value")]
    pub value: u64,
    pub field_type: Kind,
    pub resolution: Option<f64>,
    #[serde(default)]
    pub unit: String,
    #[serde(default)]
    pub bits: String,
    #[serde(default)]
    pub signed: bool,
    pub lookup_enumeration: Option<String>,
    pub lookup_bit_enumeration: Option<String>,
}

#[derive(Default, Deserialize)]
#[serde(rename_all = "PascalCase", default)]
struct File {
    #[serde(rename = "PGNs")]
    groups: Vec<Group>,
    lookup_enumerations: Vec<Table>,
    lookup_bit_enumerations: Vec<Table>,
    lookup_indirect_enumerations: Vec<Table>,
    lookup_field_type_enumerations: Vec<Table>,
}

#[derive(Default, Deserialize)]
#[serde(rename_all = "PascalCase", default)]
struct Table {
    name: String,
    enum_values: Vec<Entry>,
    enum_bit_values: Vec<Entry>,
    enum_field_type_values: Vec<Key>,
}

#[derive(Deserialize)]
#[serde(rename_all = "PascalCase")]
struct Entry {
    name: String,
    value: Option<u64>,
    value1: Option<u64>,
    value2: Option<u64>,
    bit: Option<u64>,
}

impl Database {
    /// The database, parsed when first used. It is empty if the built-in file cannot be parsed, which a test rules out.
    pub fn get() -> &'static Self {
        static DATABASE: OnceLock<Database> = OnceLock::new();
        DATABASE.get_or_init(|| Self::read().unwrap_or_default())
    }

    fn read() -> Option<Self> {
        let mut text = Vec::new();
        flate2::read::GzDecoder::new(COMPRESSED).read_to_end(&mut text).ok()?;
        let file: File = serde_json::from_slice(&text).ok()?;
        let mut groups = file.groups;
        groups.sort_by_key(|group| group.pgn);
        let mut places = FxHashMap::<u32, (usize, usize)>::default();
        for (place, group) in groups.iter().enumerate() {
            places.entry(group.pgn).or_insert((place, 0)).1 += 1;
        }
        let fallbacks = groups.iter().enumerate().filter(|(_, group)| group.fallback);
        let fallbacks = fallbacks.map(|(place, _)| place).collect();
        let simple = |entries: Vec<Entry>| {
            let numbered = |entry: Entry| Some((entry.value.or(entry.bit)?, entry.name));
            entries.into_iter().filter_map(numbered).collect::<FxHashMap<_, _>>()
        };
        let paired = |entry: Entry| Some(((entry.value1?, entry.value2?), entry.name));
        Some(Self {
            #[cfg(test)]
            entries: groups.len(),
            groups,
            places,
            fallbacks,
            lookups: file
                .lookup_enumerations
                .into_iter()
                .map(|table| (table.name, simple(table.enum_values)))
                .collect(),
            bits: file
                .lookup_bit_enumerations
                .into_iter()
                .map(|table| (table.name, simple(table.enum_bit_values)))
                .collect(),
            indirect: file
                .lookup_indirect_enumerations
                .into_iter()
                .map(|table| (table.name, table.enum_values.into_iter().filter_map(paired).collect()))
                .collect(),
            kinds: file
                .lookup_field_type_enumerations
                .into_iter()
                .map(|table| {
                    let keys = table.enum_field_type_values.into_iter();
                    (table.name, keys.map(|key| (key.value, key)).collect())
                })
                .collect(),
        })
    }

    /// The groups with this number.
    pub fn groups(&self, pgn: u32) -> &[Group] {
        self.places.get(&pgn).map_or(&[], |&(first, count)| &self.groups[first..first + count])
    }

    /// The group for a range of numbers without a known meaning.
    pub fn fallback(&self, pgn: u32) -> Option<&Group> {
        let before = self.fallbacks.partition_point(|&place| self.groups[place].pgn <= pgn);
        self.fallbacks[..before].last().map(|&place| &self.groups[place])
    }

    /// All groups, by number.
    pub fn all(&self) -> &[Group] {
        &self.groups
    }
}
