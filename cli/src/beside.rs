//! A file that takes another one's place only when it is whole.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// A temporary file beside the one that is to be written. It ends like that one, so that it has the same format and compression.
pub struct Beside {
    /// Where to write.
    pub temporary: PathBuf,
    path: PathBuf,
}

impl Beside {
    /// The file beside `path`; `None` for standard output, pipes and devices, and where no file can be made there: those are
    /// written themselves.
    pub fn of(path: &Path) -> Option<Self> {
        if path.as_os_str() == "-" || path.exists() && !path.is_file() {
            return None;
        }
        // A link stays a link.
        let path = if path.exists() { path.canonicalize().ok()? } else { path.to_owned() };
        let name = path.file_name()?.to_str()?;
        let temporary = path.with_file_name(format!(".cantap-{}-{name}", std::process::id()));
        let made = fs::File::create(&temporary).and_then(|file| match fs::metadata(&path) {
            Ok(old) => file.set_permissions(old.permissions()),
            Err(_) => Ok(()),
        });
        if made.is_err() {
            let _ = fs::remove_file(&temporary);
            return None;
        }
        Some(Self { temporary, path })
    }

    /// Puts the whole file where it belongs.
    pub fn put_in_place(self) -> io::Result<()> {
        fs::rename(&self.temporary, &self.path)
    }
}

impl Drop for Beside {
    /// What was not put in place was not finished.
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.temporary);
    }
}
