//! Where indexes are kept: one file for each trace and each way of reading it.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use sha2::{Digest as _, Sha256};

use super::index::Index;

/// A longer one is not ours: that of a file of 10 GB takes some megabytes.
const MOST_BYTES: u64 = 64 << 20;
/// Of all together. Those that were not used for longest go first.
const MOST_TOGETHER_BYTES: u64 = 256 << 20;
/// Smaller traces are read as quickly without.
const LEAST_TRACE_BYTES: u64 = if cfg!(test) { 1 } else { 32 << 20 };

const SUFFIX: &str = "index";

/// A folder for the indexes of large traces, of which a part is then read without the rest. It holds at most 256 MB; whatever is in it can be deleted at
/// any time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct IndexFolder {
    path: PathBuf,
    is_only_used: bool,
}

impl IndexFolder {
    /// This folder, which is made when it is needed, readable by the user alone.
    pub fn new(path: impl Into<PathBuf>) -> Self {
        Self { path: path.into(), is_only_used: false }
    }

    /// The same for readings that are to make no index, and use one that is there.
    #[must_use]
    pub fn only_used(self) -> Self {
        Self { is_only_used: true, ..self }
    }

    pub(super) const fn is_only_used(&self) -> bool {
        self.is_only_used
    }

    /// Whether a trace of this many bytes has an index.
    pub(super) fn is_for(trace_bytes: u64) -> bool {
        trace_bytes >= LEAST_TRACE_BYTES
    }

    /// The file for a trace.
    pub(super) fn file(&self, trace: &Path, how: &str) -> Option<PathBuf> {
        let trace = trace.canonicalize().ok()?;
        let mut hash = Sha256::new();
        hash.update(trace.as_os_str().as_encoded_bytes());
        hash.update([0]);
        hash.update(how);
        let name = hash.finalize()[..16].iter().fold(0, |name: u128, byte| name << 8 | u128::from(*byte));
        Some(self.path.join(format!("{name:032x}.{SUFFIX}")))
    }

    /// The index in a file, if there is one that can be used.
    pub(super) fn load(path: &Path, how: &str) -> Option<Index> {
        let file = File::open(path).ok()?;
        let mut bytes = Vec::new();
        file.take(MOST_BYTES + 1).read_to_end(&mut bytes).ok()?;
        let index = Index::of_bytes(&bytes, how).filter(|_| bytes.len() as u64 <= MOST_BYTES)?;
        // Those in use stay; where the time cannot be set, they go a little earlier.
        let _ = File::options().append(true).open(path).and_then(|file| file.set_modified(SystemTime::now()));
        Some(index)
    }

    /// Writes one. Without it, the next reading takes longer: that is no error.
    pub(super) fn keep(&self, path: &Path, index: &Index, how: &str) {
        let Some(bytes) = index.to_bytes(how).filter(|bytes| bytes.len() as u64 <= MOST_BYTES) else {
            return;
        };
        if self.write(path, &bytes).is_ok() {
            // What cannot be listed or removed stays.
            let _ = self.make_room(path);
        }
    }

    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        let mut folder = fs::DirBuilder::new();
        let mut file = File::options();
        #[cfg(unix)]
        {
            use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
            folder.mode(0o700);
            file.mode(0o600);
        }
        folder.recursive(true).create(&self.path)?;
        let unfinished = path.with_extension(format!("{}-{:08x}", std::process::id(), unique()));
        let written = file
            .write(true)
            .create_new(true)
            .open(&unfinished)
            .and_then(|mut file| file.write_all(bytes))
            .and_then(|()| fs::rename(&unfinished, path));
        if written.is_err() {
            let _ = fs::remove_file(&unfinished);
        }
        written
    }

    /// Removes those not used for longest, and what other runs left unfinished an hour ago.
    fn make_room(&self, newest: &Path) -> io::Result<()> {
        const HOUR_SECONDS: u64 = 3600;
        let mut files = Vec::new();
        for entry in fs::read_dir(&self.path)? {
            let entry = entry?;
            let (path, about) = (entry.path(), entry.metadata()?);
            if about.is_file() && path != newest {
                files.push((about.modified()?, about.len(), path));
            }
        }
        files.sort_unstable_by(|left, right| right.cmp(left));
        let mut together = fs::metadata(newest)?.len();
        for (used, bytes, path) in files {
            together += bytes;
            // Whatever else is there is not ours to remove.
            let is_name = |name: &str| name.len() == 32 && name.bytes().all(|byte| byte.is_ascii_hexdigit());
            let is_ours = path.file_stem().and_then(|name| name.to_str()).is_some_and(is_name);
            let is_unfinished = path.extension().is_none_or(|suffix| suffix != SUFFIX)
                && used.elapsed().is_ok_and(|age| age.as_secs() > HOUR_SECONDS);
            if is_ours && (together > MOST_TOGETHER_BYTES || is_unfinished) {
                fs::remove_file(path)?;
            }
        }
        Ok(())
    }

    /// Removes one that is wrong.
    pub(super) fn forget(path: &Path) {
        let _ = fs::remove_file(path);
    }
}

/// A number that no other index of this process has.
fn unique() -> u32 {
    use std::sync::atomic::{AtomicU32, Ordering};
    static NEXT: AtomicU32 = AtomicU32::new(0);
    NEXT.fetch_add(1, Ordering::Relaxed)
}
