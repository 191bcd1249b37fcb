//! A2lDescriptions of what is in ECUs' memories (A2L), as users name them.

use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context as _;
use cantap_protocols::a2l::{A2lDescriptions, Description};
use cantap_trace::counted;

use crate::report::Reporter;

/// The largest file that is read, in bytes.
const MOST_BYTES: u64 = 512 << 20;
/// How many things that are left out are named.
const MOST_NAMED: usize = 3;

/// The bytes of a file, if it is not too large.
fn bytes_of(path: &Path) -> anyhow::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    std::fs::File::open(path)?.take(MOST_BYTES + 1).read_to_end(&mut bytes)?;
    anyhow::ensure!(bytes.len() as u64 <= MOST_BYTES, "it is larger than 512 MiB");
    Ok(bytes)
}

/// The bytes of a file that another one names, which may be a stranger's: a pipe would be waited for, and a device might have no end.
fn included(path: &Path) -> Option<Vec<u8>> {
    path.metadata().is_ok_and(|there| there.is_file()).then(|| bytes_of(path).ok()).flatten()
}

/// Reads a file: a description for each ECU in it. How much of it is left out is reported.
///
/// # Errors
///
/// It cannot be read, or is no A2L.
pub fn read(path: &Path, reporter: &Reporter) -> anyhow::Result<Vec<Description>> {
    let name = path.display();
    let bytes = bytes_of(path).with_context(|| format!("cannot read {name}"))?;
    // What a file includes is named from where it is.
    let folder = path.parent().unwrap_or(Path::new(""));
    let mut include = |name: &str| included(&folder.join(name.replace('\\', "/")));
    let descriptions = Description::read(&bytes, &mut include).with_context(|| name.to_string())?;
    let issues: Vec<_> = descriptions.iter().flat_map(|one| &one.issues).map(String::as_str).collect();
    if !issues.is_empty() {
        let named = issues[..issues.len().min(MOST_NAMED)].join("; ");
        let rest = if issues.len() > MOST_NAMED { "; …" } else { "" };
        reporter.note(format!("{name}: {} not evaluated: {named}{rest}", counted(issues.len(), "thing")));
    }
    Ok(descriptions)
}

/// Reads all files; `None` if there is none.
///
/// # Errors
///
/// One cannot be read, or is no A2L.
pub fn load(paths: &[PathBuf], reporter: &Reporter) -> anyhow::Result<Option<Arc<A2lDescriptions>>> {
    if paths.is_empty() {
        return Ok(None);
    }
    let mut all = Vec::new();
    for path in paths {
        all.extend(read(path, reporter)?.into_iter().map(Arc::new));
    }
    Ok(Some(Arc::new(A2lDescriptions::new(all))))
}
