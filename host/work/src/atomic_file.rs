//! A file that replaces another one only once it is complete.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use crate::interrupt;

/// A temporary file beside the one to be written. It has the same suffix, so that it has the same format and compression.
pub struct AtomicFile {
    /// Where to write.
    pub temporary: PathBuf,
    path: PathBuf,
}

impl AtomicFile {
    /// The file beside `path`; `None` for standard output, pipes and devices, and if no file can be created there: those are
    /// written to directly.
    pub fn of(path: &Path) -> Option<Self> {
        if path.as_os_str() == "-" || path.exists() && !path.is_file() {
            return None;
        }
        // A link remains a link.
        let path = if path.exists() { path.canonicalize().ok()? } else { path.to_owned() };
        let name = path.file_name()?.to_str()?;
        let temporary = path.with_file_name(format!(".cantap-{}-{name}", std::process::id()));
        // In a common folder a stranger may have put a link there, which must be neither followed nor removed.
        let file = fs::File::create_new(&temporary).ok()?;
        interrupt::unfinished(&temporary);
        let replacement = Self { temporary, path };
        let kept =
            fs::metadata(&replacement.path).map_or(Ok(()), |old| file.set_permissions(old.permissions()));
        kept.is_ok().then_some(replacement)
    }

    /// Moves the complete file to its place.
    pub fn put_in_place(self) -> io::Result<()> {
        fs::rename(&self.temporary, &self.path)
    }
}

impl Drop for AtomicFile {
    /// A file that was not put in place is incomplete.
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.temporary);
        interrupt::finished(&self.temporary);
    }
}

/// Writes a file completely or not at all.
pub fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    match AtomicFile::of(path) {
        Some(file) => fs::write(&file.temporary, bytes).and_then(|()| file.put_in_place()),
        None => fs::write(path, bytes),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(unix)]
    #[test]
    fn what_stands_at_the_temporary_name_is_neither_written_nor_removed() {
        let folder = tempfile::tempdir().unwrap();
        let (path, victim) = (folder.path().join("out.log"), folder.path().join("victim"));
        fs::write(&victim, "mine").unwrap();
        let temporary = folder.path().join(format!(".cantap-{}-out.log", std::process::id()));
        std::os::unix::fs::symlink(&victim, &temporary).unwrap();
        assert!(AtomicFile::of(&path).is_none());
        write(&path, b"new").unwrap();
        assert_eq!(fs::read_to_string(&victim).unwrap(), "mine");
        assert!(temporary.is_symlink());
        assert_eq!(fs::read_to_string(&path).unwrap(), "new");
        fs::remove_file(&temporary).unwrap();
        write(&path, b"newer").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "newer");
    }
}
