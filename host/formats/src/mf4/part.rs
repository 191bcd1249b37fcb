//! One stream of records in an MF4 file: those of one group, or of several in turn.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::io;

use cantap_trace::PlainFrame;
use cantap_trace::counted;

use super::super::issue::Fault;
use super::super::whole::Whole;
use super::apart::{MAX_APART, Values, has_arrived};
use super::blocks::{BLOCK_HEAD_BYTES, Block, u32_at};
use super::channel::Row;
use super::joined::joined;
use super::layout::{Apart, Content, Group, RecordBytes, Times};
use super::map::Map;
use super::order::{Item, Order};
use super::place::{Cursor, Mark};
use super::plain::Plain;
use super::stream::Stream;

const INVALID: &str = "records that are marked as invalid";

/// Flags for what must be corrected in an unfinished file.
pub(super) const OPEN_COUNTERS: u16 = 1;
pub(super) const OPEN_LENGTH: u16 = 4;
const OPEN_PLACES: u16 = 0x40;

/// Longest value of a variable-length record; a frame has 64 bytes.
const MAX_VALUE_BYTES: usize = 1 << 20;

/// A stream of records, of one or several groups.
pub(super) struct Part {
    start_ns: i64,
    /// Bytes before each record that identify its group.
    id_bytes: usize,
    pub(super) groups: Vec<Group>,
    /// For those whose records are plain frames at fixed places.
    plain: Vec<Option<Plain>>,
    /// Bytes of a record of each group in the stream.
    record_bytes: Vec<usize>,
    by_id: HashMap<u64, usize>,
    /// Groups whose records are the bytes of another group's records, by address.
    pub(super) values: BTreeMap<u64, Values>,
    by_order: bool,
    pub(super) stream: Stream,
    pub(super) at: u64,
    /// Number of records of each group so far.
    pub(super) counts: Vec<u64>,
    /// If sorted: the number of records.
    records: u64,
    /// Whether the file contains the number of records in each group.
    is_counted: bool,
    pub(super) waiting: VecDeque<Waiting>,
    /// How many records were dropped because their values never came, and where the first was.
    pub(super) without_values: u64,
    pub(super) first_without: u64,
    /// Whether the file ends inside a record, which has been said.
    pub(super) is_cut: bool,
    pub(super) is_end_checked: bool,
    /// That of the last record that has one.
    pub time_ns: i64,
    pub next: Option<Item>,
    /// Where reading was before it, if nothing waited there; among those put in order, its number.
    pub(super) before: Option<Cursor>,
    /// The same where only one record was read since, at once: its beginning and its group.
    pub(super) step_back: Option<(u64, usize)>,
    /// The number of the last record's group, as records have it, and its place.
    last_id: Option<(u64, usize)>,
    pub(super) next_number: Option<u64>,
    pub(super) ended: bool,
    /// The group of the last record.
    group: usize,
    /// If frames of several groups follow each other: what was read ahead.
    pub(super) order: Option<Order>,
    /// Where reading can go on from, in order: the first is before all that was read ahead.
    pub(super) marks: VecDeque<Mark>,
}

/// A record whose values may be elsewhere.
pub(super) struct Waiting {
    group: usize,
    /// Its number in its group.
    number: u64,
    record: Vec<u8>,
    /// Where it is in the stream.
    at: u64,
}

/// The system's errors end the reading; others are reported.
pub(super) fn own(fault: Fault) -> io::Result<Fault> {
    match fault {
        Fault::Io(error) => Err(error),
        other => Ok(other),
    }
}

