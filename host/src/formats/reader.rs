//! Reading a trace of any format as a stream.

use std::io::{self, Read};
use std::path::Path;
use std::sync::Arc;

use super::input::Input;
use super::issue::{Fault, Place, ReadIssue};
use super::{Format, UnknownFormat, asc, blf, candump, csv, dif, pcapng, trc};
use crate::TraceRecord;

/// How to read.
#[derive(Clone, Debug, Default)]
pub struct ReadOptions {
    /// The format; by the file's suffix or first bytes if not given.
    pub format: Option<Format>,
    /// Wait for more at the end of the file instead of ending.
    pub follow: bool,
    /// End after the first issue.
    pub strict: bool,
}

/// Why a file cannot be opened for reading.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The system refused.
    #[error("cannot open {0}: {1}")]
    Io(String, #[source] io::Error),
    /// Neither name nor content tell the format.
    #[error(transparent)]
    Format(#[from] UnknownFormat),
}

/// What a format's reader finds next.
pub(crate) enum Found {
    /// A record.
    Record(TraceRecord),
    /// Something wrong; reading goes on behind it.
    Issue(Place, Fault),
    /// The end.
    End,
}

/// The reading half of a format.
pub(crate) trait Decode: Send {
    /// The next record or issue. Errors are those of the system.
    fn next(&mut self, input: &mut Input) -> io::Result<Found>;
}

/// A trace being read: an iterator of records and issues in the file's order. Memory does not grow with
/// the file.
pub struct TraceReader {
    name: Arc<str>,
    format: Format,
    input: Input,
    decoder: Box<dyn Decode>,
    strict: bool,
    issues: u64,
    ended: bool,
}

/// Opens a trace file, or standard input for `-` (a candump log unless the options or the first bytes
/// say otherwise). gzip and zstd are recognised by content.
pub fn open_reader(path: impl AsRef<Path>, options: &ReadOptions) -> Result<TraceReader, OpenError> {
    let path = path.as_ref();
    let name = if path.as_os_str() == "-" { "standard input".to_owned() } else { path.display().to_string() };
    let failed = |error| OpenError::Io(name.clone(), error);
    let mut input = Input::open(path, options.follow).map_err(failed)?;
    let format = match options.format {
        Some(format) => format,
        None => match Format::of_path(path) {
            Ok(format) => format,
            Err(unknown) => {
                let head = input.peek(64).map_err(failed)?;
                match Format::of_content(head) {
                    Some(format) => format,
                    None if path.as_os_str() == "-" => Format::Candump,
                    None => return Err(unknown.into()),
                }
            }
        },
    };
    Ok(TraceReader::new(name.into(), format, input, options.strict))
}

impl TraceReader {
    fn new(name: Arc<str>, format: Format, input: Input, strict: bool) -> Self {
        let decoder: Box<dyn Decode> = match format {
            Format::Candump => Box::new(candump::Decoder::default()),
            Format::Asc => Box::new(asc::Decoder::default()),
            Format::Blf => Box::new(blf::Decoder::default()),
            Format::Trc(_) => Box::new(trc::Decoder::default()),
            Format::Csv(_) => Box::new(csv::Decoder::default()),
            Format::Pcapng => Box::new(pcapng::Decoder::default()),
            Format::Dif => Box::new(dif::Decoder::default()),
        };
        Self { name, format, input, decoder, strict, issues: 0, ended: false }
    }

    /// Reads from any source of bytes, plain or compressed. `name` is what issues call it.
    pub fn from_source(
        name: &str,
        source: impl Read + Send + 'static,
        format: Format,
        options: &ReadOptions,
    ) -> io::Result<Self> {
        let input = Input::decompressing(Box::new(source), options.follow)?;
        Ok(Self::new(name.into(), format, input, options.strict))
    }

    /// The file's format.
    pub fn format(&self) -> Format {
        self.format
    }

    /// While waiting for more of a file that is followed, ends as soon as this is true.
    pub fn end_when(&mut self, stop: impl Fn() -> bool + Send + 'static) {
        self.input.end_when(Box::new(stop));
    }

    /// Whether the next record may have to be waited for: what was read before is used up.
    pub fn would_wait(&self) -> bool {
        self.input.is_used_up()
    }

    /// How many issues have come so far.
    pub fn issues(&self) -> u64 {
        self.issues
    }

    fn issue(&mut self, place: Place, fault: Fault) -> ReadIssue {
        self.issues += 1;
        self.ended |= self.strict || matches!(fault, Fault::Io(_));
        ReadIssue { file: self.name.clone(), place, fault }
    }
}

impl Iterator for TraceReader {
    type Item = Result<TraceRecord, ReadIssue>;

    #[inline]
    fn next(&mut self) -> Option<Self::Item> {
        if self.ended {
            return None;
        }
        match self.decoder.next(&mut self.input) {
            Ok(Found::Record(record)) => Some(Ok(record)),
            Ok(Found::Issue(place, fault)) => Some(Err(self.issue(place, fault))),
            Ok(Found::End) => {
                self.ended = true;
                let cut = self.input.compressed_data_cut();
                let place = Place::Offset(self.input.offset());
                cut.then(|| Err(self.issue(place, Fault::Truncated("the compressed data"))))
            }
            Err(error) => {
                let place = Place::Offset(self.input.offset());
                Some(Err(self.issue(place, Fault::Io(error))))
            }
        }
    }
}
