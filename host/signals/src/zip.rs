//! The files of a ZIP archive in memory, stored or deflated: databases, and the packages of ODX.

use std::io::{self, Read};

use rawzip::{ZipArchive, ZipArchiveEntryWayfinder, ZipFileHeaderRecord, ZipSliceArchive};

/// Methods of packing that are read (PKWARE's APPNOTE 6.3.10, section 4.4.5).
const STORED: u16 = 0;
const DEFLATED: u16 = 8;

/// Whether bytes begin as an archive does.
pub fn is_archive(bytes: &[u8]) -> bool {
    bytes.starts_with(b"PK\x03\x04") || bytes.starts_with(b"PK\x05\x06")
}

/// An archive.
pub struct Archive<'a>(ZipSliceArchive<&'a [u8]>);

/// A file in an archive.
pub struct Member {
    /// Its path, with `/` between the parts.
    pub name: String,
    is_encrypted: bool,
    method: u16,
    place: ZipArchiveEntryWayfinder,
}

/// Why an archive cannot be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ArchiveError {
    /// There is no directory at its end.
    #[error("its directory is missing; was it copied to its end?")]
    NoDirectory,
    /// The directory is damaged.
    #[error("its directory is not whole")]
    Directory,
}

/// Why a file in an archive cannot be read; the text follows the file's name.
#[derive(Debug, thiserror::Error)]
pub enum MemberError {
    /// It needs a password.
    #[error("is encrypted; unpack it first")]
    Encrypted,
    /// It is not where the directory says.
    #[error("is not whole")]
    Missing,
    /// It is packed otherwise.
    #[error("is packed by method {0}; unpack it first")]
    Method(u16),
    /// It has more bytes than were asked for.
    #[error("is too long")]
    TooLong,
    /// Its bytes or their check are wrong.
    #[error("is damaged: {0}")]
    Damaged(io::Error),
}

impl<'a> Archive<'a> {
    /// An archive of these bytes.
    ///
    /// # Errors
    /// If it has no directory.
    pub fn new(bytes: &'a [u8]) -> Result<Self, ArchiveError> {
        ZipArchive::from_slice(bytes).map(Self).map_err(|_| ArchiveError::NoDirectory)
    }

    /// Its files, as its directory lists them; nothing more is to be asked for after an error.
    pub fn members(&self) -> impl Iterator<Item = Result<Member, ArchiveError>> {
        let mut entries = self.0.entries();
        std::iter::from_fn(move || {
            entries
                .next_entry()
                .map_err(|_| ArchiveError::Directory)
                .transpose()
                .map(|entry| entry.map(|entry| Member::of(&entry)))
        })
    }

    /// The bytes of a file, at most so many, checked.
    ///
    /// # Errors
    /// If they cannot be read or unpacked, or are more.
    pub fn unpack(&self, member: &Member, most_bytes: u64) -> Result<Vec<u8>, MemberError> {
        if member.is_encrypted {
            return Err(MemberError::Encrypted);
        }
        let place = self.0.get_entry(member.place).map_err(|_| MemberError::Missing)?;
        let packed = place.data();
        let source: Box<dyn Read> = match member.method {
            STORED => Box::new(packed),
            DEFLATED => Box::new(flate2::read::DeflateDecoder::new(packed)),
            method => return Err(MemberError::Method(method)),
        };
        let mut bytes = Vec::new();
        let ended = place.verifying_reader(source).take(most_bytes + 1).read_to_end(&mut bytes);
        if bytes.len() as u64 > most_bytes {
            return Err(MemberError::TooLong);
        }
        ended.map(|_| bytes).map_err(MemberError::Damaged)
    }
}

impl Member {
    fn of(entry: &ZipFileHeaderRecord<'_>) -> Self {
        Self {
            name: String::from_utf8_lossy(entry.file_path().as_ref()).replace('\\', "/"),
            is_encrypted: entry.flags().is_encrypted(),
            method: entry.compression_method().as_u16(),
            place: entry.wayfinder(),
        }
    }
}
