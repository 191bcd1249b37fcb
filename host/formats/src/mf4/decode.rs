//! Reading MF4.

use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap, VecDeque};
use std::io;

use super::super::bit_rates::{self, BitRates};
use super::super::codec::{BATCH, Decode, PLAIN_BATCH};
use super::super::found::Found;
use super::super::input::Input;
use super::super::issue::{Fault, Place};
use super::super::seek;
use super::super::whole::Whole;
use super::super::zone::Zone;
use super::blocks::{BLOCK_HEAD_BYTES, u16_at, u64_at};
use super::comment::{BIT_RATES, Properties, properties};
use super::joined::{after_blocks, joined};
use super::map::{Map, Places};
use super::order::Item;
use super::part::{OPEN_LENGTH, Part, own};
use super::place::{EVERY, Saved};
use super::{FILE_MAGIC, HEADER_AT, PROGRAM_NAME, UNFINISHED_MAGIC};
use cantap_trace::{PlainFrame, TraceRecord};

const MEASURED: &str = "groups of measured signals";
const NO_COMMENT: &str = "what the file says about its measurement cannot be read";

/// Reads MF4.
#[derive(Default)]
pub(crate) struct Decoder {
    open: Option<Opened>,
    /// To be reported before the records.
    first: VecDeque<Found>,
    properties: Properties,
    bit_rates: BitRates,
    /// Where to go on, once the file is opened.
    resume: Option<Saved>,
    /// What going through its blocks would find, if it is known before.
    places: Option<Places>,
}

struct Opened {
    file: Whole,
    /// Whether all of its blocks are known. Not of an unfinished file, in which another one may begin anywhere.
    is_gone_through: bool,
    /// Where another file begins behind it.
    joined: Option<u64>,
    /// What was handed out.
    items: u64,
    parts: Vec<Part>,
    /// The time of the next record, for each part that has one.
    next: BinaryHeap<Reverse<(i64, usize)>>,
}

impl Decode for Decoder {
    fn needs_one_line(&self) -> bool {
        false
    }

    fn plain_frames(&mut self, frames: &mut Vec<PlainFrame>) -> io::Result<bool> {
        if let Some(open) = self.open.as_mut().filter(|_| self.first.is_empty()) {
            open.plain_frames(frames)?;
        }
        Ok(true)
    }

    fn bit_rates(&self) -> &[(u8, u32)] {
        &self.bit_rates
    }

    fn properties(&self) -> Option<&Properties> {
        Some(&self.properties)
    }

    fn position(&self) -> Option<u64> {
        let resume = || self.resume.as_ref().map_or(0, |saved| saved.position);
        Some(self.open.as_ref().map_or_else(resume, Opened::position))
    }

    /// Before the file is opened, this is where it will be read from.
    fn save(&self, state: &mut Vec<u8>) -> bool {
        match &self.open {
            None => seek::save(&self.resume, state),
            Some(_) if !self.is_between() => false,
            Some(open) => open.save().is_some_and(|saved| seek::save(&Some(saved), state)),
        }
    }

    fn restore(&mut self, state: &[u8]) -> Option<()> {
        self.resume = seek::load(state)?;
        Some(())
    }

    fn save_layout(&self, layout: &mut Vec<u8>) -> bool {
        let open = self.open.as_ref().filter(|open| open.is_gone_through);
        open.is_some_and(|open| {
            seek::save(&Places::of(open.parts.iter().flat_map(Part::streams), open.joined), layout)
        })
    }

    fn restore_layout(&mut self, layout: &[u8]) {
        // Without it, the file is gone through.
        self.places = seek::load(layout);
    }

    fn batch(&mut self, input: &mut Input, records: &mut Vec<TraceRecord>) -> io::Result<Option<Found>> {
        loop {
            match self.next(input)? {
                Found::Record(record) => records.push(record),
                other => return Ok(Some(other)),
            }
            if records.len() >= BATCH || self.is_between() || input.may_wait() {
                return Ok(None);
            }
        }
    }

    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        if self.open.is_none() {
            self.open(input)?;
        }
        if let Some(found) = self.first.pop_front() {
            return Ok(found);
        }
        match &mut self.open {
            Some(open) => open.next(),
            None => Ok(Found::End),
        }
    }
}

