//! The folder for what can be computed again. Nothing depends on it: all of it can be deleted at any time.

use std::path::PathBuf;

use cantap_formats::IndexFolder;

/// Where a user's programs keep what can be computed again: `XDG_CACHE_HOME` or `~/.cache`, on macOS
/// `~/Library/Caches`, on Windows `%LOCALAPPDATA%`; `None` if the system does not say where that is.
pub fn folder() -> Option<PathBuf> {
    let variable = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let base = variable("XDG_CACHE_HOME").or_else(|| {
        if cfg!(windows) {
            variable("LOCALAPPDATA")
        } else if cfg!(target_os = "macos") {
            Some(variable("HOME")?.join("Library/Caches"))
        } else {
            Some(variable("HOME")?.join(".cache"))
        }
    });
    Some(base?.join("cantap"))
}

/// Where indexes of large traces are kept.
pub fn indexes() -> Option<IndexFolder> {
    folder().map(|folder| IndexFolder::new(folder.join("indexes")))
}
