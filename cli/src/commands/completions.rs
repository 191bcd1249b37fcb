//! `cantap completions`: what a shell needs to complete the command line.

use std::process::ExitCode;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Examples:\n  cantap completions bash > ~/.local/share/bash-completion/completions/cantap\n  \
                        cantap completions fish > ~/.config/fish/completions/cantap.fish"
)]
pub struct Args {
    /// The shell.
    shell: clap_complete::Shell,
}

/// Runs it for the command that `line` describes.
pub fn run(args: &Args, mut line: clap::Command) -> anyhow::Result<ExitCode> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut line, "cantap", &mut script);
    std::io::Write::write_all(&mut std::io::stdout().lock(), &script)?;
    Ok(ExitCode::SUCCESS)
}
