//! `cantap completions`: a shell's script for completing the command line.

use std::process::ExitCode;

use crate::shells;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Devices, channels, and the messages and signals of a --db are completed too: the shell asks cantap itself.\n\n\
                        Examples:\n  cantap completions bash > ~/.local/share/bash-completion/completions/cantap\n  \
                        cantap completions zsh > ~/.zfunc/_cantap          with ~/.zfunc in fpath\n  \
                        cantap completions fish > ~/.config/fish/completions/cantap.fish\n  \
                        cantap completions powershell >> $PROFILE"
)]
pub struct Args {
    /// The shell.
    shell: clap_complete::Shell,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    std::io::Write::write_all(&mut std::io::stdout().lock(), &shells::script(args.shell)?)?;
    Ok(ExitCode::SUCCESS)
}
