//! Data types of DroneCAN and Cyphal (DSDL), as users name them.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context as _;
use cantap_protocols::dsdl::{DataTypes, DsdlSource, SubjectType};

use crate::report::Reporter;

/// How many files of definitions a folder may have.
const MOST_FILES: usize = 20_000;
/// How long one may be, and all of them together, in bytes.
const MOST_BYTES: u64 = 1 << 20;
const MOST_TOGETHER_BYTES: u64 = 64 << 20;

/// All definitions in a folder and the folders in it, which are the outermost namespaces, in the order of their paths. Links are not followed.
///
/// # Errors
///
/// Whatever keeps a folder or a definition from being read; more than 20 000 of them, one of more than 1 MiB, or more than 64 MiB in all.
pub fn read_folder(folder: &Path) -> io::Result<Vec<DsdlSource>> {
    let (mut sources, mut folders) = (Vec::new(), vec![(folder.to_owned(), String::new())]);
    let mut left = MOST_TOGETHER_BYTES;
    while let Some((folder, namespace)) = folders.pop() {
        for entry in std::fs::read_dir(&folder)? {
            let entry = entry?;
            let Ok(name) = entry.file_name().into_string() else { continue };
            let (kind, path) = (entry.file_type()?, format!("{namespace}{name}"));
            if kind.is_dir() && !name.starts_with('.') {
                folders.push((entry.path(), format!("{path}/")));
            } else if kind.is_file() && DsdlSource::has_name(&name) {
                let length = entry.metadata()?.len();
                let is_taken = sources.len() < MOST_FILES && length <= MOST_BYTES && length <= left;
                if !is_taken {
                    let what = format!("{}: too many or too long definitions", entry.path().display());
                    return Err(io::Error::other(what));
                }
                left -= length;
                let text = String::from_utf8_lossy(&std::fs::read(entry.path())?).into_owned();
                sources.push(DsdlSource { path, text });
            }
        }
    }
    sources.sort_by(|a, b| a.path.cmp(&b.path));
    Ok(sources)
}

/// The built-in types with those of the folders; `None` without folders and subjects. What is not understood is reported.
///
/// # Errors
///
/// A folder cannot be read or has no definitions; a subject's type does not exist.
pub fn load(
    folders: &[PathBuf],
    subjects: &[SubjectType],
    reporter: &Reporter,
) -> anyhow::Result<Option<Arc<DataTypes>>> {
    if folders.is_empty() && subjects.is_empty() {
        return Ok(None);
    }
    let mut own = Vec::new();
    for folder in folders {
        let name = folder.display();
        let sources = read_folder(folder).with_context(|| format!("cannot read data types in {name}"))?;
        anyhow::ensure!(
            !sources.is_empty(),
            "there is no data type in {name}; give the folder in which the outermost namespaces are, with files *.uavcan or *.dsdl in them"
        );
        own.extend(sources);
    }
    let (mut types, problems) = DataTypes::with(&own);
    for problem in problems {
        reporter.note(problem);
    }
    for SubjectType { subject, name } in subjects {
        types.name_subject(*subject, name)?;
    }
    Ok(Some(Arc::new(types)))
}
