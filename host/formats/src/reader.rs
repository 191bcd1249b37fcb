//! Reading a trace of any format as a stream.

mod files;
mod indexed;

use std::borrow::Cow;
use std::collections::VecDeque;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::Format;
use super::archive::{self, ArchiveError, OpenFailure};
use super::codec::{BATCH, Decode};
use super::content;
use super::format_names::UnknownFormat;
use super::found::Found;
use super::input::Input;
use super::issue::{Fault, Place, ReadIssue};
use super::left_out::LeftOut;
use super::read_options::ReadOptions;
use super::seek::{Indexing, Passed};
use super::spec::FormatSpec;
use cantap_trace::{PlainFrame, TraceRecord, clean};

/// Why a file cannot be opened for reading.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// The system refused.
    #[error("cannot open {0}: {1}")]
    Io(String, #[source] io::Error),
    /// Neither name nor content show the format.
    #[error(transparent)]
    Format(#[from] UnknownFormat),
    /// Which file of an archive to read is not clear, or it cannot be unpacked.
    #[error(transparent)]
    Archive(#[from] ArchiveError),
}

/// Nothing of a file could be read, and it is not simply empty.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("nothing in {file} could be read as {format}; it looks like {looks_like}")]
pub struct NothingRead {
    /// The file's name, as given.
    pub file: Arc<str>,
    /// The format it was read as.
    pub format: Format,
    /// A description of what its beginning looks like.
    pub looks_like: String,
}

/// A trace being read: an iterator of records and issues in the file's order. Memory does not grow with
/// the file.
pub struct TraceReader {
    name: Arc<str>,
    format: Format,
    input: Input,
    decoder: Box<dyn Decode>,
    /// Decoded records; those before `at` are used up.
    batch: Vec<TraceRecord>,
    at: usize,
    /// What follows them.
    after: Option<io::Result<Found>>,
    strict: bool,
    issues: u64,
    notes: LeftOut,
    left_out: LeftOut,
    ended: bool,
    /// Number of records decoded.
    records: u64,
    /// The format according to the name, if the content is in another one.
    named: Option<Format>,
    head: Vec<u8>,
    /// The files of the recording that follow this one.
    others: VecDeque<PathBuf>,
    /// Whether the end that was reached is one of a file with others behind it.
    between_files: bool,
    /// The index that is made or used, if there is one.
    indexing: Option<Box<Indexing>>,
    /// Records that were passed over.
    passed: Passed,
}

/// The beginning of a file, to say what it looks like.
fn head_of(input: &Input) -> Vec<u8> {
    input.buffered().iter().take(content::HEAD_BYTES).copied().collect()
}

/// What is wrong with a line of text that has NUL bytes, such as after a crash.
fn nul() -> Fault {
    Fault::Malformed { expected: "text".into(), found: "NUL bytes: a part of the file was lost here".into() }
}

/// What follows a batch of records.
enum Beyond {
    Batch,
    Issue(ReadIssue),
    End,
}

/// Opens a trace file, or standard input for `-` (a candump log unless the options or the first bytes say
/// otherwise). Compression (gzip, zstd, xz, LZ4, bzip2) is recognised by content. Of a ZIP archive, the only file that may be a trace is read, or the
/// one in a path such as `traces.zip/inside/a.asc`. A folder is one trace if it is a bag of ROS 2.
pub fn open_reader(path: impl AsRef<Path>, options: &ReadOptions) -> Result<TraceReader, OpenError> {
    let path = path.as_ref();
    if path.is_dir() {
        return TraceReader::of_folder(path, options);
    }
    open_file(path, options)
}

/// As [`open_reader`], but of no folder.
fn open_file(path: &Path, options: &ReadOptions) -> Result<TraceReader, OpenError> {
    let name = if path.as_os_str() == "-" { "standard input".to_owned() } else { path.display().to_string() };
    let (file, member) = archive::split(path);
    let input = Input::open(file, options.follow).map_err(|error| OpenError::Io(name.clone(), error))?;
    let name = if member.is_some() { file.display().to_string() } else { name };
    open(file, name, input, member.as_deref(), options)
}

/// Finds the file to read, if it is in an archive, and opens it.
fn open(
    path: &Path,
    name: String,
    mut input: Input,
    member: Option<&str>,
    options: &ReadOptions,
) -> Result<TraceReader, OpenError> {
    let failed = |error| OpenError::Io(name.clone(), error);
    // A pipe may deliver less than that for a long time, but no archive.
    let head =
        if input.has_line() { input.buffered() } else { input.peek(archive::HEAD_BYTES).map_err(failed)? };
    if !archive::is_archive(head) {
        return match member {
            Some(_) => Err(ArchiveError::NotOne(name).into()),
            None => recognise(path, name, input, options),
        };
    }
    let opened = archive::open(input.whole().map_err(failed)?, &name, member);
    let (inside, source) = opened.map_err(|failure| match failure {
        OpenFailure::Io(error) => failed(error),
        OpenFailure::Archive(error) => error.into(),
        OpenFailure::NoTrace(error) => error.into(),
    })?;
    let name = format!("{name}/{}", clean::line(&inside.to_string_lossy()));
    let input = Input::unpacking(source).map_err(|error| OpenError::Io(name.clone(), error))?;
    recognise(&inside, name, input, options)
}

/// Like [`open_reader`], for the bytes of a file of this name that is not in the file system: an archive's, a browser's.
pub fn open_source(
    name: &str,
    source: impl Read + Send + 'static,
    options: &ReadOptions,
) -> Result<TraceReader, OpenError> {
    let input = Input::decompressing(Box::new(source), options.follow)
        .map_err(|error| OpenError::Io(name.to_owned(), error))?;
    open(Path::new(name), name.to_owned(), input, None, options)
}

/// Finds the format by content and name.
fn recognise(
    path: &Path,
    name: String,
    mut input: Input,
    options: &ReadOptions,
) -> Result<TraceReader, OpenError> {
    let failed = |error| OpenError::Io(name.clone(), error);
    let mut named = None;
    let table = options.columns.as_ref().map(|_| Format::Table);
    let format = if let Some(format) = options.format {
        format
    } else if let Some(table) = table {
        // Columns are those of a text, of Parquet or of JSON.
        let head = if input.has_line() { input.buffered() } else { input.peek(64).map_err(failed)? };
        let typed = |format: &Format| matches!(format, Format::Parquet | Format::Json);
        let named = Format::of_path(path).ok().filter(|format| *format == Format::Json);
        Format::of_content(head).filter(typed).or(named).unwrap_or(table)
    } else {
        // A pipe may deliver only a single line for a long time.
        let head = if input.has_line() { input.buffered() } else { input.peek(64).map_err(failed)? };
        match (Format::of_path(path), Format::of_content(head)) {
            (Ok(format), Some(content)) if !content.is_kind_of(format) => {
                // The logs of other programs use the same suffixes as our formats.
                named = (!content.has_suffix_of(path)).then_some(format);
                content
            }
            (Ok(format), _) | (Err(_), Some(format)) => format,
            (Err(_), None) if path.as_os_str() == "-" => Format::Candump,
            (Err(unknown), None) => {
                let looks_like = content::known(head);
                let no_trace =
                    looks_like.map(|looks_like| UnknownFormat::NoTrace { file: name.clone(), looks_like });
                return Err(no_trace.unwrap_or(unknown).into());
            }
        }
    };
    input.set_zone(options.zone.clone());
    let indexing = Indexing::of(path, format, &input, options).map(Box::new);
    let mut reader = TraceReader::new(name.into(), format, input, options);
    (reader.named, reader.indexing) = (named, indexing);
    Ok(reader)
}

impl TraceReader {
    fn new(name: Arc<str>, format: Format, input: Input, options: &ReadOptions) -> Self {
        let decoder = (FormatSpec::of(format).reader)(options);
        let batch = Vec::with_capacity(BATCH);
        let head = head_of(&input);
        Self {
            name,
            format,
            input,
            decoder,
            batch,
            at: 0,
            after: None,
            strict: options.strict,
            issues: 0,
            notes: LeftOut::default(),
            left_out: LeftOut::default(),
            ended: false,
            records: 0,
            named: None,
            head,
            others: VecDeque::new(),
            between_files: false,
            indexing: None,
            passed: Passed::default(),
        }
    }

    /// Reads from any source of bytes, plain or compressed. Issues refer to it as `name`.
    pub fn from_source(
        name: &str,
        source: impl Read + Send + 'static,
        format: Format,
        options: &ReadOptions,
    ) -> io::Result<Self> {
        let mut input = Input::decompressing(Box::new(source), options.follow)?;
        input.set_zone(options.zone.clone());
        Ok(Self::new(name.into(), format, input, options))
    }

    /// The file's format.
    pub fn format(&self) -> Format {
        self.format
    }

    /// The format according to the file's name, if the content was clearly in another one, as which it is
    /// read.
    pub fn named_otherwise(&self) -> Option<Format> {
        self.named
    }

    /// How many records have been decoded so far, some of which may not have been handed out, or were left out by [`Self::within`].
    pub fn records(&self) -> u64 {
        self.records
    }

    /// Whether nothing of the file could be read so far although it is not empty.
    pub fn nothing_read(&self) -> Option<NothingRead> {
        // Without a head, comments alone show nothing of a format.
        let only_comments = !FormatSpec::of(self.format).has_head && !self.head.is_empty();
        let something = self.issues > 0 || !self.left_out.is_empty() || only_comments;
        (self.records == 0 && something).then(|| NothingRead {
            file: self.name.clone(),
            format: self.format,
            looks_like: if self.issues == 0 && self.left_out.is_empty() {
                "a text without a single frame, such as comments".to_owned()
            } else if self.issues == 0 {
                let kinds: Vec<_> =
                    self.left_out.iter().map(|(what, count)| format!("{what} ({count})")).collect();
                format!("{} without traffic of CAN: {}", self.format, kinds.join(", "))
            } else {
                content::looks_like(&self.head, self.format)
            },
        })
    }

    /// While waiting for more of a followed file, ends as soon as `stop` returns true.
    pub fn end_when(&mut self, stop: impl Fn() -> bool + Send + 'static) {
        self.input.end_when(Box::new(stop));
    }

    /// Whether the next record may have to be waited for: everything read before is used up, and this is a pipe, or a file
    /// that is followed.
    pub fn would_wait(&self) -> bool {
        self.input.may_wait()
            && self.at == self.batch.len()
            && self.after.is_none()
            && !(self.decoder.needs_one_line() && self.input.has_line())
    }

    /// Whether the file's compressed data are damaged or end early, so that nobody can say how much of it is missing.
    pub fn is_of_unknown_length(&self) -> bool {
        self.input.compressed_data_cut() || self.input.damage().is_some()
    }

    /// Number of issues so far.
    pub fn issues(&self) -> u64 {
        self.issues
    }

    /// What is not wrong but should be known, such as skipped requests to send a frame: so far, and how often.
    pub fn notes(&self) -> &LeftOut {
        &self.notes
    }

    /// Well-formed parts of the file that do not belong in a CAN trace, such as LIN frames or markers: so far, by
    /// kind.
    pub fn left_out(&self) -> &LeftOut {
        &self.left_out
    }

    /// What an MF4 file says about its measurement, by name: device, session, author, the program that wrote it. It is known once
    /// something was read. The texts are the file's own: clean them for a terminal.
    pub fn properties(&self) -> impl Iterator<Item = (&str, &str)> {
        let properties = self.decoder.properties().into_iter().flatten();
        properties.map(|(name, value)| (name.as_str(), value.as_str()))
    }

    /// Bit rates of channels, outside CAN FD's data phases, as far as the file has said them: channel from 1, bit/s. One is known before
    /// the first record of its channel is handed out.
    pub fn bit_rates(&self) -> &[(u8, u32)] {
        self.decoder.bit_rates()
    }

    fn issue(&mut self, place: Place, fault: Fault) -> ReadIssue {
        self.issues += 1;
        self.ended |= self.strict || matches!(fault, Fault::Io(_));
        self.between_files &= !self.strict;
        ReadIssue { file: self.name.clone(), place, fault }
    }

    /// What follows when the batch is used up. A new batch may be empty.
    fn beyond_batch(&mut self) -> Beyond {
        if self.ended {
            let next = std::mem::take(&mut self.between_files).then(|| self.others.pop_front()).flatten();
            return next.map_or(Beyond::End, |next| self.begin_next_file(&next));
        }
        if self.after.is_none()
            && let Some(line) = self.input.nul_line()
        {
            return Beyond::Issue(self.issue(Place::Line(line), nul()));
        }
        let Some(after) = self.after.take() else {
            self.batch.clear();
            self.at = 0;
            self.after = match self.step() {
                Ok(()) => self.decoder.batch(&mut self.input, &mut self.batch).transpose(),
                Err(error) => Some(Err(error)),
            };
            self.records += self.batch.len() as u64;
            if let Some(indexing) = &mut self.indexing {
                indexing.note(&[], &self.batch);
            }
            return Beyond::Batch;
        };
        match after {
            Ok(Found::Record(record)) => {
                self.records += 1;
                if let Some(indexing) = &mut self.indexing {
                    indexing.note(&[], &[record]);
                }
                self.batch.push(record);
                Beyond::Batch
            }
            Ok(Found::Note(what)) => {
                self.notes.note(what);
                Beyond::Batch
            }
            // Nothing is wrong with it; it is just not ours.
            Ok(Found::LeftOut(what) | Found::Issue(_, Fault::Unsupported(Cow::Borrowed(what)))) => {
                self.left_out.note(what);
                Beyond::Batch
            }
            Ok(Found::Issue(place, fault)) => {
                // Those before it come first, and one is said to be wrong once.
                match self.input.nul_line() {
                    Some(line) if place == Place::Line(line) => Beyond::Issue(self.issue(place, nul())),
                    Some(line) => {
                        self.after = Some(Ok(Found::Issue(place, fault)));
                        Beyond::Issue(self.issue(Place::Line(line), nul()))
                    }
                    None => Beyond::Issue(self.issue(place, fault)),
                }
            }
            Ok(Found::End) => {
                if let Some(line) = self.input.nul_line() {
                    self.after = Some(Ok(Found::End));
                    return Beyond::Issue(self.issue(Place::Line(line), nul()));
                }
                (self.ended, self.between_files) = (true, !self.others.is_empty());
                if let Err(error) = self.end_index() {
                    let place = Place::Offset(self.input.offset());
                    return Beyond::Issue(self.issue(place, Fault::Io(error)));
                }
                if let Some(damage) = self.input.damage() {
                    let fault = Fault::malformed("undamaged compressed data to the end", damage.as_bytes());
                    return Beyond::Issue(self.issue(Place::Offset(self.input.offset()), fault));
                }
                let is_empty = self.head.is_empty() && self.input.offset() == 0 && self.issues == 0;
                if is_empty && !self.input.follows() {
                    if FormatSpec::of(self.format).has_head {
                        let fault = Fault::malformed(format!("the head of a file in {}", self.format), b"");
                        return Beyond::Issue(self.issue(Place::Offset(0), fault));
                    }
                    self.notes.note("the file is empty");
                }
                if self.input.compressed_data_cut() {
                    let place = Place::Offset(self.input.offset());
                    return Beyond::Issue(self.issue(place, Fault::Truncated("the compressed data")));
                }
                if self.between_files { Beyond::Batch } else { Beyond::End }
            }
            Err(error) => {
                self.keep_index();
                let place = Place::Offset(self.input.offset());
                Beyond::Issue(self.issue(place, Fault::Io(error)))
            }
        }
    }

    /// Replaces the content of `records` with the next records, at least one and as many as are at hand: for loops in
    /// which [`Iterator::next`] would be the slowest part. `None` at the end.
    pub fn next_batch(&mut self, records: &mut Vec<TraceRecord>) -> Option<Result<(), ReadIssue>> {
        records.clear();
        while self.at == self.batch.len() {
            match self.beyond_batch() {
                Beyond::Batch => {}
                Beyond::Issue(issue) => return Some(Err(issue)),
                Beyond::End => return None,
            }
        }
        self.hand_out(records);
        Some(Ok(()))
    }

    /// As [`Self::next_batch`], but data frames of classical CAN may be in `frames`, and are then before all `records`: for
    /// whoever wants nothing of them but what [`PlainFrame`] has. Which frames are there depends on the format and on how
    /// the file is laid out; the order does not.
    pub fn next_mixed(
        &mut self,
        frames: &mut Vec<PlainFrame>,
        records: &mut Vec<TraceRecord>,
    ) -> Option<Result<(), ReadIssue>> {
        frames.clear();
        records.clear();
        while self.at == self.batch.len() {
            if self.ended || self.after.is_some() {
                match self.beyond_batch() {
                    Beyond::Batch => continue,
                    Beyond::Issue(issue) => return Some(Err(issue)),
                    Beyond::End => return None,
                }
            }
            self.batch.clear();
            self.at = 0;
            self.after = match self.step() {
                Ok(()) => self.decoder.mixed(&mut self.input, frames, &mut self.batch).transpose(),
                Err(error) => Some(Err(error)),
            };
            self.records += (frames.len() + self.batch.len()) as u64;
            if let Some(indexing) = &mut self.indexing {
                indexing.note(frames, &self.batch);
            }
            if !frames.is_empty() {
                break;
            }
        }
        self.hand_out(records);
        Some(Ok(()))
    }

    /// Puts what is left of the batch into `records`, which is empty.
    fn hand_out(&mut self, records: &mut Vec<TraceRecord>) {
        if self.at == 0 {
            std::mem::swap(records, &mut self.batch);
        } else {
            records.extend(self.batch.drain(..).skip(self.at));
        }
        self.at = 0;
    }
}

impl Iterator for TraceReader {
    type Item = Result<TraceRecord, ReadIssue>;

    #[inline]
    fn next(&mut self) -> Option<Self::Item> {
        loop {
            if let Some(record) = self.batch.get(self.at) {
                self.at += 1;
                return Some(Ok(*record));
            }
            match self.beyond_batch() {
                Beyond::Batch => {}
                Beyond::Issue(issue) => return Some(Err(issue)),
                Beyond::End => return None,
            }
        }
    }
}
