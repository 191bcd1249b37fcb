//! `cargo xtask firmware`: builds the ELF that is flashed.

use std::path::{Path, PathBuf};

use anyhow::Result;
use xshell::Shell;

use crate::board::Board;
use crate::size;
use crate::toolchain::{TARGET, Toolchain};
use crate::workspace;

/// The arguments of `cargo xtask firmware`.
#[derive(clap::Args)]
pub struct Args {
    /// The board to build for.
    #[arg(long, default_value = "olimex-p405", conflicts_with = "all")]
    board: Board,
    /// Build for every board.
    #[arg(long)]
    all: bool,
    /// Build what disturbs a bus on purpose, for a test bench, as `cantap-BOARD-disturb.elf`.
    #[arg(long, conflicts_with = "all")]
    disturb: bool,
}

/// Builds for one board or all.
pub fn run(args: &Args) -> Result<()> {
    let shell = workspace::shell()?;
    let toolchain = Toolchain::find(&shell)?;
    if args.disturb {
        return build_disturbing(&shell, toolchain, args.board);
    }
    let boards = if args.all { &Board::ALL[..] } else { &[args.board] };
    build_all(&shell, toolchain, boards)
}

/// Builds for `boards` and puts each ELF in its place.
pub fn build_all(shell: &Shell, toolchain: Toolchain, boards: &[Board]) -> Result<()> {
    shell.create_dir(workspace::firmware_dir())?;
    for board in boards {
        let built = build(shell, toolchain, *board, &target_dir())?;
        shell.copy_file(built, board.elf())?;
        println!("{}", board.elf().display());
    }
    Ok(())
}

/// Builds for one board what disturbs a bus on purpose: for tests, never for a release.
fn build_disturbing(shell: &Shell, toolchain: Toolchain, board: Board) -> Result<()> {
    shell.create_dir(workspace::firmware_dir())?;
    let built = build_with(shell, toolchain, board, &["disturb"], &target_dir())?;
    shell.copy_file(built, board.disturbing_elf())?;
    println!("{}", board.disturbing_elf().display());
    Ok(())
}

/// The same as [`build_all`], with what the tests need of the default board, and holds their memory against the budget.
pub fn build_checked(shell: &Shell, toolchain: Toolchain, boards: &[Board]) -> Result<()> {
    build_disturbing(shell, toolchain, Board::ALL[0])?;
    build_all(shell, toolchain, boards)?;
    size::run(boards)
}

/// Builds for one board with its own target directory and returns cargo's ELF.
pub fn build(shell: &Shell, toolchain: Toolchain, board: Board, target_dir: &Path) -> Result<PathBuf> {
    build_with(shell, toolchain, board, &[], target_dir)
}

fn build_with(
    shell: &Shell,
    toolchain: Toolchain,
    board: Board,
    features: &[&str],
    target_dir: &Path,
) -> Result<PathBuf> {
    let features = [&[board.name()], features].concat().join(",");
    toolchain
        .cargo(shell, "build", target_dir)?
        .args(["--profile", "firmware", "-p", "cantap-firmware", "--bin", "cantap-firmware"])
        .args(["--no-default-features", "--features", &features])
        .run()?;
    Ok(target_dir.join(TARGET).join("firmware/cantap-firmware"))
}

/// Lints the firmware as each board compiles it, which a lint on the host cannot see.
pub fn clippy(shell: &Shell, toolchain: Toolchain) -> Result<()> {
    let disturbing = Board::ALL.map(|board| format!("{},disturb", board.name()));
    for feature in Board::ALL.map(|board| board.name().to_owned()).into_iter().chain(disturbing) {
        toolchain
            .cargo(shell, "clippy", &target_dir())?
            .args(["-p", "cantap-firmware", "--no-default-features", "--features", &feature])
            .args(["--", "-D", "warnings"])
            .run()?;
    }
    Ok(())
}

/// Separate from the host's builds, because Debian's compiler has another version.
pub fn target_dir() -> PathBuf {
    workspace::target().join("fw")
}