impl Part {
    /// The content of a data group, if it has bus events; how many of its groups are signals; and what is wrong with groups that cannot be
    /// read.
    pub fn open(
        file: &mut Whole,
        block: &Block,
        open: u16,
        start_ns: i64,
        map: &Map,
    ) -> Result<(Option<Self>, u32, Vec<Fault>), Fault> {
        let id_bytes = usize::from(block.data.first().copied().unwrap_or(0));
        let (mut groups, mut faults, mut next) = (Vec::new(), Vec::new(), block.link(1));
        while next != 0 {
            let (group, behind, fault) = Group::open(file, next, map)?;
            groups.push(group);
            faults.extend(fault);
            next = behind;
            if groups.len() as u64 * BLOCK_HEAD_BYTES > file.len() {
                return Err(Fault::malformed("a list of groups that ends", b"a circle of links"));
            }
        }
        let signals = groups.iter().filter(|group| matches!(group.content, Content::Signals)).count() as u32;
        if !groups.iter().any(|group| matches!(group.content, Content::Bus(_) | Content::Other(_))) {
            return Ok((None, signals, faults));
        }
        if groups.len() > 1 && ![1, 2, 4, 8].contains(&id_bytes) {
            let found = counted(id_bytes, "byte");
            return Err(Fault::malformed("records that say of which group they are", found.as_bytes()));
        }
        let by_id = groups.iter().enumerate().map(|(at, group)| (group.record_id, at)).collect();
        let values = groups.iter().filter(|group| matches!(group.content, Content::Values));
        let values = values.map(|group| (group.address, Values::default())).collect();
        let is_sorted = groups.len() == 1 && id_bytes == 0;
        let row = if is_sorted { groups[0].record_bytes } else { RecordBytes::default() };
        let mut stream = map.stream(file, block.link(2), row.values, row.invalid)?;
        let record_bytes = groups.iter().map(|group| group.record_bytes.all()).collect::<Vec<_>>();
        let record_bytes = if stream.invalid().is_some() { vec![row.values] } else { record_bytes };
        let plain = groups.iter().zip(&record_bytes).map(|(group, len)| match &group.content {
            Content::Bus(bus) => Plain::of(bus, *len, start_ns),
            Content::Other(_) | Content::Values | Content::Signals | Content::Times => None,
        });
        let plain = plain.collect();
        let buses = groups.iter().filter(|group| matches!(group.content, Content::Bus(_))).count();
        let order = (buses > 1 && !map.is_ordered).then(|| Order::of(groups.len()));
        let is_counted = open & OPEN_COUNTERS == 0;
        let records = if is_sorted && is_counted { groups[0].records } else { u64::MAX };
        let part = Self {
            start_ns,
            id_bytes,
            counts: vec![0; groups.len()],
            record_bytes,
            groups,
            plain,
            by_id,
            values,
            by_order: open & OPEN_PLACES != 0,
            stream,
            at: 0,
            records,
            is_counted,
            waiting: VecDeque::new(),
            without_values: 0,
            first_without: 0,
            is_cut: false,
            is_end_checked: false,
            time_ns: start_ns,
            next: None,
            before: None,
            step_back: None,
            last_id: None,
            next_number: None,
            ended: false,
            group: 0,
            order,
            marks: VecDeque::new(),
        };
        Ok((Some(part), signals, faults))
    }

    /// Its own stream, and those to which its records refer.
    pub(super) fn streams(&self) -> impl Iterator<Item = &Stream> {
        let buses = self.groups.iter().filter_map(|group| match &group.content {
            Content::Bus(bus) => Some(bus),
            Content::Other(_) | Content::Values | Content::Signals | Content::Times => None,
        });
        let others = buses.flat_map(|bus| {
            let times = bus.times.iter().map(|times| &times.stream);
            times.chain(bus.apart.iter().filter_map(Apart::stream))
        });
        std::iter::once(&self.stream).chain(others)
    }

    /// What comes next, in the order of time.
    pub fn advance(&mut self, file: &mut Whole) -> io::Result<Option<Item>> {
        let Some(mut order) = self.order.take() else {
            if let Some(item) = self.complete(file) {
                return Ok(Some(item));
            }
            self.remember();
            return self.read(file);
        };
        self.next_number = None;
        while order.needs_more() {
            self.put_next(&mut order, file)?;
        }
        let first = order.pop();
        self.order = Some(order);
        self.next_number = first.as_ref().map(|(number, _)| *number);
        Ok(first.map(|(_, item)| item))
    }

