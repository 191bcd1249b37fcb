//! Reads a file of a ZIP archive, stored or deflated, above 4 GiB too: rawzip finds it in the directory at the archive's end. Its bytes are
//! unpacked as they are read, so memory does not grow with what they become. What rawzip leaves to us: the first file of an archive that was cut
//! off (PKWARE's APPNOTE 6.3.10, section 4.3.7), and that a file whose check does not fit still gives what can be read.

#[cfg(test)]
mod tests;

use std::io::{self, Read, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use super::format::Format;
use super::format_names::UnknownFormat;
use super::whole::{ReadSeek, Whole};
use cantap_trace::clean;
use rawzip::{
    ErrorKind, RangeReader, ReaderAt, ZipArchive, ZipArchiveEntryWayfinder, ZipFileHeaderRecord, ZipLocator,
};

/// So many bytes show whether a file is an archive.
pub(crate) const HEAD_BYTES: usize = 4;
/// How an archive begins: with its first file, or with the end of an empty one.
const MAGIC: [&[u8]; 2] = [FILE, b"PK\x05\x06"];
const FILE: &[u8] = b"PK\x03\x04";
const FILE_BYTES: usize = 30;
/// The longest name of a file, and its extra fields.
const NAME_BYTES: usize = 2 * 0xFFFF;
/// A directory larger than this is damage or malice: it would be one of 300,000 files.
const DIRECTORY_BYTES: u64 = 16 << 20;
/// So many names are shown of an archive that has several traces.
const SHOWN: usize = 10;

/// Why nothing of an archive is read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ArchiveError {
    /// Several of its files may be traces.
    #[error("{file} has several files; name the one to read: {}", shown(file, members))]
    Several {
        /// The archive's name, as given.
        file: String,
        /// The names of its files.
        members: Vec<String>,
    },
    /// It has no file of this name.
    #[error("{file} has no file {member}; there are: {}", shown(file, members))]
    Missing {
        /// The archive's name, as given.
        file: String,
        /// The name that was asked for.
        member: String,
        /// The names of its files.
        members: Vec<String>,
    },
    /// It has no file at all.
    #[error("{0} is an archive without files")]
    Empty(String),
    /// What should be one is none.
    #[error("{0} is no ZIP archive, so nothing in it can be named")]
    NotOne(String),
    /// A file is encrypted.
    #[error("{0} is encrypted; unpack it and read what comes out")]
    Encrypted(String),
    /// A file is packed by another method than Deflate.
    #[error("{0} is packed by method {1}, which is not read here; unpack it and read what comes out")]
    Method(String, u16),
    /// The archive's structure is damaged.
    #[error("{0} is damaged: {1}")]
    Damaged(String, &'static str),
}

/// The first names, as they are to be written.
fn shown(file: &str, members: &[String]) -> String {
    let mut shown: Vec<_> = members.iter().take(SHOWN).map(|member| format!("{file}/{member}")).collect();
    if members.len() > SHOWN {
        shown.push(format!("{} more", members.len() - SHOWN));
    }
    clean::line(&shown.join(", ")).into_owned()
}

/// The path of a file in an archive, for messages.
fn shown_path(file: &str, member: &Member) -> String {
    format!("{file}/{}", clean::line(&member.name))
}

/// Whether a file that begins so is an archive.
pub(crate) fn is_archive(head: &[u8]) -> bool {
    MAGIC.iter().any(|magic| head.starts_with(magic))
}

/// A path such as `traces.zip/inside/a.asc` as the archive and the name in it.
pub(crate) fn split(path: &Path) -> (&Path, Option<String>) {
    if path.as_os_str() == "-" || path.exists() {
        return (path, None);
    }
    let archive = path.ancestors().skip(1).find(|ancestor| ancestor.is_file());
    let inside = archive.and_then(|archive| Some((archive, path.strip_prefix(archive).ok()?)));
    let name = |path: &Path| path.iter().map(|part| part.to_string_lossy()).collect::<Vec<_>>().join("/");
    inside.map_or((path, None), |(archive, inside)| (archive, Some(name(inside))))
}

/// A file in an archive.
struct Member {
    name: String,
    is_encrypted: bool,
    method: u16,
    /// The check and the size of what is unpacked; `None` of a file that was cut off.
    expected: Option<(u32, u64)>,
    place: Option<ZipArchiveEntryWayfinder>,
}

impl Member {
    fn of(entry: &ZipFileHeaderRecord<'_>) -> Self {
        Self {
            name: String::from_utf8_lossy(entry.file_path().as_ref()).replace('\\', "/"),
            is_encrypted: entry.flags().is_encrypted(),
            method: entry.compression_method().as_u16(),
            expected: Some((entry.crc32(), entry.uncompressed_size_hint())),
            place: Some(entry.wayfinder()),
        }
    }
}

/// An archive's bytes, from any place.
struct Bytes {
    source: Mutex<Box<dyn ReadSeek>>,
    len: u64,
}

impl ReaderAt for Bytes {
    fn read_at(&self, out: &mut [u8], at: u64) -> io::Result<usize> {
        // In a damaged file an address may be beyond what the system can seek to.
        if at >= self.len {
            return Ok(0);
        }
        let mut source = self.source.lock().unwrap_or_else(PoisonError::into_inner);
        source.seek(SeekFrom::Start(at))?;
        source.read(out)
    }
}

/// Bytes of a file in an archive, and its name there.
pub(crate) type Inside = (PathBuf, Box<dyn Read + Send>);

/// Opens a file of the archive `file`: the one of this name, or else the only one that may be a trace.
pub(crate) fn open(whole: Whole, file: &str, member: Option<&str>) -> Result<Inside, OpenFailure> {
    let len = whole.len();
    let source = Bytes { source: Mutex::new(whole.into_source()), len };
    let mut buffer = vec![0; rawzip::MAX_CENTRAL_DIRECTORY_RECORD_SIZE];
    let archive = match ZipLocator::new().locate_in_reader(source, &mut buffer, len) {
        Ok(archive) => archive,
        Err((source, error)) if matches!(error.kind(), ErrorKind::MissingEndOfCentralDirectory) => {
            return open_first(source, file, member);
        }
        Err((_, error)) => return Err(failure(error, file)),
    };
    let mut members = members(&archive, &mut buffer, file)?;
    if members.iter().any(|member| member.name == "[Content_Types].xml") {
        let looks_like = "a spreadsheet or document: save its table as CSV";
        return Err(OpenFailure::NoTrace(UnknownFormat::NoTrace { file: file.to_owned(), looks_like }));
    }
    members.retain(|member| is_own(&member.name));
    let at = match member {
        Some(wanted) => members.iter().position(|member| member.name == wanted),
        None if members.len() == 1 => Some(0),
        None => {
            let mut traces = members.iter().enumerate().filter(|(_, member)| is_trace(&member.name));
            traces.next().filter(|_| traces.next().is_none()).map(|(at, _)| at)
        }
    };
    let Some(at) = at else {
        let members: Vec<String> = members.into_iter().map(|member| member.name).collect();
        let file = file.to_owned();
        return Err(OpenFailure::Archive(match member {
            _ if members.is_empty() => ArchiveError::Empty(file),
            Some(member) => ArchiveError::Missing { file, member: member.to_owned(), members },
            None => ArchiveError::Several { file, members },
        }));
    };
    let member = members.swap_remove(at);
    let entry = member.place.and_then(|place| archive.get_entry(place).ok());
    let Some(range) = entry.map(|entry| entry.compressed_data_range()) else {
        let what = "it does not begin where the directory says";
        return Err(OpenFailure::Archive(ArchiveError::Damaged(shown_path(file, &member), what)));
    };
    unpacked(archive.into_inner(), range, member, file)
}

/// The files of an archive.
fn members(archive: &ZipArchive<Bytes>, buffer: &mut [u8], file: &str) -> Result<Vec<Member>, OpenFailure> {
    if archive.eocd_offset().saturating_sub(archive.directory_offset()) > DIRECTORY_BYTES {
        let what = "its directory is larger than 16 MiB";
        return Err(OpenFailure::Archive(ArchiveError::Damaged(file.to_owned(), what)));
    }
    let mut entries = archive.entries(buffer);
    let mut members = Vec::new();
    while let Some(entry) = entries.next_entry().map_err(|error| failure(error, file))? {
        members.push(Member::of(&entry));
    }
    Ok(members)
}

/// What rawzip's errors come to.
fn failure(error: rawzip::Error, file: &str) -> OpenFailure {
    match error.into_kind() {
        // The system's errors have a number; the others say that the file ends.
        ErrorKind::IO(error) if error.raw_os_error().is_some() => OpenFailure::Io(error),
        _ => OpenFailure::Archive(ArchiveError::Damaged(file.to_owned(), "its directory is not whole")),
    }
}

/// The first file of an archive whose directory was cut off: as much of it as there is.
fn open_first(source: Bytes, file: &str, wanted: Option<&str>) -> Result<Inside, OpenFailure> {
    let damaged = |what| OpenFailure::Archive(ArchiveError::Damaged(file.to_owned(), what));
    let len = source.len;
    let mut header = Vec::new();
    RangeReader::new(&source, 0..len.min((FILE_BYTES + NAME_BYTES) as u64)).read_to_end(&mut header)?;
    let name = header.get(FILE_BYTES..).and_then(|rest| rest.get(..u16_at(&header, 26)));
    let name = name.filter(|_| header.starts_with(FILE));
    let name = name.ok_or_else(|| damaged("its directory is missing, and its first file"))?;
    let member = Member {
        name: String::from_utf8_lossy(name).into_owned(),
        is_encrypted: header[6] & 1 != 0,
        method: u16_at(&header, 8) as u16,
        expected: None,
        place: None,
    };
    if wanted.is_some_and(|wanted| wanted != member.name) {
        return Err(damaged("its directory is missing, so only its first file can be read"));
    }
    let from = (FILE_BYTES + u16_at(&header, 26) + u16_at(&header, 28)) as u64;
    unpacked(source, (from, len.max(from)), member, file)
}

/// What a file becomes whose packed bytes are in this range.
fn unpacked(
    source: Bytes,
    (from, to): (u64, u64),
    member: Member,
    file: &str,
) -> Result<Inside, OpenFailure> {
    let packed = RangeReader::new(source, from..to);
    let source: Box<dyn Read + Send> = match member.method {
        _ if member.is_encrypted => {
            return Err(OpenFailure::Archive(ArchiveError::Encrypted(shown_path(file, &member))));
        }
        0 => Box::new(packed),
        8 => Box::new(flate2::read::DeflateDecoder::new(packed)),
        method => return Err(OpenFailure::Archive(ArchiveError::Method(shown_path(file, &member), method))),
    };
    let source: Box<dyn Read + Send> = match member.expected {
        Some(expected) => Box::new(Checked { source, crc: flate2::Crc::new(), expected, ended: false }),
        None => Box::new(Cut(source)),
    };
    Ok((PathBuf::from(member.name), source))
}

/// Why an archive could not be opened.
pub(crate) enum OpenFailure {
    Io(io::Error),
    Archive(ArchiveError),
    NoTrace(UnknownFormat),
}

impl From<io::Error> for OpenFailure {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

/// Whether a name is that of a file that a person put there: no folder, and nothing that a system adds.
fn is_own(name: &str) -> bool {
    let last = name.rsplit('/').next().unwrap_or_default();
    !last.is_empty() && !last.starts_with('.') && !name.starts_with("__MACOSX/")
}

/// Whether a name may be that of a trace, and not what lies beside one to explain it.
fn is_trace(name: &str) -> bool {
    let last = name.rsplit('/').next().unwrap_or_default().to_ascii_lowercase();
    let explains = ["readme", "license", "licence", "notice"].iter().any(|begin| last.starts_with(begin));
    !explains && Format::of_path(Path::new(&last)).is_ok()
}

fn u16_at(bytes: &[u8], at: usize) -> usize {
    bytes.get(at..at + 2).map_or(0, |field| usize::from(u16::from_le_bytes([field[0], field[1]])))
}

/// Compares a file's check and size at its end.
struct Checked {
    source: Box<dyn Read + Send>,
    crc: flate2::Crc,
    /// The check and the size.
    expected: (u32, u64),
    ended: bool,
}

impl Read for Checked {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        if self.ended || out.is_empty() {
            return Ok(0);
        }
        let read = self.source.read(out)?;
        self.crc.update(&out[..read]);
        self.expected.1 = self.expected.1.wrapping_sub(read as u64);
        self.ended = read == 0;
        if self.ended && (self.expected.1 != 0 || self.crc.sum() != self.expected.0) {
            let what = "what was unpacked does not fit the archive's check";
            return Err(io::Error::new(io::ErrorKind::InvalidData, what));
        }
        Ok(read)
    }
}

/// A file of which nobody knows whether it is whole.
struct Cut(Box<dyn Read + Send>);

impl Read for Cut {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        match self.0.read(out)? {
            0 if !out.is_empty() => Err(io::ErrorKind::UnexpectedEof.into()),
            read => Ok(read),
        }
    }
}
