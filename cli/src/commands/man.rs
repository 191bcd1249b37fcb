//! `cantap man`: the manual pages, for packages. Hidden, because a user reads `--help`.

use std::path::PathBuf;
use std::process::ExitCode;

/// The command line.
#[derive(clap::Args)]
pub struct Args {
    /// The directory to write to, which must exist.
    directory: PathBuf,
}

/// Writes a page for the command that `line` describes and one for each of its subcommands.
pub fn run(args: &Args, line: clap::Command) -> anyhow::Result<ExitCode> {
    clap_mangen::generate_to(line, &args.directory)?;
    Ok(ExitCode::SUCCESS)
}
