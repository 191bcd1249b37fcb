//! A file that replaces another one only once it is complete.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use cantap_work::interrupt;

/// A temporary file beside the one to be written. It has the same suffix, so that it has the same format and compression.
pub struct Beside {
    /// Where to write.
    pub temporary: PathBuf,
    path: PathBuf,
}

impl Beside {
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
        interrupt::unfinished(&temporary);
        let made = fs::File::create(&temporary).and_then(|file| match fs::metadata(&path) {
            Ok(old) => file.set_permissions(old.permissions()),
            Err(_) => Ok(()),
        });
        let beside = Self { temporary, path };
        made.is_ok().then_some(beside)
    }

    /// Moves the complete file to its place.
    pub fn put_in_place(self) -> io::Result<()> {
        fs::rename(&self.temporary, &self.path)
    }
}

impl Drop for Beside {
    /// A file that was not put in place is incomplete.
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.temporary);
        interrupt::finished(&self.temporary);
    }
}

/// Writes a file completely or not at all.
pub fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    match Beside::of(path) {
        Some(beside) => fs::write(&beside.temporary, bytes).and_then(|()| beside.put_in_place()),
        None => fs::write(path, bytes),
    }
}
