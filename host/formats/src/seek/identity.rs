//! Whether a file is the one it was, by what the system says of it.

use std::fs::Metadata;

use serde::{Deserialize, Serialize};

/// A file as it was at a time.
///
/// The time of its last change is the system's own, which no program can set back as it can the time of writing: who writes to the file
/// moves it. So a file with the same identity has the same content, as long as its file system keeps that time (FAT does not).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Identity {
    device: u64,
    inode: u64,
    len: u64,
    written_ns: i128,
    changed_ns: i128,
}

impl Identity {
    /// `None` if the system cannot tell, or if a change in this moment would not show.
    #[cfg(unix)]
    pub(super) fn of(file: &Metadata) -> Option<Self> {
        use std::os::unix::fs::MetadataExt;
        use std::time::{Duration, SystemTime, UNIX_EPOCH};

        /// Some systems count changes in steps of two seconds: a second change within one looks like the first.
        const STEP: Duration = if cfg!(test) { Duration::ZERO } else { Duration::from_secs(2) };
        let ns = |seconds: i64, ns: i64| i128::from(seconds) * 1_000_000_000 + i128::from(ns);
        let identity = Self {
            device: file.dev(),
            inode: file.ino(),
            len: file.len(),
            written_ns: ns(file.mtime(), file.mtime_nsec()),
            changed_ns: ns(file.ctime(), file.ctime_nsec()),
        };
        let now = SystemTime::now().duration_since(UNIX_EPOCH).ok()?;
        let settled = now.checked_sub(STEP)?.as_nanos();
        (identity.changed_ns < i128::try_from(settled).ok()?).then_some(identity)
    }

    /// The time of the last change is not to be had elsewhere.
    #[cfg(not(unix))]
    pub(super) fn of(_: &Metadata) -> Option<Self> {
        None
    }
}