impl Decoder {
    /// Reads what the file says about itself, and what comes first.
    fn open(&mut self, input: &mut Input) -> io::Result<()> {
        let zone = input.zone().clone();
        let mut file = input.whole()?;
        let mut map = Map { places: self.places.take(), ..Map::default() };
        let mut parts = Vec::new();
        let mut collecting = Collecting {
            map: &mut map,
            first: &mut self.first,
            properties: &mut self.properties,
            is_resumed: self.resume.is_some(),
            is_gone_through: false,
            joined: None,
        };
        let fault = collecting.collect(&mut file, &zone, &mut parts).err();
        let Collecting { is_gone_through, joined, .. } = collecting;
        // It is for programs.
        if let Some(rates) = self.properties.remove(BIT_RATES) {
            bit_rates::learn_list(&mut self.bit_rates, &rates);
        }
        if let Some(fault) = fault {
            self.first.push_back(Found::Issue(Place::Offset(0), own(fault)?));
        }
        let mut open = Opened { file, is_gone_through, joined, items: 0, parts, next: BinaryHeap::new() };
        let resume = self.resume.take();
        if let Some(saved) = &resume {
            // It was reported where the file begins.
            self.first.clear();
            if !open.resume(saved)? {
                return Err(seek::has_changed());
            }
        }
        for part in 0..open.parts.len() {
            open.advance(part)?;
        }
        if resume.is_some_and(|saved| saved.position != open.position()) {
            return Err(seek::has_changed());
        }
        self.open = Some(open);
        Ok(())
    }

    /// Whether reading can go on from here.
    fn is_between(&self) -> bool {
        let is_multiple = |open: &Opened| open.items.is_multiple_of(EVERY) && open.items > 0;
        self.first.is_empty() && self.open.as_ref().is_some_and(is_multiple)
    }
}

impl Opened {
    /// Grows with whatever is handed out.
    fn position(&self) -> u64 {
        self.parts.iter().map(|part| part.at).fold(self.items, u64::saturating_add)
    }

    fn save(&self) -> Option<Saved> {
        let parts = self.parts.iter().map(Part::save).collect::<Option<_>>()?;
        Some(Saved { items: self.items, position: self.position(), parts })
    }

    /// Goes to a place, before anything was read; false if it is none of this file.
    fn resume(&mut self, saved: &Saved) -> io::Result<bool> {
        self.items = saved.items;
        let mut is_one = self.parts.len() == saved.parts.len();
        for (part, saved) in self.parts.iter_mut().zip(&saved.parts) {
            is_one = is_one && part.resume(&mut self.file, saved)?;
        }
        Ok(is_one)
    }

    fn next(&mut self) -> io::Result<Found> {
        let Some(Reverse((_, part))) = self.next.pop() else { return Ok(Found::End) };
        self.items += 1;
        let item = self.parts[part].next.take();
        self.advance(part)?;
        Ok(match item {
            Some(Item::Record(record)) => Found::Record(record),
            Some(Item::LeftOut(what)) => Found::LeftOut(what),
            Some(Item::Fault(at, fault)) => Found::Issue(Place::Offset(at), fault),
            None => Found::End,
        })
    }

    /// Appends plain frames, up to whatever else comes next.
    fn plain_frames(&mut self, frames: &mut Vec<PlainFrame>) -> io::Result<()> {
        frames.reserve(PLAIN_BATCH);
        let most = PLAIN_BATCH.min((EVERY - self.items % EVERY) as usize);
        while frames.len() < most
            && let Some(Reverse((_, index))) = self.next.peek().copied()
            && let Some(Item::Record(record)) = &self.parts[index].next
            && let Some(frame) = PlainFrame::of(record)
        {
            self.next.pop();
            frames.push(frame);
            let others = self.next.peek().map(|Reverse(first)| *first);
            let is_next = |time_ns| others.is_none_or(|first| (time_ns, index) < first);
            self.parts[index].plain_frames(frames, most, is_next);
            self.advance(index)?;
        }
        self.items += frames.len() as u64;
        Ok(())
    }

    fn advance(&mut self, index: usize) -> io::Result<()> {
        let part = &mut self.parts[index];
        part.next = part.advance(&mut self.file)?;
        match &part.next {
            Some(Item::Record(record)) => part.time_ns = record.time_ns,
            Some(Item::LeftOut(_) | Item::Fault(..)) => {}
            None => return Ok(()),
        }
        self.next.push(Reverse((part.time_ns, index)));
        Ok(())
    }
}

