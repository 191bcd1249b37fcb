//! Draws where a message's signals are, in text.

use std::fmt::Write as _;

use super::layout::{ByteOrder, wire_position};
use super::model::{Message, Signal};

/// Columns of a bit's cell, excluding its left border.
const CELL: usize = 4;

impl Message {
    /// Sets of signals that one frame may carry, by index and in the file's order: those that are always present or,
    /// with multiplexers, one set for each of their values.
    pub fn pages(&self) -> Vec<Vec<usize>> {
        let mut leaves: Vec<Vec<usize>> = Vec::new();
        for place in 0..self.signals.len() {
            let Some(chain) = self.chain(place) else { continue };
            let page = (0..self.signals.len()).filter(|&other| {
                self.chain(other)
                    .is_some_and(|others| others.is_empty() || others.iter().all(|link| chain.contains(link)))
            });
            let page: Vec<_> = page.collect();
            if !leaves.contains(&page) {
                leaves.push(page);
            }
        }
        // A page contained in another shows nothing new.
        let within =
            |page: &Vec<usize>, other: &Vec<usize>| page != other && page.iter().all(|at| other.contains(at));
        let pages = leaves.iter().filter(|page| !leaves.iter().any(|other| within(page, other)));
        pages.cloned().collect()
    }

    /// The multiplexers that a signal depends on, each with the values for which it is present.
    fn chain(&self, place: usize) -> Option<Vec<(usize, Vec<std::ops::RangeInclusive<u64>>)>> {
        let mut chain = Vec::new();
        let mut at = place;
        while let Some(multiplexed) = &self.signals[at].multiplexed {
            if chain.len() > super::fault::MAX_SWITCHES || multiplexed.switch >= self.signals.len() {
                return None;
            }
            chain.push((multiplexed.switch, multiplexed.values.clone()));
            at = multiplexed.switch;
        }
        Some(chain)
    }

    /// Draws where the chosen signals are: a line per byte, with the highest bit on the left. `<` is a signal's most significant bit,
    /// `x` its least significant one, `X` a bit of several signals. Bytes after the last one with a signal are left out.
    pub fn layout_picture(&self, signals: &[usize]) -> String {
        let chosen: Vec<&Signal> = signals.iter().filter_map(|&place| self.signals.get(place)).collect();
        let needed = chosen.iter().map(|signal| signal.bytes_needed()).max().unwrap_or(0);
        let bytes = needed.max(u32::from(self.length.min(8)));
        let mut owners: Vec<Vec<usize>> = vec![Vec::new(); bytes as usize * 8];
        for (index, signal) in chosen.iter().enumerate() {
            for bit in bits(signal) {
                if let Some(owner) = owners.get_mut(bit) {
                    owner.push(index);
                }
            }
        }
        let mut out = String::from("      ");
        for bit in (0..8).rev() {
            let _ = write!(out, "  {bit} ");
        }
        out.truncate(out.trim_end().len());
        out.push('\n');
        let rule = format!("      {}+\n", "+---".repeat(8));
        for byte in 0..bytes as usize {
            out.push_str(&rule);
            let _ = write!(out, "{byte:>5} ");
            let mut names: Vec<usize> = Vec::new();
            for bit in (0..8).rev() {
                let place = byte * 8 + bit;
                let here = &owners[place];
                let joined = bit < 7
                    && !here.is_empty()
                    && owners[place + 1] == *here
                    && !is_end(&chosen, here, place + 1, false);
                out.push(if joined { '-' } else { '|' });
                out.push_str(&cell(&chosen, here, place));
                names.extend(here.iter().filter(|index| !names.contains(index)).copied().collect::<Vec<_>>());
            }
            out.push('|');
            let names: Vec<_> = names.into_iter().map(|index| chosen[index].label()).collect();
            if !names.is_empty() {
                let _ = write!(out, "  {}", names.join(", "));
            }
            out.push('\n');
        }
        out + &rule
    }
}

/// The three characters for a bit.
fn cell(signals: &[&Signal], owners: &[usize], place: usize) -> String {
    let (left, right) = match owners {
        [] => return " ".repeat(CELL - 1),
        [_] => {
            let first = if is_end(signals, owners, place, true) { '<' } else { '-' };
            (first, if is_end(signals, owners, place, false) { 'x' } else { '-' })
        }
        _ => return "XXX".to_owned(),
    };
    format!("{left}-{right}")
}

/// Whether the bit is the only owner's most (or least) significant one.
fn is_end(signals: &[&Signal], owners: &[usize], place: usize, most: bool) -> bool {
    let [owner] = owners else { return false };
    let mut bits = bits(signals[*owner]);
    if most { bits.last() == Some(place) } else { bits.next() == Some(place) }
}

/// The signal's bits in DBC's numbering, the least significant first.
fn bits(signal: &Signal) -> impl Iterator<Item = usize> + use<> {
    let (order, start, length) = (signal.order, u32::from(signal.start), u32::from(signal.length));
    (0..length).map(move |bit| match order {
        ByteOrder::Little => (start + bit) as usize,
        ByteOrder::Big => wire_position(wire_position(start) + length - 1 - bit) as usize,
    })
}

#[cfg(test)]
mod tests {
    use crate::dbc;

    #[test]
    fn a_layout_shows_order_ends_and_overlaps() {
        let text = "BO_ 5 M: 3 A\n SG_ Enable : 7|1@0- (1,0) [0|0] \"\" A\n SG_ Radius : 6|6@0+ (1,0) [0|0] \"\" A\n \
                    SG_ Temp : 0|12@0- (1,0) [0|0] \"\" A\n SG_ Little : 16|4@1+ (1,0) [0|0] \"\" A\n SG_ Over : 19|2@1+ (1,0) [0|0] \"\" A\n";
        let message = &dbc::parse("x.dbc", text.as_bytes()).unwrap().messages[0];
        assert_eq!(message.pages(), [[0, 1, 2, 3, 4]]);
        let expected = "\x20       7   6   5   4   3   2   1   0\n\
                        \x20     +---+---+---+---+---+---+---+---+\n\
                        \x20   0 |<-x|<---------------------x|<--|  Enable, Radius, Temp\n\
                        \x20     +---+---+---+---+---+---+---+---+\n\
                        \x20   1 |-------------------------------|  Temp\n\
                        \x20     +---+---+---+---+---+---+---+---+\n\
                        \x20   2 |---------x|   |<-x|XXX|-------x|  Temp, Over, Little\n\
                        \x20     +---+---+---+---+---+---+---+---+\n";
        let found = message.layout_picture(&message.pages()[0]);
        assert!(found.starts_with(&expected[..200]), "{found}");
        assert!(found.contains("XXX") && found.contains("Over, Little"), "{found}");
    }

    #[test]
    fn each_value_of_a_multiplexer_has_its_page() {
        let text = "BO_ 5 M: 3 A\n SG_ Page M : 0|8@1+ (1,0) [0|0] \"\" A\n SG_ One m1 : 8|8@1+ (1,0) [0|0] \"\" A\n \
                    SG_ Two m2 : 8|8@1+ (1,0) [0|0] \"\" A\n SG_ Always : 16|8@1+ (1,0) [0|0] \"\" A\n";
        let message = &dbc::parse("x.dbc", text.as_bytes()).unwrap().messages[0];
        assert_eq!(message.pages(), [[0, 1, 3], [0, 2, 3]]);
    }
}
