//! Where things are in the source tree, and a shell in its root.

use std::fs::File;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use xshell::{Shell, cmd};

/// The workspace's root directory.
pub fn root() -> PathBuf {
    let xtask = Path::new(env!("CARGO_MANIFEST_DIR"));
    xtask.parent().map_or_else(|| xtask.to_owned(), Path::to_owned)
}

/// Where cargo puts what it builds for the host.
pub fn target() -> PathBuf {
    std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| root().join("target"), PathBuf::from)
}

/// Where the finished firmware is put.
pub fn firmware_dir() -> PathBuf {
    target().join("firmware")
}

/// Waits until no other lane does this, and keeps others waiting as long as the file is open.
pub fn only_one(does: &str) -> Result<File> {
    std::fs::create_dir_all(target())?;
    let lock = File::create(target().join(format!("{does}.lock")))?;
    lock.lock()?;
    Ok(lock)
}

/// Of the random values that tests try: the same every time, so that whether a change may land depends on nothing but the change. Other
/// seeds are tried weekly.
const SEED: &str = "1";

/// A shell in the workspace's root. A Python that it starts keeps what it has compiled, outside of the source tree, even if Python is told
/// elsewhere not to: hundreds of tests start one, and compiling asammdf's imports takes four times as long as importing them.
pub fn shell() -> Result<Shell> {
    let shell = Shell::new().context("there is no current directory")?;
    shell.change_dir(root());
    shell.set_var("PYTHONPYCACHEPREFIX", target().join("pycache"));
    shell.set_var("PYTHONDONTWRITEBYTECODE", "");
    if std::env::var_os("PROPTEST_RNG_SEED").is_none() {
        shell.set_var("PROPTEST_RNG_SEED", SEED);
    }
    Ok(shell)
}

/// Copies every file that belongs to the source: those that git tracks or does not ignore.
pub fn copy_sources(shell: &Shell, to: &Path) -> Result<()> {
    let files = cmd!(shell, "git ls-files --cached --others --exclude-standard").quiet().read()?;
    for file in files.lines() {
        // A file whose deletion is not yet committed is still listed.
        if shell.path_exists(file) {
            shell.create_dir(to.join(file).parent().unwrap_or(to))?;
            shell.copy_file(file, to.join(file))?;
        }
    }
    Ok(())
}
