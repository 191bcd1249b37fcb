//! Hashes the sources: an index of a trace is used only by what made it, and a version number stays for months.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::Path;
use std::{fs, io};

/// What reads traces, and what its records are made of. A published package has only the first; the others have its version.
const SOURCES: [&str; 3] = ["src", "../trace/src", "../../can/src"];

fn main() -> io::Result<()> {
    let mut hasher = DefaultHasher::new();
    for folder in SOURCES.map(Path::new) {
        if folder.is_dir() {
            println!("cargo::rerun-if-changed={}", folder.display());
            hash(folder, &mut hasher)?;
        }
    }
    println!("cargo::rustc-env=CANTAP_FORMATS_SOURCES={:016x}", hasher.finish());
    Ok(())
}

/// Names and contents, in the order of the names.
fn hash(path: &Path, hasher: &mut impl Hasher) -> io::Result<()> {
    if path.is_dir() {
        let mut inside =
            fs::read_dir(path)?.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<_>>>()?;
        inside.sort();
        return inside.iter().try_for_each(|path| hash(path, hasher));
    }
    path.file_name().hash(hasher);
    fs::read(path)?.hash(hasher);
    Ok(())
}
