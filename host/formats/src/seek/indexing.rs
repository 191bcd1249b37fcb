//! A reading that makes an index, or uses one.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{self, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use cantap_trace::{PlainFrame, TraceRecord};

use super::blocks::has_changed;
use super::folder::IndexFolder;
use super::identity::Identity;
use super::index::{Index, Part, Place};
use crate::codec::Decode;
use crate::input::Input;
use crate::spec::FormatSpec;
use crate::time_range::TimeRange;
use crate::{Format, LeftOut, ReadOptions};

/// What is known of records that are passed over.
#[derive(Default)]
pub(crate) struct Passed {
    pub records: u64,
    /// The latest time of them.
    pub latest_ns: Option<i64>,
    pub channels: BTreeSet<u8>,
}

/// What a reading changes besides the index.
pub(crate) struct Reading<'a> {
    pub input: &'a mut Input,
    pub decoder: &'a mut Box<dyn Decode>,
    pub records: &'a mut u64,
    pub notes: &'a mut LeftOut,
    pub left_out: &'a mut LeftOut,
    pub passed: &'a mut Passed,
    pub issues: u64,
}

/// The index of a file that is being read.
pub(crate) struct Indexing {
    folder: IndexFolder,
    /// The index's own file.
    path: PathBuf,
    how: String,
    format: Format,
    options: ReadOptions,
    has_begun: bool,
    index: Index,
    /// The file when reading began.
    identity: Option<Identity>,
    /// Whether all since the last place has been read and is in `open`.
    is_learning: bool,
    /// Whether anything was passed over.
    has_passed: bool,
    /// Whether the index is to be written.
    is_new: bool,
    open: Open,
    /// From the first to before the second, in nanoseconds; `None`: all of it.
    range: Option<(i64, i64)>,
}

/// What was read since the last place.
struct Open {
    records: u64,
    min_ns: i64,
    max_ns: i64,
    has_channel: Box<[bool; 256]>,
    /// Before it.
    issues: u64,
    notes: LeftOut,
    left_out: LeftOut,
}

impl Reading<'_> {
    /// How far it has come.
    fn position(&self) -> u64 {
        self.decoder.position().unwrap_or_else(|| self.input.offset())
    }
}

impl Open {
    fn of(reading: &Reading<'_>) -> Self {
        Self::after(reading.issues, reading.notes.clone(), reading.left_out.clone())
    }

    fn after(issues: u64, notes: LeftOut, left_out: LeftOut) -> Self {
        let has_channel = Box::new([false; 256]);
        Self { records: 0, min_ns: i64::MAX, max_ns: i64::MIN, has_channel, issues, notes, left_out }
    }

    /// What it is as a part that ends here.
    fn part(&self, reading: &Reading<'_>, index: &mut Index) -> Part {
        let has_channel = |channel: &u8| self.has_channel[usize::from(*channel)];
        let mut part = Part {
            records: self.records,
            min_ns: self.min_ns,
            max_ns: self.max_ns,
            has_issues: reading.issues > self.issues,
            channels: (0..=u8::MAX).filter(has_channel).collect(),
            ..Part::default()
        };
        index.count(&mut part, [reading.notes, &self.notes], [reading.left_out, &self.left_out]);
        part
    }
}

/// What an index depends on besides the file.
fn how(format: Format, options: &ReadOptions) -> String {
    format!("{format:?}, {:?}, {:?}", options.zone, options.columns)
}

/// What the system says now of the file that is read.
fn identity_now(input: &Input) -> Option<Identity> {
    input.file().and_then(|file| File::metadata(file).ok()).and_then(|about| Identity::of(&about))
}

impl Indexing {
    /// For a file whose bytes are read as they are; `None` if it is not to have an index.
    pub(crate) fn of(trace: &Path, format: Format, input: &Input, options: &ReadOptions) -> Option<Self> {
        let folder = options.index.clone()?;
        let about = input.file().filter(|_| !input.may_wait())?.metadata().ok()?;
        IndexFolder::is_for(about.len()).then_some(())?;
        let how = how(format, options);
        Some(Self {
            path: folder.file(trace, &how)?,
            folder,
            how,
            format,
            options: options.clone(),
            has_begun: false,
            index: Index::default(),
            identity: Identity::of(&about),
            is_learning: false,
            has_passed: false,
            is_new: false,
            open: Open::after(0, LeftOut::default(), LeftOut::default()),
            range: None,
        })
    }