/// What is found in a file before its records.
struct Collecting<'a> {
    map: &'a mut Map,
    /// To be reported before the records.
    first: &'a mut VecDeque<Found>,
    properties: &'a mut Properties,
    is_resumed: bool,
    /// See [`Opened`].
    is_gone_through: bool,
    joined: Option<u64>,
}

impl Collecting<'_> {
    /// Adds the streams of records in a file; if there is a fault, those before it.
    fn collect(&mut self, file: &mut Whole, zone: &Zone, parts: &mut Vec<Part>) -> Result<(), Fault> {
        const LOCAL_TIME: u8 = 1;
        const UNFINISHED_AT: usize = 60;
        const PROGRAM: std::ops::Range<usize> = 16..24;
        let identification = file.read_at(0, HEADER_AT as usize)?;
        let is_unfinished = identification.starts_with(UNFINISHED_MAGIC);
        if !is_unfinished && !identification.starts_with(FILE_MAGIC) {
            return Err(Fault::malformed(
                "a file that begins with 'MDF'",
                identification.get(..8).unwrap_or(&identification),
            ));
        }
        let Some(version) = identification.get(8..12) else {
            return Err(Fault::Truncated("the file header"));
        };
        if !version.starts_with(b"4.") {
            let version = String::from_utf8_lossy(version).trim().to_owned();
            return Err(Fault::Malformed {
                expected: "MDF 4.0 or later, into which programs for MDF convert older files".into(),
                found: format!("MDF {version}"),
            });
        }
        let open = if is_unfinished { u16_at(&identification, UNFINISHED_AT) } else { 0 };
        let header = file.block(HEADER_AT, *b"##HD")?;
        match properties(file, &header) {
            Ok(found) => *self.properties = found,
            Err(Fault::Io(error)) => return Err(error.into()),
            // The traffic can be read all the same.
            Err(_) => self.first.push_back(Found::Note(NO_COMMENT)),
        }
        let clock_ns = i64::try_from(u64_at(&header.data, 0)).unwrap_or(0);
        let is_local = header.data.get(12).is_some_and(|flags| flags & LOCAL_TIME != 0);
        let start_ns = if is_local { zone.utc_ns(clock_ns) } else { clock_ns };
        self.map.open_end = open & OPEN_LENGTH != 0;
        self.map.is_ordered = identification.get(PROGRAM) == Some(&PROGRAM_NAME[..]);
        self.map.alone = alone(file, header.link(0));
        let (mut next, mut count) = (header.link(0), 0);
        if next == 0 {
            return Err(Fault::malformed("a group of data", b"none"));
        }
        while next != 0 {
            let group = file.block(next, *b"##DG")?;
            next = group.link(0);
            count += 1;
            if count * BLOCK_HEAD_BYTES > file.len() {
                return Err(Fault::malformed("a list of groups that ends", b"a circle of links"));
            }
            match Part::open(file, &group, open, start_ns, self.map) {
                Ok((part, signals, faults)) => {
                    self.first
                        .extend(faults.into_iter().map(|fault| Found::Issue(Place::Offset(next), fault)));
                    self.first.extend((0..signals).map(|_| Found::LeftOut(MEASURED)));
                    parts.extend(part);
                }
                Err(Fault::Io(error)) => return Err(error.into()),
                Err(fault) => self.first.push_back(Found::Issue(Place::Offset(next), fault)),
            }
        }
        self.joined = match &self.map.places {
            Some(places) => places.joined,
            // It was reported where the file begins.
            None if self.is_resumed || self.map.open_end => return Ok(()),
            None => after_blocks(file)?,
        };
        self.is_gone_through = true;
        self.first.extend(self.joined.map(|at| Found::Issue(Place::Offset(at), joined(at))));
        Ok(())
    }
}

/// Groups of records that are alone in their group of data.
fn alone(file: &mut Whole, first: u64) -> HashMap<u64, u64> {
    let (mut alone, mut next, mut count) = (HashMap::new(), first, 0);
    while next != 0 && count * BLOCK_HEAD_BYTES <= file.len() {
        // What is wrong with it is said when it is read.
        let Ok(group) = file.block(next, *b"##DG") else { break };
        if group.data.first() == Some(&0) {
            alone.insert(group.link(1), group.link(2));
        }
        next = group.link(0);
        count += 1;
    }
    alone
}
