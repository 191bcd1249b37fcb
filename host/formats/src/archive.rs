//! Reads a file of a ZIP archive, by the directory at its end (PKWARE's APPNOTE 6.3.10, sections 4.3 and 4.5.3): stored or deflated, above 4 GiB too.
//! A file's bytes are unpacked as they are read, so memory does not grow with what they become.

#[cfg(test)]
mod tests;

use std::io::{self, Read};
use std::path::{Path, PathBuf};

use super::format::Format;
use super::spec::UnknownFormat;
use super::whole::Whole;
use cantap_trace::clean;

/// So many bytes show whether a file is an archive.
pub(crate) const HEAD_BYTES: usize = 4;
/// How an archive begins: with its first file, or with the end of an empty one.
const MAGIC: [&[u8]; 2] = [FILE, b"PK\x05\x06"];
const FILE: &[u8] = b"PK\x03\x04";
const FILE_BYTES: usize = 30;
const ENTRY: &[u8] = b"PK\x01\x02";
const ENTRY_BYTES: usize = 46;
const END: &[u8] = b"PK\x05\x06";
const END_BYTES: usize = 22;
const LOCATOR: &[u8] = b"PK\x06\x07";
const LOCATOR_BYTES: usize = 20;
const LONG_END: &[u8] = b"PK\x06\x06";
const LONG_END_BYTES: usize = 56;
/// A comment follows the end, of this many bytes at most.
const COMMENT_BYTES: usize = 0xFFFF;
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
    /// What the flags say: encrypted.
    encrypted: bool,
    method: u16,
    crc: u32,
    /// Packed and unpacked size.
    packed: u64,
    size: u64,
    /// Where its header begins.
    at: u64,
}

/// Bytes of a file in an archive, and its name there.
pub(crate) type Inside = (PathBuf, Box<dyn Read + Send>);

/// Opens a file of the archive `file`: the one of this name, or else the only one that may be a trace.
pub(crate) fn open(mut whole: Whole, file: &str, member: Option<&str>) -> Result<Inside, OpenFailure> {
    let Some(mut members) = members(&mut whole).map_err(|failure| failure.of(file))? else {
        return open_first(whole, file, member);
    };
    if members.iter().any(|member| member.name == "[Content_Types].xml") {
        let looks_like = "a spreadsheet or document: save its table as CSV";
        return Err(OpenFailure::NoTrace(UnknownFormat::NoTrace { file: file.to_owned(), looks_like }));
    }
    members.retain(|member| is_own(&member.name));
    let names = |members: &[Member]| members.iter().map(|member| member.name.clone()).collect();
    let at = match member {
        Some(wanted) => members.iter().position(|member| member.name == wanted),
        None if members.len() == 1 => Some(0),
        None => {
            let mut traces = members.iter().enumerate().filter(|(_, member)| is_trace(&member.name));
            traces.next().filter(|_| traces.next().is_none()).map(|(at, _)| at)
        }
    };
    let file = file.to_owned();
    let Some(at) = at else {
        let members: Vec<String> = names(&members);
        return Err(OpenFailure::Archive(match member {
            _ if members.is_empty() => ArchiveError::Empty(file),
            Some(member) => ArchiveError::Missing { file, member: member.to_owned(), members },
            None => ArchiveError::Several { file, members },
        }));
    };
    let member = members.swap_remove(at);
    let shown = shown_path(&file, &member);
    let from = whole.read_at(member.at, FILE_BYTES)?;
    if !from.starts_with(FILE) || from.len() < FILE_BYTES {
        return Err(OpenFailure::Archive(ArchiveError::Damaged(
            shown,
            "it does not begin where the directory says",
        )));
    }
    let from = member.at + (FILE_BYTES + u16_at(&from, 26) + u16_at(&from, 28)) as u64;
    let packed = Part { whole, at: from, end: from.saturating_add(member.packed) };
    let source = unpacked(packed, &member, shown)?;
    let checked =
        Checked { source, crc: flate2::Crc::new(), expected: (member.crc, member.size), ended: false };
    Ok((PathBuf::from(member.name), Box::new(checked)))
}

/// The first file of an archive whose directory was cut off: as much of it as there is.
fn open_first(mut whole: Whole, file: &str, wanted: Option<&str>) -> Result<Inside, OpenFailure> {
    let damaged = |what| OpenFailure::Archive(ArchiveError::Damaged(file.to_owned(), what));
    let header = whole.read_at(0, FILE_BYTES + COMMENT_BYTES)?;
    let name = header.get(FILE_BYTES..).and_then(|rest| rest.get(..u16_at(&header, 26)));
    let name = name.filter(|_| header.starts_with(FILE));
    let name = name.ok_or_else(|| damaged("its directory is missing, and its first file"))?;
    let member = Member {
        name: String::from_utf8_lossy(name).into_owned(),
        encrypted: header[6] & 1 != 0,
        method: u16_at(&header, 8) as u16,
        crc: 0,
        packed: 0,
        size: 0,
        at: 0,
    };
    if wanted.is_some_and(|wanted| wanted != member.name) {
        return Err(damaged("its directory is missing, so only its first file can be read"));
    }
    let from = (FILE_BYTES + u16_at(&header, 26) + u16_at(&header, 28)) as u64;
    let end = whole.len();
    let source = unpacked(Part { whole, at: from, end }, &member, shown_path(file, &member))?;
    Ok((PathBuf::from(member.name), Box::new(Cut(source))))
}