    /// Reads what comes next in the file, and puts it in order.
    pub(super) fn put_next(&mut self, order: &mut Order, file: &mut Whole) -> io::Result<()> {
        self.mark(order);
        let item = match self.complete(file) {
            None => self.read(file)?,
            item => item,
        };
        order.put(item, self.group);
        Ok(())
    }

    /// The next record, if nothing waits and it says everything: by far the most frequent case. Otherwise nothing has happened.
    fn complete(&mut self, file: &mut Whole) -> Option<Item> {
        self.step_back = None;
        if self.ended || !self.waiting.is_empty() {
            return None;
        }
        let before = self.at;
        let group = self.group(file).ok().flatten();
        let begin = self.at;
        self.at = before;
        let group = group?;
        let Content::Bus(bus) = &self.groups[group].content else { return None };
        if !bus.is_complete {
            return None;
        }
        let (len, number) = (self.record_bytes[group], self.counts[group]);
        let record = self.stream.at(file, begin, len).ok().flatten()?;
        self.at = begin + len as u64;
        self.counts[group] += 1;
        self.group = group;
        self.step_back = Some((before, group));
        let row = Row { record, number, apart: &[], invalid: &[] };
        Some(Item::of(bus.record(&row, record, self.start_ns), before))
    }

    /// What comes next in the file.
    fn read(&mut self, file: &mut Whole) -> io::Result<Option<Item>> {
        match self.step(file) {
            Ok(item) => Ok(item),
            Err(fault) => {
                // It is no longer known where one record ends and the next begins.
                self.ended = true;
                // What waits would meet the same fault for ever.
                self.waiting.clear();
                Ok(Some(Item::Fault(self.at, own(fault)?)))
            }
        }
    }

    fn step(&mut self, file: &mut Whole) -> Result<Option<Item>, Fault> {
        loop {
            if let Some(item) = self.of_waiting(file)? {
                return Ok(Some(item));
            }
            if self.ended {
                return Ok(self.fault_of_end().map(|fault| Item::Fault(self.at, fault)));
            }
            let place = self.at;
            let Some(group) = self.group(file)? else {
                self.ended = true;
                // What waits and has its values comes first.
                continue;
            };
            match &self.groups[group].content {
                Content::Values => {
                    let Some(head) = self.stream.at(file, self.at, 4)? else { return Ok(Some(self.cut())) };
                    let len = u32_at(head, 0) as usize;
                    if len > MAX_VALUE_BYTES {
                        return Err(Fault::malformed("a value of up to 1 MiB", len.to_string().as_bytes()));
                    }
                    let Some(value) = self.stream.at(file, self.at + 4, len)? else {
                        return Ok(Some(self.cut()));
                    };
                    let value = value.to_vec();
                    self.at += 4 + len as u64;
                    if let Some(values) = self.values.get_mut(&self.groups[group].address) {
                        values.keep(value, self.by_order);
                    }
                }
                Content::Signals | Content::Times | Content::Other(_) | Content::Bus(_) => {
                    let len = self.record_bytes[group];
                    let Some(record) = self.stream.at(file, self.at, len)? else {
                        return Ok(Some(self.cut()));
                    };
                    let number = self.counts[group];
                    match &self.groups[group].content {
                        Content::Bus(_) => {
                            let record = record.to_vec();
                            self.waiting.push_back(Waiting { group, number, record, at: place });
                        }
                        Content::Other(what) => {
                            let what = *what;
                            self.at += len as u64;
                            self.counts[group] += 1;
                            return Ok(Some(Item::LeftOut(what)));
                        }
                        Content::Signals | Content::Times | Content::Values => {}
                    }
                    self.at += len as u64;
                    self.counts[group] += 1;
                }
            }
        }
    }

