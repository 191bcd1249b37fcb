//! The `cantap` command. Each subcommand is a file in `commands/`; this one only chooses.

/// Standard error may be closed or full, and std's macro panics then. Whoever does not read what went wrong still gets the exit code.
macro_rules! eprintln {
    ($($part:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stderr(), $($part)*);
    }};
}

/// As `eprintln`.
macro_rules! eprint {
    ($($part:tt)*) => {{
        use std::io::Write as _;
        let _ = write!(std::io::stderr(), $($part)*);
    }};
}

mod args;
mod channel_args;
mod channel_bitrate;
mod commands;
mod databases;
mod input;
mod interrupt;
mod live;
mod losses;
mod meter;
mod monitor;
mod rescue;
mod sending;
mod timing_args;
mod trigger_args;
mod words;
mod wrong;

use std::process::ExitCode;

use clap::Parser;

/// Exit codes beside 0 (success). Documented in `cantap --help`.
mod exit {
    /// Something failed; the message on stderr says what and what to do next.
    pub const FAILURE: u8 = 1;
    /// A wrong command line; clap uses it by itself.
    pub const WRONG_COMMAND_LINE: u8 = 2;
    /// A check did not hold.
    pub const CHECK_FAILED: u8 = 3;
}

/// Captures, understands and drives CAN buses with a cantap analyser.
#[derive(Parser)]
#[command(
    name = "cantap",
    version,
    after_help = "Exit codes: 0 success, 1 failure, 2 wrong command line, 3 a check did not hold."
)]
struct Cli {
    #[command(subcommand)]
    command: commands::Command,
}

fn main() -> ExitCode {
    match Cli::parse().command.run() {
        Ok(code) => code,
        // `cantap … | head` has read what it wanted.
        Err(error) if is_broken_pipe(&error) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("cantap: {}", sentence(&error));
            ExitCode::from(if is_wrong_command_line(&error) {
                exit::WRONG_COMMAND_LINE
            } else {
                exit::FAILURE
            })
        }
    }
}

/// The error and its causes, but for causes that the error itself tells already, as the library's do.
fn sentence(error: &anyhow::Error) -> String {
    error.chain().skip(1).fold(error.to_string(), |text, cause| {
        let cause = cause.to_string();
        if text.contains(&cause) { text } else { format!("{text}: {cause}") }
    })
}

/// What belongs to the command line and is understood only later: a condition when the databases have been read, a device's
/// options when it is opened.
fn is_wrong_command_line(error: &anyhow::Error) -> bool {
    error.is::<wrong::WrongCommandLine>()
        || error.is::<cantap::condition::ConditionError>()
        || matches!(error.downcast_ref(), Some(cantap::DeviceError::BadAddress { .. }))
}

/// Whether it only says that nobody reads our output any more.
fn is_broken_pipe(error: &anyhow::Error) -> bool {
    let pipe = |cause: &(dyn std::error::Error + 'static)| {
        let cause = cause.downcast_ref::<std::io::Error>();
        cause.is_some_and(|cause| cause.kind() == std::io::ErrorKind::BrokenPipe)
    };
    error.chain().any(pipe)
}