fn unpacked(packed: Part, member: &Member, shown: String) -> Result<Box<dyn Read + Send>, OpenFailure> {
    match member.method {
        _ if member.encrypted => Err(OpenFailure::Archive(ArchiveError::Encrypted(shown))),
        0 => Ok(Box::new(packed)),
        8 => Ok(Box::new(flate2::read::DeflateDecoder::new(packed))),
        method => Err(OpenFailure::Archive(ArchiveError::Method(shown, method))),
    }
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

/// Why a directory could not be read.
enum DirectoryFailure {
    Io(io::Error),
    Damaged(&'static str),
}

impl DirectoryFailure {
    fn of(self, file: &str) -> OpenFailure {
        match self {
            Self::Io(error) => OpenFailure::Io(error),
            Self::Damaged(what) => OpenFailure::Archive(ArchiveError::Damaged(file.to_owned(), what)),
        }
    }
}

impl From<io::Error> for DirectoryFailure {
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

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    bytes.get(at..).and_then(<[u8]>::first_chunk).map_or(0, |field| u32::from_le_bytes(*field))
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    bytes.get(at..).and_then(<[u8]>::first_chunk).map_or(0, |field| u64::from_le_bytes(*field))
}

/// The files of an archive; `None` if its end, and the directory with it, is missing.
fn members(whole: &mut Whole) -> Result<Option<Vec<Member>>, DirectoryFailure> {
    let tail_at = whole.len().saturating_sub((END_BYTES + COMMENT_BYTES) as u64);
    let tail = whole.read_at(tail_at, END_BYTES + COMMENT_BYTES)?;
    let Some(end_at) = memchr::memmem::rfind(&tail, END).filter(|at| tail.len() - at >= END_BYTES) else {
        return Ok(None);
    };
    let end = &tail[end_at..];
    let (mut size, mut at) = (u64::from(u32_at(end, 12)), u64::from(u32_at(end, 16)));
    if u16_at(end, 10) == 0xFFFF || size == 0xFFFF_FFFF || at == 0xFFFF_FFFF {
        let locator_at = (tail_at + end_at as u64).saturating_sub(LOCATOR_BYTES as u64);
        let locator = whole.read_at(locator_at, LOCATOR_BYTES)?;
        let long = whole.read_at(u64_at(&locator, 8), LONG_END_BYTES)?;
        if !locator.starts_with(LOCATOR) || !long.starts_with(LONG_END) || long.len() < LONG_END_BYTES {
            return Err(DirectoryFailure::Damaged(
                "its end says that there is a longer one, which is missing",
            ));
        }
        (size, at) = (u64_at(&long, 40), u64_at(&long, 48));
    }
    if size > DIRECTORY_BYTES {
        return Err(DirectoryFailure::Damaged("its directory is larger than 16 MiB"));
    }
    let directory = whole.read_at(at, size as usize)?;
    let mut rest = &directory[..];
    let mut members = Vec::new();
    while !rest.is_empty() {
        let damaged = DirectoryFailure::Damaged("its directory is not whole");
        let [name, extra, comment] = [28, 30, 32].map(|at| u16_at(rest, at));
        let len = ENTRY_BYTES + name + extra + comment;
        let Some(entry) = rest.get(..len).filter(|entry| entry.starts_with(ENTRY)) else {
            return Err(damaged);
        };
        rest = &rest[len..];
        members.push(member(entry, name, extra));
    }
    if (directory.len() as u64) < size {
        return Err(DirectoryFailure::Damaged("its directory is not whole"));
    }
    Ok(Some(members))
}

/// A file by its entry in the directory.
fn member(entry: &[u8], name: usize, extra: usize) -> Member {
    const LONG: u32 = u32::MAX;
    let [packed, size, at] = [20, 24, 42].map(|at| u32_at(entry, at));
    // Numbers that are too long are among the extra fields, in this order.
    let mut long = long_numbers(&entry[ENTRY_BYTES + name..][..extra]);
    let mut number = |short: u32| {
        if short != LONG {
            return u64::from(short);
        }
        let number = u64_at(long, 0);
        long = long.get(8..).unwrap_or_default();
        number
    };
    let (size, packed, at) = (number(size), number(packed), number(at));
    Member {
        name: String::from_utf8_lossy(&entry[ENTRY_BYTES..][..name]).replace('\\', "/"),
        encrypted: entry[8] & 1 != 0,
        method: u16_at(entry, 10) as u16,
        crc: u32_at(entry, 16),
        packed,
        size,
        at,
    }
}

/// The extra field of long numbers.
fn long_numbers(mut extra: &[u8]) -> &[u8] {
    const KIND: usize = 1;
    while extra.len() >= 4 {
        let (kind, len) = (u16_at(extra, 0), u16_at(extra, 2));
        let field = &extra[4..];
        let Some(content) = field.get(..len) else { break };
        if kind == KIND {
            return content;
        }
        extra = &field[len..];
    }
    &[]
}

/// A part of a file, as a stream.
struct Part {
    whole: Whole,
    at: u64,
    end: u64,
}

impl Read for Part {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let len = (self.end.saturating_sub(self.at)).min(out.len() as u64) as usize;
        let bytes = self.whole.read_at(self.at, len)?;
        out[..bytes.len()].copy_from_slice(&bytes);
        self.at += bytes.len() as u64;
        Ok(bytes.len())
    }
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