    /// Appends the plain frames that follow and are at hand, as long as it is their turn, up to `most` altogether; what comes then is for [`Self::advance`].
    pub fn plain_frames(&mut self, frames: &mut Vec<PlainFrame>, most: usize, is_next: impl Fn(i64) -> bool) {
        if self.ended || self.order.is_some() || !self.waiting.is_empty() {
            return;
        }
        let room = most.saturating_sub(frames.len());
        let Self { stream, at, plain, record_bytes, counts, records, .. } = self;
        if self.id_bytes == 0 {
            let Some(plain) = &plain[0] else { return };
            let most = usize::try_from(records.saturating_sub(counts[0])).map_or(room, |left| left.min(room));
            let found = plain.frames(stream.held(*at), counts[0], most, is_next, frames);
            *at += (found * record_bytes[0]) as u64;
            counts[0] += found as u64;
            if let Some(last) = frames.last().filter(|_| found > 0) {
                self.time_ns = last.time_ns;
            }
            return;
        }
        // Records of one group follow each other: it is looked up once.
        let mut last: Option<(u64, usize)> = None;
        let mut rest = stream.held(*at);
        for _ in 0..room {
            let Some((id, bytes)) = rest.split_at_checked(self.id_bytes) else { return };
            let id = id.iter().rev().fold(0, |id: u64, byte| id << 8 | u64::from(*byte));
            let group = match last {
                Some((known, group)) if known == id => group,
                _ => match self.by_id.get(&id) {
                    Some(group) => *group,
                    None => return,
                },
            };
            last = Some((id, group));
            let Some(plain) = &plain[group] else { return };
            let Some(frame) = plain.frame(bytes, counts[group]).filter(|frame| is_next(frame.time_ns)) else {
                return;
            };
            rest = &bytes[record_bytes[group]..];
            *at += (self.id_bytes + record_bytes[group]) as u64;
            counts[group] += 1;
            self.time_ns = frame.time_ns;
            frames.push(frame);
        }
    }

    /// What is wrong where no record follows; one thing after the other.
    fn fault_of_end(&mut self) -> Option<Fault> {
        if self.is_end_checked {
            return None;
        }
        let without = std::mem::take(&mut self.without_values);
        // Where the file is cut, one may lack its values, which is said.
        if without > u64::from(self.is_cut) {
            let found = format!(
                "{without} without theirs, the first at {:#x}",
                self.first_without,
                without = counted(without, "frame")
            );
            return Some(Fault::malformed("the bytes of each frame", found.as_bytes()));
        }
        self.is_end_checked = true;
        if let Some(at) = self.stream.next_file() {
            return Some(joined(at));
        }
        if self.is_cut {
            return None;
        }
        let rest = self.stream.len().saturating_sub(self.at);
        let is_sorted = self.records != u64::MAX;
        let is_short = is_sorted && self.counts[0] < self.records;
        if self.stream.is_cut() || is_short || rest > 0 && !is_sorted {
            return Some(Fault::Truncated("a group of frames"));
        }
        // The counter is damaged, or the file's writer reserved more space than it had records.
        if is_sorted && rest >= self.record_bytes[0].max(1) as u64 {
            let expected = format!("no more data than the {} records that are counted", self.records);
            return Some(Fault::malformed(
                expected,
                format!("{rest} more", rest = counted(rest, "byte")).as_bytes(),
            ));
        }
        if is_sorted || !self.is_counted {
            return None;
        }
        // The group's number before each record may be damaged.
        let counts = self.groups.iter().zip(&self.counts);
        let differs = |(group, count): &(&Group, &u64)| {
            !matches!(group.content, Content::Values) && group.records != **count
        };
        let (group, count) = counts.into_iter().find(differs)?;
        let expected = format!("{} of a group, as are counted", counted(group.records, "record"));
        Some(Fault::malformed(expected, count.to_string().as_bytes()))
    }

