//! The crates as they would be published: each packs, with the texts of its licences. Whether each builds from its package alone is
//! checked by the release workflow (`cargo package`), since that compiles everything once more.

use anyhow::{Context, Result, ensure};
use xshell::{Shell, cmd};

use crate::metadata::{Metadata, Package};

/// Packs what can be published.
pub fn check(shell: &Shell) -> Result<()> {
    let metadata = Metadata::read(shell)?;
    let published: Vec<&Package> = metadata.members().filter(|package| package.is_published()).collect();
    for package in &published {
        licences(shell, package)?;
    }
    let packages = published.iter().flat_map(|package| ["-p", &package.name]);
    cmd!(shell, "cargo package --locked --allow-dirty --no-verify {packages...}").run()?;
    Ok(())
}

/// A package has its own copies: where symbolic links are not preserved, a link would become a file containing a path.
fn licences(shell: &Shell, package: &Package) -> Result<()> {
    let directory = package.manifest_path.parent().context("a manifest has no directory")?;
    for licence in ["LICENSE-MIT", "LICENSE-APACHE"] {
        let own = shell.read_file(directory.join(licence)).with_context(|| package.name.clone())?;
        ensure!(
            own == shell.read_file(licence)?,
            "{}'s {licence} differs from the workspace's: copy it",
            package.name
        );
    }
    Ok(())
}
