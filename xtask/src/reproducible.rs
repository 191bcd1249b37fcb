//! Proves that the same source gives the same firmware, wherever it is built.
//!
//! The whole source tree is copied to another directory and built there from nothing; every byte must be equal.
//! Building twice in one place would not reveal a path of that place in the binary.

use std::path::Path;

use anyhow::{Result, ensure};
use xshell::{Shell, cmd};

use crate::board::Board;
use crate::firmware;
use crate::toolchain::Toolchain;
use crate::workspace;

/// Builds the default board's firmware again, elsewhere, and compares it with the existing one.
pub fn check(shell: &Shell, toolchain: Toolchain) -> Result<()> {
    let board = Board::ALL[0];
    let elsewhere = workspace::target().join("reproducible");
    let tree = elsewhere.join("another/directory/of-another-length");
    shell.remove_path(&elsewhere)?;
    copy_sources(shell, &tree)?;

    let there = shell.clone();
    there.change_dir(&tree);
    let again = firmware::build(&there, toolchain, board, &tree.join("target"))?;
    let same = shell.read_binary_file(&again)? == shell.read_binary_file(board.elf())?;
    ensure!(
        same,
        "two builds of one source differ; compare {} with {}",
        again.display(),
        board.elf().display()
    );
    println!("built twice, in two directories: {} is the same, byte for byte", board.elf().display());
    shell.remove_path(&elsewhere)?;
    Ok(())
}

/// Copies every file that belongs to the source: those that git tracks or does not ignore.
fn copy_sources(shell: &Shell, to: &Path) -> Result<()> {
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