    /// Begins to read what is in the range, of which the times of the first record may become known; all of it without one. Returns whether there is
    /// anything to do while reading.
    pub(crate) fn begin(
        &mut self,
        range: Option<&mut TimeRange>,
        reading: &mut Reading<'_>,
    ) -> io::Result<bool> {
        if std::mem::replace(&mut self.has_begun, true) {
            return Ok(true);
        }
        let mut state = Vec::new();
        if !reading.decoder.save(&mut state) {
            return Ok(false);
        }
        let is_random = reading.decoder.position().is_some();
        if is_random && self.identity.is_none() {
            return Ok(false);
        }
        let stored = IndexFolder::load(&self.path, &self.how).filter(|index| index.is_random == is_random);
        let is_same = |index: &Index| index.identity.is_some() && index.identity == self.identity;
        let stored_is_same = stored.as_ref().is_some_and(is_same);
        let stored = stored.filter(|_| stored_is_same || !is_random);
        let first = Place { offset: reading.position(), lines: 0, state };
        let usable = match (range, stored) {
            (None, Some(index)) if stored_is_same => {
                reading.decoder.restore_layout(&index.layout);
                return Ok(false);
            }
            (Some(range), Some(mut index)) => {
                if !stored_is_same && let Some(file) = reading.input.file() {
                    // It may have grown.
                    (&*file).seek(SeekFrom::Start(0))?;
                    index.blocks.keep_those_of(file)?;
                    index.prove();
                    self.is_new = true;
                }
                let first_ns = index.first_ns.filter(|_| index.places.first() == Some(&first));
                self.range = first_ns.and_then(|first_ns| range.beginning_at(first_ns));
                Some(index).filter(|_| self.range.is_some())
            }
            _ => None,
        };
        self.index = if let Some(index) = usable {
            reading.decoder.restore_layout(&index.layout);
            index
        } else {
            if self.folder.is_only_used() {
                return Ok(false);
            }
            self.range = None;
            self.is_learning = true;
            self.open = Open::of(reading);
            Index::beginning_at(first.clone(), is_random)
        };
        if is_random {
            return Ok(true);
        }
        reading.input.set_blocks(Some(std::mem::take(&mut self.index.blocks)));
        reading.input.seek_to(first.offset, 0)?;
        Ok(true)
    }

    /// Between two batches: learns a place, or goes on to the next part in which there is anything.
    pub(crate) fn step(&mut self, reading: &mut Reading<'_>) -> io::Result<()> {
        self.check(reading)?;
        let offset = reading.position();
        if self.is_learning {
            // At the file's end may be a part of a line, of which the rest is still to be written.
            let is_random = self.index.is_random;
            let is_end = |input: &mut Input| Ok::<_, io::Error>(!is_random && input.peek(1)?.is_empty());
            if self.index.is_due(offset) && !reading.input.has_nul_line() && !is_end(reading.input)? {
                self.learn(reading, offset);
            }
            return Ok(());
        }
        if self.range.is_none() || reading.input.has_nul_line() {
            return Ok(());
        }
        let Some(at) = self.index.at(offset) else { return Ok(()) };
        let wanted = |part: &Part| self.is_wanted(part);
        let next = at + self.index.parts[at..].iter().take_while(|part| !wanted(part)).count();
        if next > at || next == self.index.parts.len() {
            let mut state = Vec::new();
            if !reading.decoder.save(&mut state) {
                // What was read before the place has not been handed out.
                return Ok(());
            }
            // Whatever the index says is only used where the reading is where the index says it is.
            if state != self.index.places[at].state {
                return self.distrust(reading);
            }
        }
        if next > at && !self.go_to(at, next, reading)? {
            return Ok(());
        }
        if next == self.index.parts.len() {
            self.is_learning = true;
            self.open = Open::of(reading);
        }
        Ok(())
    }

