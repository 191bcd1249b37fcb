//! The licences of other people's crates in a program, most of which require that their text is passed on.

use std::collections::BTreeSet;
use std::fmt::Write;
use std::path::Path;

use anyhow::{Context, Result, ensure};
use xshell::{Shell, cmd};

use crate::metadata::{Metadata, Package};

/// How the names of files begin that hold a licence or accompany one.
const FILES: [&str; 5] = ["LICENSE", "LICENCE", "COPYING", "NOTICE", "UNLICENSE"];

/// Writes each crate that `cargo tree` finds in a selection of packages, with the licence texts from its source.
pub fn write(shell: &Shell, path: &Path, selection: &[&str]) -> Result<()> {
    // cargo's own placeholder for a package.
    let line = "{p}";
    let tree = cmd!(shell, "cargo tree --locked --edges normal --prefix none --format {line} {selection...}")
        .quiet()
        .read()?;
    let linked: BTreeSet<(&str, &str)> = tree.lines().filter_map(name_and_version).collect();
    let metadata = Metadata::read(shell)?;
    let mut text = String::from("Other people's crates in this program, each under the licences below it.\n");
    let mut count = 0;
    for package in metadata.others() {
        if linked.contains(&(package.name.as_str(), package.version.as_str())) {
            add(shell, &mut text, package)?;
            count += 1;
        }
    }
    ensure!(count > 0, "cargo tree names no crates of other people");
    shell.write_file(path, text)?;
    Ok(())
}

/// The name and version in a line such as `clap v4.6.0 (proc-macro)`.
fn name_and_version(line: &str) -> Option<(&str, &str)> {
    let mut words = line.split(' ');
    Some((words.next()?, words.next()?.strip_prefix('v')?))
}

fn add(shell: &Shell, text: &mut String, package: &Package) -> Result<()> {
    let licence = package.license.as_deref().unwrap_or("see below");
    let rule = "=".repeat(100);
    write!(text, "\n{rule}\n{} {}: {licence}\n", package.name, package.version)?;
    // The MPL entitles anyone who has the program to the source.
    if let Some(repository) = &package.repository {
        writeln!(text, "{repository}")?;
    }
    let directory = package.manifest_path.parent().context("a manifest has no directory")?;
    for file in shell.read_dir(directory)? {
        let name = file.file_name().map(|name| name.to_string_lossy().to_uppercase()).unwrap_or_default();
        if file.is_file() && FILES.iter().any(|known| name.starts_with(known)) {
            write!(text, "\n{}", String::from_utf8_lossy(&shell.read_binary_file(&file)?))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_of_cargo_tree_has_a_name_and_a_version() {
        assert_eq!(name_and_version("clap v4.6.0 (proc-macro)"), Some(("clap", "4.6.0")));
        assert_eq!(name_and_version("clap v4.6.0 (*)"), Some(("clap", "4.6.0")));
        assert_eq!(name_and_version(""), None);
    }
}
