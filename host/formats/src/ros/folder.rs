//! A bag of ROS 2 as `ros2 bag record` leaves it: a folder with `metadata.yaml` and one or more files, which are read one after another.
//!
//! Source: rosbag2's documentation of its metadata, and its naming of files: `NAME_0.mcap`, `NAME_1.mcap`.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Component, Path, PathBuf};

/// A file of metadata has some hundreds of bytes for each topic and each file.
const MAX_METADATA_BYTES: u64 = 16 << 20;
const METADATA: &str = "metadata.yaml";
/// What the files are called, also when they are compressed as a whole.
const SUFFIXES: [&str; 4] = [".mcap", ".db3", ".mcap.zstd", ".db3.zstd"];

/// What is reported of a bag whose recording was not finished.
pub(crate) const NO_METADATA: &str =
    "the bag has no metadata.yaml, as after a crash: its files were found by their names";

/// The files of a bag in their order.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Files {
    pub first: PathBuf,
    pub others: VecDeque<PathBuf>,
    pub has_metadata: bool,
}

/// The files of the bag in a folder; an error if it is none.
pub(crate) fn files(folder: &Path) -> io::Result<Files> {
    let wrong = |what: String| io::Error::new(io::ErrorKind::InvalidData, what);
    let (mut files, has_metadata) = match File::open(folder.join(METADATA)) {
        Ok(file) => {
            let mut text = String::new();
            file.take(MAX_METADATA_BYTES).read_to_string(&mut text)?;
            (listed(&text).map_err(wrong)?, true)
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => (named(folder)?, false),
        Err(error) => return Err(error),
    };
    for file in &mut files {
        *file = there(folder, file);
    }
    let mut others = VecDeque::from(files);
    let first = others.pop_front().ok_or_else(|| {
        if has_metadata {
            return wrong(format!("its {METADATA} names no file of a bag of ROS 2"));
        }
        let message = "it is a directory; of those, only the bags of ROS 2 are read as a whole";
        io::Error::new(io::ErrorKind::IsADirectory, message)
    })?;
    Ok(Files { first, others, has_metadata })
}

/// Where a file of the metadata is. Early versions wrote the folder's name before it, and some left out that it is compressed.
fn there(folder: &Path, file: &Path) -> PathBuf {
    let name = Path::new(file.file_name().unwrap_or_default());
    let compressed = PathBuf::from(format!("{}.zstd", name.display()));
    let candidates = [file, name, &compressed].map(|file| folder.join(file));
    let [first, ..] = &candidates;
    candidates.iter().find(|path| path.is_file()).unwrap_or(first).clone()
}

/// The files that the metadata lists. Those outside of the folder are refused: a bag comes from others.
fn listed(metadata: &str) -> Result<Vec<PathBuf>, String> {
    const KEY: &str = "relative_file_paths:";
    let mut lines = metadata.lines().map(str::trim).skip_while(|line| !line.starts_with(KEY));
    let in_line = lines.next().and_then(|line| line.strip_prefix(KEY)).unwrap_or_default().trim();
    let in_line = in_line.strip_prefix('[').and_then(|list| list.strip_suffix(']'));
    let items: Vec<&str> = match in_line {
        Some(list) => list.split(',').map(str::trim).filter(|item| !item.is_empty()).collect(),
        None => lines.map_while(|line| line.strip_prefix("- ")).map(str::trim).collect(),
    };
    let is_inside = |path: &Path| path.components().all(|part| matches!(part, Component::Normal(_)));
    let paths = items.into_iter().map(|item| {
        let quoted = ['"', '\''].iter().find_map(|mark| item.strip_prefix(*mark)?.strip_suffix(*mark));
        PathBuf::from(quoted.unwrap_or(item))
    });
    let paths: Vec<_> = paths.collect();
    match paths.iter().find(|path| !is_inside(path)) {
        Some(outside) => Err(format!("its {METADATA} names a file outside of it: {}", outside.display())),
        None => Ok(paths),
    }
}

/// The files that are called like a bag's, by their numbers.
fn named(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for entry in folder.read_dir()? {
        let name = PathBuf::from(entry?.file_name());
        let number = name.to_str().and_then(|name| {
            let stem = SUFFIXES.iter().find_map(|suffix| name.strip_suffix(suffix))?;
            stem.rsplit_once('_')?.1.parse::<u32>().ok()
        });
        files.extend(number.map(|number| (number, name)));
    }
    files.sort();
    Ok(files.into_iter().map(|(_, name)| name).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_metadatas_files_are_found_however_they_are_written() {
        let expected = ["a_0.mcap", "a_1.mcap"].map(PathBuf::from).to_vec();
        for text in [
            "rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n    - a_0.mcap\n    - a_1.mcap\n  files:\n    - path: a_0.mcap\n",
            "rosbag2_bagfile_information:\n  relative_file_paths:\n  - \"a_0.mcap\"\n  - 'a_1.mcap'\n  duration:\n",
            "  relative_file_paths: [a_0.mcap, a_1.mcap]\n",
        ] {
            assert_eq!(listed(text), Ok(expected.clone()), "{text}");
        }
        for text in ["", "relative_file_paths:\n", "relative_file_paths: []\n"] {
            assert_eq!(listed(text), Ok(vec![]), "{text}");
        }
        for outside in ["/etc/passwd", "../b_0.mcap", "a/../../b"] {
            assert!(listed(&format!("relative_file_paths:\n  - {outside}\n")).is_err(), "{outside}");
        }
    }

    #[test]
    fn files_are_where_they_are_and_without_metadata_those_with_a_bags_names() {
        let folder = tempfile::tempdir().unwrap();
        let error = files(folder.path()).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::IsADirectory);
        for name in ["a_10.db3", "a_9.db3", "notes.txt", "a_x.db3", "b.mcap"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let in_folder =
            |names: &[&str]| names.iter().map(|name| folder.path().join(name)).collect::<Vec<_>>();
        let all = |found: &Files| {
            let mut all = vec![found.first.clone()];
            all.extend(found.others.iter().cloned());
            all
        };
        let found = files(folder.path()).unwrap();
        assert_eq!((all(&found), found.has_metadata), (in_folder(&["a_9.db3", "a_10.db3"]), false));
        std::fs::write(folder.path().join("a_11.db3.zstd"), "").unwrap();
        let metadata = "relative_file_paths:\n  - old/a_9.db3\n  - a_11.db3\n  - gone_0.db3\n";
        std::fs::write(folder.path().join(METADATA), metadata).unwrap();
        let found = files(folder.path()).unwrap();
        assert_eq!(
            (all(&found), found.has_metadata),
            (in_folder(&["a_9.db3", "a_11.db3.zstd", "gone_0.db3"]), true)
        );
    }
}