    /// Whether anything in a part is asked for, or has to be reported.
    fn is_wanted(&self, part: &Part) -> bool {
        let is_inside = |(start_ns, end_ns)| part.max_ns >= start_ns && part.min_ns < end_ns;
        part.has_issues || part.records > 0 && self.range.is_none_or(is_inside)
    }

    fn learn(&mut self, reading: &mut Reading<'_>, offset: u64) {
        let mut state = Vec::new();
        if !reading.decoder.save(&mut state) {
            return;
        }
        if self.index.layout.is_empty() {
            // Without it, each reading goes through the file.
            reading.decoder.save_layout(&mut self.index.layout);
        }
        let place = Place { offset, lines: reading.input.line_number(), state };
        let part = self.open.part(reading, &mut self.index);
        self.index.add(part, place);
        self.open = Open::of(reading);
        self.is_new = true;
    }

    /// Passes over the parts from one on up to another. False if the index turned out to be wrong: then nothing has happened.
    fn go_to(&mut self, from: usize, to: usize, reading: &mut Reading<'_>) -> io::Result<bool> {
        let place = &self.index.places[to];
        let mut decoder = (FormatSpec::of(self.format).reader)(&self.options);
        let mut state = Vec::new();
        if decoder.restore(&place.state).is_none() || !decoder.save(&mut state) || state != place.state {
            return self.distrust(reading).map(|()| false);
        }
        decoder.restore_layout(&self.index.layout);
        self.has_passed = true;
        if !self.index.is_random {
            reading.input.seek_to(place.offset, place.lines)?;
        }
        *reading.decoder = decoder;
        for part in &self.index.parts[from..to] {
            *reading.records += part.records;
            if part.records > 0 {
                reading.passed.latest_ns = reading.passed.latest_ns.max(Some(part.max_ns));
            }
            reading.passed.records += part.records;
            reading.passed.channels.extend(&part.channels);
            self.index.pass(part, reading.notes, reading.left_out);
        }
        Ok(true)
    }

    /// The index is wrong: reads everything from here on, unless something was passed over because of it.
    fn distrust(&mut self, reading: &mut Reading<'_>) -> io::Result<()> {
        self.range = None;
        self.is_learning = false;
        self.is_new = false;
        reading.input.set_blocks(None);
        IndexFolder::forget(&self.path);
        if self.has_passed { Err(has_changed()) } else { Ok(()) }
    }

    /// A file that is read at many places must not have changed while a part of it is read.
    pub(crate) fn check(&mut self, reading: &mut Reading<'_>) -> io::Result<()> {
        if self.index.is_random && self.has_passed && identity_now(reading.input) != self.identity {
            return self.distrust(reading);
        }
        Ok(())
    }

    /// Records that were read.
    pub(crate) fn note(&mut self, frames: &[PlainFrame], records: &[TraceRecord]) {
        if !self.is_learning {
            return;
        }
        let frames_of = frames.iter().map(|frame| (frame.time_ns, frame.channel));
        for (time_ns, channel) in
            frames_of.chain(records.iter().map(|record| (record.time_ns, record.channel)))
        {
            self.index.first_ns.get_or_insert(time_ns);
            self.open.min_ns = self.open.min_ns.min(time_ns);
            self.open.max_ns = self.open.max_ns.max(time_ns);
            self.open.has_channel[usize::from(channel)] = true;
        }
        self.open.records += (frames.len() + records.len()) as u64;
    }

    /// At the end of the reading: keeps the index, if there is more in it than before.
    pub(crate) fn finish(&mut self, input: &mut Input) {
        if !self.index.is_random {
            let Some(blocks) = input.take_blocks() else { return };
            if blocks.differs {
                return IndexFolder::forget(&self.path);
            }
            self.index.blocks = blocks;
            self.index.prove();
        }
        if !std::mem::take(&mut self.is_new) || self.index.parts.is_empty() {
            return;
        }
        self.index.identity = identity_now(input).filter(|now| Some(*now) == self.identity);
        if self.index.is_random && self.index.identity.is_none() {
            return;
        }
        self.folder.keep(&self.path, &self.index, &self.how);
    }
}
