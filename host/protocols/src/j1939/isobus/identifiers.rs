//! Data dictionary identifiers (DDI): what a value of process data is.

use std::sync::LazyLock;

use rustc_hash::FxHashMap;

use crate::naming;
use crate::table::{Scale, lines};

const DDI_FILE: &str = include_str!("../../../data/isobus-ddi.csv");

static IDENTIFIERS: LazyLock<FxHashMap<u16, Identifier>> = LazyLock::new(|| {
    // What cannot be read is left out, of which the table has nothing: a test counts the lines.
    lines(DDI_FILE).filter_map(Identifier::read).collect()
});

/// How many data dictionary identifiers have a name.
#[cfg(test)]
pub fn count() -> usize {
    assert_eq!(IDENTIFIERS.len(), lines(DDI_FILE).count());
    IDENTIFIERS.len()
}

/// A data dictionary identifier (DDI).
#[derive(Debug)]
pub struct Identifier {
    pub scale: Scale,
    pub unit: &'static str,
    pub name: &'static str,
    /// In the form of other fields.
    pub field: String,
}

impl Identifier {
    fn read(line: &'static str) -> Option<(u16, Self)> {
        let mut columns = line.splitn(4, ',');
        let ddi = u16::from_str_radix(columns.next()?, 16).ok()?;
        let (scale, unit, name) = (Scale::read(columns.next()?)?, columns.next()?, columns.next()?);
        Some((ddi, Self { scale, unit, name, field: naming::plain(name) }))
    }
}

/// A data dictionary identifier, if it has a name.
pub fn get(ddi: u16) -> Option<&'static Identifier> {
    IDENTIFIERS.get(&ddi)
}
