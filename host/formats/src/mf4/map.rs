//! Where the data of a file's groups is, as far as it is known before the groups are opened.
//!
//! Data is in blocks that lists name one after the other, and each block says how long it is: to go through all of them takes one or two readings each, and
//! a file of a few gigabytes may have a hundred thousand. So an index keeps what was found, and a reading that begins elsewhere goes through none.

use std::collections::{BTreeMap, HashMap};

use serde::{Deserialize, Serialize};

use super::super::issue::Fault;
use super::super::whole::Whole;
use super::stream::{Laid, Origin, Stream};

/// What going through the blocks of a finished file has found, as an index has it.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct Places {
    streams: BTreeMap<Origin, Laid>,
    /// Where another file begins behind it.
    pub joined: Option<u64>,
}

impl Places {
    /// Those of these streams.
    pub(super) fn of<'a>(streams: impl Iterator<Item = &'a Stream>, joined: Option<u64>) -> Self {
        Self { streams: streams.map(Stream::laid).collect(), joined }
    }
}

/// What is known of the data of a file's groups.
#[derive(Default)]
pub(super) struct Map {
    /// Which group a group of data consists of, by its address, where it is the only one: its data, from which its records can be read by number.
    pub alone: HashMap<u64, u64>,
    /// Whether the last block's length was not written, so that it extends to the end of the file.
    pub open_end: bool,
    /// Whether groups that share a stream are in the order in which things happened, as this library writes them: nothing is to be put in order.
    pub is_ordered: bool,
    /// From an earlier reading of the file, if there was one.
    pub places: Option<Places>,
}

impl Map {
    /// The data at a link: records with so many bytes of values, and of bits that say which of them are none.
    pub(super) fn stream(
        &self,
        file: &mut Whole,
        link: u64,
        value_bytes: usize,
        invalid_bytes: usize,
    ) -> Result<Stream, Fault> {
        let origin = Origin { link, row_bytes: (value_bytes as u64, invalid_bytes as u64) };
        match self.places.as_ref().and_then(|places| places.streams.get(&origin)) {
            Some(laid) => Ok(Stream::of(origin, laid)),
            None => Stream::open(file, origin, self.open_end),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::super::super::seek;
    use super::super::encode::Blocks;
    use super::*;

    fn whole(bytes: Vec<u8>) -> Whole {
        Whole::new(Box::new(Cursor::new(bytes))).unwrap()
    }

    /// A jump went through all blocks, a reading or two for each.
    #[test]
    fn data_whose_place_is_known_is_read_without_its_list() {
        let mut blocks = Blocks(vec![0; 64]);
        let data: Vec<u64> = (0..5_u8).map(|at| blocks.push(*b"##DT", &[], &[at; 16])).collect();
        let links: Vec<u64> = std::iter::once(0).chain(data).collect();
        let list = blocks.push(*b"##DL", &links, &[0; 8]);
        let mut file = blocks.0;
        let stream = Map::default().stream(&mut whole(file.clone()), list, 8, 0).unwrap();
        let mut bytes = Vec::new();
        assert!(seek::save(&Places::of(std::iter::once(&stream), None), &mut bytes));
        // Without the list and the heads of the blocks.
        for at in 0..5 {
            file[64 + at * 40..][..24].fill(0);
        }
        file.truncate(list as usize);
        assert!(Map::default().stream(&mut whole(file.clone()), list, 8, 0).is_err());
        let map = Map { places: seek::load(&bytes), ..Map::default() };
        let mut file = whole(file);
        let mut known = map.stream(&mut file, list, 8, 0).unwrap();
        assert_eq!(known.len(), 80);
        assert_eq!(known.at(&mut file, 60, 8).unwrap(), Some(&[3, 3, 3, 3, 4, 4, 4, 4][..]));
        // Data of another link is gone through.
        assert!(map.stream(&mut file, 64, 8, 0).is_err());
    }
}
