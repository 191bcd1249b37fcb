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
        Err(error) => {
            eprintln!("cantap: {error:#}");
            ExitCode::FAILURE
        }
    }
}
