//! `cargo demo`: [`cantap_demo`] without the rest of the command, so that it is built in a minute.

use std::process::ExitCode;

use clap::Parser;

/// Two saturated channels without a board, and the check that nothing is lost silently.
#[derive(Parser)]
#[command(name = "cantap demo", version)]
struct Cli {
    #[command(flatten)]
    args: cantap_demo::Args,
}

fn main() -> ExitCode {
    match cantap_demo::run(&Cli::parse().args, &cantap_demo::trace_file) {
        Ok(code) => code,
        // `cargo demo | head` has read enough.
        Err(error) if error.chain().any(is_broken_pipe) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("cantap: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn is_broken_pipe(cause: &(dyn std::error::Error + 'static)) -> bool {
    cause.downcast_ref().is_some_and(|error: &std::io::Error| error.kind() == std::io::ErrorKind::BrokenPipe)
}
