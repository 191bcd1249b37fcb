//! Measurement lists (DAQ lists) as a master has set them up: which address each byte of a data packet comes from.

use std::collections::BTreeMap;

/// The most entries of one slave that are kept.
const MOST_ENTRIES: usize = 65_536;
/// The most packets (ODTs) of a list: identifiers above are other packets'.
const MOST_ODTS: usize = 252;
/// The most lists of a slave.
const MOST_LISTS: usize = 1024;

/// Something that is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ListEntry {
    /// The address extension.
    pub extension: u8,
    /// The address.
    pub address: u32,
    /// How many bytes it has in a packet.
    pub size: usize,
    /// The bit that is meant, if only one is.
    pub bit: Option<u8>,
}

/// A list.
#[derive(Clone, Debug, Default)]
pub struct List {
    /// The entries of each packet; `None` where one has room and was not written.
    odts: Vec<Vec<Option<ListEntry>>>,
    /// Its mode, as it was set.
    pub mode: Option<u8>,
    /// The event that it is sampled with.
    pub event: Option<u16>,
    /// The packet identifier of its first packet.
    pub first_pid: Option<u8>,
    /// It is chosen for what is started or stopped next.
    pub is_selected: bool,
    /// It was started.
    pub is_running: bool,
}

/// The lists of a slave.
#[derive(Clone, Debug, Default)]
pub struct Lists {
    all: BTreeMap<u16, List>,
    /// Where the next entry is written: list, packet, entry.
    pointer: Option<(u16, u8, u8)>,
    entries: usize,
}

impl List {
    /// How many packets it has.
    pub const fn packets(&self) -> usize {
        self.odts.len()
    }

    /// What a packet contains, in order, if all of it is known.
    pub fn packet(&self, odt: u8) -> Option<&[Option<ListEntry>]> {
        let entries = self.odts.get(usize::from(odt))?;
        let used = entries.iter().take_while(|entry| entry.is_some()).count();
        let (used, rest) = entries.split_at(used);
        (!used.is_empty() && rest.iter().all(Option::is_none)).then_some(used)
    }
}

impl Lists {
    /// Nothing is set up any more.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// After a gap: what was being set up is not known any more. If `is_short`, there was no time for a list that runs to be set up anew.
    pub fn gap(&mut self, is_short: bool) {
        self.pointer = None;
        self.all.retain(|_, list| is_short && list.is_running);
        self.count();
    }

    fn count(&mut self) {
        self.entries = self.all.values().flat_map(|list| &list.odts).map(Vec::len).sum();
    }

    /// A list by its number, made if it is new and there is room.
    pub fn list(&mut self, number: u16) -> Option<&mut List> {
        if self.all.len() >= MOST_LISTS && !self.all.contains_key(&number) {
            return None;
        }
        Some(self.all.entry(number).or_default())
    }

    /// All of them, by number.
    pub fn all(&mut self) -> impl Iterator<Item = (&u16, &mut List)> {
        self.all.iter_mut()
    }

    /// Whether the pointer is somewhere.
    pub const fn is_pointing(&self) -> bool {
        self.pointer.is_some()
    }

    /// A list by its number.
    pub fn get(&self, number: u16) -> Option<&List> {
        self.all.get(&number)
    }

    /// The list that sends packets with this identifier, and which of its packets that is. Lists that run come first.
    pub fn of_pid(&self, pid: u8) -> Option<(u16, u8, &List)> {
        let places = self.all.iter().filter_map(|(number, list)| {
            let odt = pid.checked_sub(list.first_pid?)?;
            (usize::from(odt) < list.packets()).then_some((*number, odt, list))
        });
        places.max_by_key(|(_, _, list)| list.is_running)
    }

    /// Empties a list.
    pub fn clear_list(&mut self, number: u16) {
        if let Some(list) = self.list(number) {
            *list = List::default();
        }
        self.count();
    }

    /// Gives a list so many packets.
    pub fn allocate_packets(&mut self, number: u16, count: u8) {
        if let Some(list) = self.list(number) {
            list.odts.clear();
            list.odts.resize(usize::from(count).min(MOST_ODTS), Vec::new());
        }
        self.count();
    }

    /// Gives a packet room for so many entries.
    pub fn allocate_entries(&mut self, number: u16, odt: u8, count: u8) {
        if self.entries + usize::from(count) > MOST_ENTRIES {
            return;
        }
        if let Some(entries) = self.list(number).and_then(|list| list.odts.get_mut(usize::from(odt))) {
            *entries = vec![None; usize::from(count)];
        }
        self.count();
    }

    /// Says where the next entry is written.
    pub const fn point_to(&mut self, number: u16, odt: u8, entry: u8) {
        self.pointer = Some((number, odt, entry));
    }

    /// Writes an entry where the pointer is, and moves that on.
    pub fn write(&mut self, entry: ListEntry) {
        let Some((number, odt, place)) = self.pointer else { return };
        self.pointer = place.checked_add(1).map(|next| (number, odt, next));
        let has_room = self.entries < MOST_ENTRIES && usize::from(odt) < MOST_ODTS;
        let Some(list) = self.list(number).filter(|_| has_room) else { return };
        let (odt, place) = (usize::from(odt), usize::from(place));
        // A list that the slave has ready was never given its packets: they are as many as are written.
        if list.odts.len() <= odt {
            list.odts.resize(odt + 1, Vec::new());
        }
        let entries = &mut list.odts[odt];
        let before = entries.len();
        if before <= place {
            entries.resize(place + 1, None);
        }
        entries[place] = (entry.size > 0).then_some(entry);
        let added = entries.len() - before;
        self.entries += added;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(address: u32) -> ListEntry {
        ListEntry { extension: 0, address, size: 2, bit: None }
    }

    #[test]
    fn a_packet_is_known_when_all_of_it_was_written() {
        let mut lists = Lists::default();
        lists.allocate_packets(3, 2);
        lists.allocate_entries(3, 0, 2);
        lists.point_to(3, 0, 1);
        lists.write(entry(2));
        assert_eq!(lists.get(3).and_then(|list| list.packet(0)), None, "its first entry is missing");
        lists.point_to(3, 0, 0);
        lists.write(entry(1));
        let addresses = |lists: &Lists| {
            let packet = lists.get(3)?.packet(0)?;
            Some(packet.iter().flatten().map(|entry| entry.address).collect::<Vec<_>>())
        };
        assert_eq!(addresses(&lists), Some(vec![1, 2]));
        lists.list(3).unwrap().is_running = true;
        lists.gap(true);
        assert_eq!(addresses(&lists), Some(vec![1, 2]), "it goes on as it was");
        lists.gap(false);
        assert!(lists.get(3).is_none(), "it may be another one by now");
    }

    #[test]
    fn memory_is_bounded() {
        let mut lists = Lists::default();
        for number in 0..u16::MAX {
            lists.allocate_packets(number, 255);
            lists.allocate_entries(number, 0, 255);
        }
        assert!(lists.entries <= MOST_ENTRIES && lists.all.len() <= MOST_LISTS);
    }
}
