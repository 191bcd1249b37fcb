//! The public face of each published library as a text file beside its manifest, so that a change of it is seen in review.
//!
//! rustdoc's JSON, which lists the public items, is only for unstable compilers: rustdoc alone is told to be one, so that everything
//! that was compiled for the documentation serves again.

use std::fmt::Write as _;
use std::fs;
use std::os::unix::fs::PermissionsExt as _;

use anyhow::{Context, Result, ensure};
use xshell::{Shell, cmd};

use crate::metadata::{Metadata, Package};
use crate::workspace;

/// The file in each crate's folder.
const FILE: &str = "public-api.txt";

/// Compares every library with its file; with `CANTAP_OVERWRITE=1`, writes the files instead.
pub fn check() -> Result<()> {
    let shell = workspace::shell()?;
    let metadata = Metadata::read(&shell)?;
    let libraries: Vec<&Package> =
        metadata.members().filter(|package| package.is_published() && package.library().is_some()).collect();
    document(&shell)?;
    let folder = workspace::target().join("doc");
    let overwrite = std::env::var_os("CANTAP_OVERWRITE").is_some();
    let mut faults = String::new();
    for package in libraries {
        let name = package.library().unwrap_or_default();
        let file = package.manifest_path.with_file_name(FILE);
        let json = folder.join(format!("{}.json", name.replace('-', "_")));
        let text = items(&json).with_context(|| json.display().to_string())?;
        if overwrite {
            fs::write(&file, text)?;
        } else {
            let kept = fs::read_to_string(&file).unwrap_or_default();
            describe(&mut faults, &package.name, &kept, &text)?;
        }
    }
    ensure!(
        faults.is_empty(),
        "the public face differs from {FILE}; if that is meant: CANTAP_OVERWRITE=1 cargo xtask public-api\n{faults}"
    );
    Ok(())
}

/// Lists the public items of every library of the workspace as JSON.
fn document(shell: &Shell) -> Result<()> {
    let rustdoc = workspace::target().join("unstable-rustdoc");
    fs::write(&rustdoc, "#!/bin/sh\nRUSTC_BOOTSTRAP=1 exec rustdoc \"$@\"\n")?;
    fs::set_permissions(&rustdoc, fs::Permissions::from_mode(0o755))?;
    cmd!(shell, "cargo doc --locked --workspace --lib --no-deps --all-features")
        .env("RUSTDOC", &rustdoc)
        .env("RUSTDOCFLAGS", "-Zunstable-options --output-format json --cap-lints allow")
        .run()?;
    Ok(())
}

/// A line for each public item, without what the compiler derives or implements by itself.
fn items(json: &std::path::Path) -> Result<String> {
    let api = public_api::Builder::from_rustdoc_json(json)
        .omit_blanket_impls(true)
        .omit_auto_trait_impls(true)
        .omit_auto_derived_impls(true)
        .build()?;
    let mut text = String::new();
    for item in api.items() {
        writeln!(text, "{item}")?;
    }
    Ok(text)
}

/// Adds the lines that only one of two texts has.
fn describe(faults: &mut String, name: &str, kept: &str, now: &str) -> Result<()> {
    let only = |one: &str, other: &str, mark: char, faults: &mut String| -> Result<()> {
        let other: std::collections::BTreeSet<&str> = other.lines().collect();
        for line in one.lines().filter(|line| !other.contains(line)) {
            writeln!(faults, "{mark} {name}: {line}")?;
        }
        Ok(())
    };
    only(kept, now, '-', faults)?;
    only(now, kept, '+', faults)
}

#[cfg(test)]
mod tests {
    use super::describe;

    #[test]
    fn what_was_added_and_what_went_is_told() {
        let mut faults = String::new();
        describe(&mut faults, "x", "pub fn a\npub fn b\n", "pub fn b\npub fn c\n").unwrap();
        assert_eq!(faults, "- x: pub fn a\n+ x: pub fn c\n");
        faults.clear();
        describe(&mut faults, "x", "pub fn a\n", "pub fn a\n").unwrap();
        assert_eq!(faults, "");
    }
}
