//! Proves that the same source gives the same firmware, wherever it is built.
//!
//! The whole source tree is copied to another directory and built there from nothing; every byte must be equal.
//! Building twice in one place would not reveal a path of that place in the binary.

use anyhow::{Result, ensure};
use xshell::Shell;

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
    workspace::copy_sources(shell, &tree)?;

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
