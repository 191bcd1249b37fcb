//! Descriptions of what is in ECUs' memories (A2L), as users name them.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context as _;
use cantap_protocols::a2l::{Description, Descriptions};
use cantap_trace::counted;

use crate::report::Reporter;

/// How many things that are left out are named.
const MOST_NAMED: usize = 3;

/// Reads a file: a description for each ECU in it. How much of it is left out is reported.
///
/// # Errors
///
/// It cannot be read, or is no A2L.
pub fn read(path: &Path, reporter: &Reporter) -> anyhow::Result<Vec<Description>> {
    let name = path.display();
    let descriptions = Description::read(path).with_context(|| name.to_string())?;
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
pub fn load(paths: &[PathBuf], reporter: &Reporter) -> anyhow::Result<Option<Arc<Descriptions>>> {
    if paths.is_empty() {
        return Ok(None);
    }
    let mut all = Vec::new();
    for path in paths {
        all.extend(read(path, reporter)?.into_iter().map(Arc::new));
    }
    Ok(Some(Arc::new(Descriptions::new(all))))
}