    fn cut(&mut self) -> Item {
        self.ended = true;
        self.is_cut = true;
        Item::Fault(self.at, Fault::Truncated("a record"))
    }

    /// The group of the next record; `None` at the end.
    fn group(&mut self, file: &mut Whole) -> Result<Option<usize>, Fault> {
        let is_over = self.counts.first().is_some_and(|count| *count >= self.records);
        if self.at >= self.stream.len() || is_over {
            return Ok(None);
        }
        if self.id_bytes == 0 {
            // A zero-length record would never end.
            let len = self.record_bytes[0] as u64;
            return Ok((len > 0 && self.at + len <= self.stream.len()).then_some(0));
        }
        let Some(id) = self.stream.at(file, self.at, self.id_bytes)? else { return Ok(None) };
        let id = id.iter().rev().fold(0, |id: u64, byte| id << 8 | u64::from(*byte));
        self.at += self.id_bytes as u64;
        // Records of one group follow each other.
        if let Some((last, group)) = self.last_id
            && last == id
        {
            return Ok(Some(group));
        }
        let group = self.by_id.get(&id).copied();
        let group =
            group.ok_or_else(|| Fault::malformed("a record of a known group", id.to_string().as_bytes()))?;
        self.last_id = Some((id, group));
        Ok(Some(group))
    }

    /// The record that has waited longest, if its values have arrived. Those whose values will not come are dropped and counted.
    fn of_waiting(&mut self, file: &mut Whole) -> Result<Option<Item>, Fault> {
        loop {
            let Some(waiting) = self.waiting.front() else { return Ok(None) };
            let group = waiting.group;
            let Content::Bus(bus) = &mut self.groups[group].content else { return Ok(None) };
            if !has_arrived(&bus.apart, &self.values, &waiting.record, self.by_order)? {
                if !self.ended && self.waiting.len() < MAX_APART {
                    return Ok(None);
                }
                if self.without_values == 0 {
                    self.first_without = waiting.at;
                }
                self.without_values += 1;
                self.waiting.pop_front();
                continue;
            }
            let Some(waiting) = self.waiting.pop_front() else { return Ok(None) };
            self.group = group;
            let mut apart = Vec::with_capacity(bus.apart.len());
            for values in &mut bus.apart {
                apart.push(values.take(file, &mut self.values, &waiting.record, self.by_order)?);
            }
            return self.item(file, &waiting, &apart).map(Some);
        }
    }

    /// What a record is whose values are all there.
    fn item(&mut self, file: &mut Whole, waiting: &Waiting, apart: &[Vec<u8>]) -> Result<Item, Fault> {
        let Waiting { group, number, record, at } = waiting;
        let invalid_bytes = self.groups[*group].record_bytes.invalid;
        let invalid = match self.stream.invalid() {
            Some(stream) => {
                let at = number.saturating_mul(invalid_bytes as u64);
                stream
                    .at(file, at, invalid_bytes)?
                    .ok_or(Fault::Truncated("the bits that say what is valid"))?
            }
            None => record.get(record.len().saturating_sub(invalid_bytes)..).unwrap_or_default(),
        };
        let Content::Bus(bus) = &mut self.groups[*group].content else { return Ok(Item::LeftOut(INVALID)) };
        if bus.is_invalid(invalid) {
            return Ok(Item::LeftOut(INVALID));
        }
        let time = match &mut bus.times {
            None => None,
            Some(Times { stream, record_bytes }) => {
                let at = number.saturating_mul(*record_bytes as u64);
                let time = stream.at(file, at, *record_bytes)?;
                Some(time.ok_or(Fault::Truncated("the times of a group of frames"))?.to_vec())
            }
        };
        let time = time.as_deref().unwrap_or(record);
        let row = Row { record, number: *number, apart, invalid };
        Ok(Item::of(bus.record(&row, time, self.start_ns), *at))
    }
}
