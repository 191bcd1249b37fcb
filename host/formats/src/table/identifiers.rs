//! What the cells of a column of identifiers are, as the first rows show it.

use super::super::text;

/// Whether cells are the numbers of their rows, and no identifiers.
pub(super) fn count_rows(ids: &[&[u8]]) -> bool {
    /// So many nodes that send in turn, and nothing else, are on no bus.
    const ENOUGH: usize = 20;
    let numbers = || ids.iter().map(|id| text::decimal(id));
    ids.len() >= ENOUGH
        && numbers().zip(numbers().skip(1)).all(|(id, next)| id.is_some_and(|id| next == Some(id + 1)))
}

/// Whether identifiers are decimal, and whether that is sure.
pub(crate) fn ids_are_decimal(ids: &[&[u8]]) -> (bool, bool) {
    /// So many different identifiers without a letter are no chance.
    const ENOUGH: usize = 10;
    let plain: Vec<_> = ids.iter().filter(|id| text::after_0x(id).is_none() && !id.is_empty()).collect();
    let has_letter = |id: &&&&[u8]| id.iter().any(u8::is_ascii_alphabetic);
    let has_zero = |id: &&&&[u8]| id.len() > 1 && id.starts_with(b"0");
    if plain.is_empty() || plain.iter().any(|id| has_letter(&id) || has_zero(&id)) {
        return (false, true);
    }
    if plain.iter().any(|id| text::hex(id).is_none_or(|raw| raw > 0x1FFF_FFFF)) {
        return (true, true);
    }
    let mut different = plain;
    different.sort_unstable();
    different.dedup();
    // Of three digits below 800 each are hexadecimal ones without a letter as well: decimal ones would hardly all be between 100 and 799.
    if different.iter().all(|id| id.len() == 3 && id[0] < b'8') {
        return (false, false);
    }
    // Those of one digit are the same in both.
    (different.len() >= ENOUGH, different.len() >= ENOUGH || different.iter().all(|id| id.len() == 1))
}
