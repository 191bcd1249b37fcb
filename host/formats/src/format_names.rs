//! Formats by their names, their files' suffixes and contents, and what is said of those that are not known.

use std::fmt;
use std::path::Path;
use std::str::FromStr;

use super::compression::Compression;
use super::format::Format;
use super::spec::FormatSpec;

/// There is no such format.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum UnknownFormat {
    /// Not a format's name.
    #[error("'{0}' is not a trace format; the formats are {known}", known = Format::names())]
    Name(String),
    /// A file's suffix does not name a format.
    #[error("the name '{0}' does not show the format")]
    Suffix(String),
    /// Nor does its content, which looks like something else.
    #[error("{file} is no trace that is read here: it looks like {looks_like}")]
    NoTrace {
        /// The file's name, as given.
        file: String,
        /// What it looks like.
        looks_like: &'static str,
    },
}

/// A format that can be read but not written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotWritten(pub Format);

impl fmt::Display for NotWritten {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let how = match self.0 {
            Format::Parquet => {
                "only read, and made by converting a trace, since such a file is complete at its end only"
            }
            _ => "only read",
        };
        write!(
            f,
            "{} is a format that is {how}; those that are written are {}",
            self.0,
            Format::written_names()
        )
    }
}

impl std::error::Error for NotWritten {}

impl Format {
    /// Every format.
    pub fn all() -> impl Iterator<Item = Self> {
        FormatSpec::all().map(|spec| spec.format)
    }

    /// Whether files of the format can be written, not only read.
    pub fn is_written(self) -> bool {
        FormatSpec::of(self).writer.is_some()
    }

    /// Every format that can be written.
    pub fn written() -> impl Iterator<Item = Self> {
        Self::all().filter(|format| format.is_written())
    }

    /// The names of the formats that can be written, for messages.
    pub fn written_names() -> String {
        Self::written().map(|format| format.to_string()).collect::<Vec<_>>().join(", ")
    }

    /// The names of all formats, for messages.
    pub fn names() -> String {
        FormatSpec::all().map(|spec| spec.names[0]).collect::<Vec<_>>().join(", ")
    }

    /// By a path's suffix; `.gz`, `.zst`, `.xz`, `.lz4` and `.bz2` are skipped.
    pub fn of_path(path: &Path) -> Result<Self, UnknownFormat> {
        Self::all()
            .find(|format| format.has_suffix_of(path))
            .ok_or_else(|| UnknownFormat::Suffix(path.display().to_string()))
    }

    /// What the names of its files usually end with, without the dot. Versions and dialects share their format's.
    pub fn suffix(self) -> &'static str {
        let kinds = Self::all().filter(|format| format.is_kind_of(self));
        let mut suffixes =
            std::iter::once(self).chain(kinds).flat_map(|format| FormatSpec::of(format).suffixes);
        suffixes.next().copied().unwrap_or("txt")
    }

    /// Whether a file of the format may have this name.
    pub(crate) fn has_suffix_of(self, path: &Path) -> bool {
        let name = path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        let (bare, _) = Compression::split(&name);
        let suffixes = FormatSpec::of(self).suffixes;
        bare.rsplit_once('.').is_some_and(|(_, suffix)| suffixes.contains(&suffix))
    }

    /// Whether both are read by the same reader: the content shows which version or dialect it is.
    pub fn is_kind_of(self, other: Self) -> bool {
        std::mem::discriminant(&self) == std::mem::discriminant(&other)
    }

    /// By a file's first bytes.
    pub fn of_content(head: &[u8]) -> Option<Self> {
        FormatSpec::of_content(head).map(|spec| spec.format)
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(FormatSpec::of(*self).names[0])
    }
}

impl FromStr for Format {
    type Err = UnknownFormat;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let lower = text.to_ascii_lowercase();
        let spec = FormatSpec::all().find(|spec| spec.names.contains(&lower.as_str()));
        spec.map(|spec| spec.format).ok_or_else(|| UnknownFormat::Name(text.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::Format;

    #[test]
    fn a_format_that_is_only_read_is_not_written_and_nothing_is_created() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.log.bz2");
        let error = crate::create_writer(&path, &crate::WriteOptions::default()).err().unwrap().to_string();
        assert!(error.contains("only read") && error.contains(".xz") && !path.exists(), "{error}");
        for format in Format::all().filter(|format| !format.is_written()) {
            let path = dir.path().join("a");
            let options = crate::WriteOptions { format: Some(format), ..Default::default() };
            let error = crate::create_writer(&path, &options).err().unwrap().to_string();
            assert!(error.contains("only read") && error.contains("mf4"), "{error}");
            assert!(!path.exists());
        }
    }
}
