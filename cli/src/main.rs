//! The `cantap` command. Each subcommand is a file in `commands/`; this one only selects.

#![forbid(unsafe_code)]
// They panic when nobody reads standard output any more.
#![cfg_attr(not(test), deny(clippy::print_stdout))]

/// Prints a message; what a terminal would obey, from a device, a server or a file, is replaced. Standard error may be closed or full, in
/// which case std's macro panics. Anyone who does not read the message still gets the exit code.
macro_rules! eprintln {
    ($($part:tt)*) => {
        $crate::stderr::tell(&format!("{}\n", format_args!($($part)*)))
    };
}

/// Like `eprintln`, without ending the line.
macro_rules! eprint {
    ($($part:tt)*) => {
        $crate::stderr::tell(&format!($($part)*))
    };
}

mod args;
mod channel_args;
mod clock;
#[cfg(feature = "parquet")]
mod columns;
mod commands;
mod completion;
mod database_args;
mod exit;
mod fd_frames;
mod habits;
mod input;
mod key_command;
mod keyboard;
mod live_args;
mod one_board;
mod page;
mod print_sent;
mod progress;
mod protocols;
mod range_args;
mod shells;
mod speak_args;
mod stderr;
mod timing_args;
mod trace_output;
mod trigger_args;
mod usage_error;
#[cfg(test)]
mod vocabulary;

use std::alloc::System;
use std::error::Error;
use std::ffi::OsString;
use std::process::ExitCode;

use cantap_scripts::Counting;
use cantap_work::interrupt;
use clap::error::{ContextKind, ContextValue};
use clap::{CommandFactory, FromArgMatches, Parser};
use clap_complete::CompleteEnv;

/// Counted for scripts, whose memory is limited.
#[global_allocator]
static ALLOCATOR: Counting<System> = Counting(System);

/// Captures, understands and drives CAN buses with a cantap analyser.
#[derive(Parser)]
#[command(
    name = "cantap",
    version,
    disable_help_subcommand = true,
    after_help = "Exit codes: 0 success, 1 failure, 2 wrong command line, 3 a check did not hold, 130 ended by Ctrl-C before it was done. \
                  What runs until Ctrl-C, such as capture, ends with 0."
)]
struct Cli {
    #[command(subcommand)]
    command: commands::Command,
}

fn main() -> ExitCode {
    // For completion by a shell, the program ends here.
    CompleteEnv::with_factory(Cli::command).var(shells::VARIABLE).shells(shells::ALL).complete();
    let arguments = commands::extcap::arguments(std::env::args_os());
    let line = commands::help::grouped(Cli::command());
    let command = arguments.get(1).and_then(|name| line.find_subcommand(name)).cloned();
    let parsed = line.clone().try_get_matches_from(arguments.iter());
    let cli = parsed
        .and_then(|matches| Cli::from_arg_matches(&matches))
        .unwrap_or_else(|error| leave(error, command.as_ref(), &arguments));
    let ends_by_itself = cli.command.ends_by_itself();
    match cli.command.run(line) {
        Ok(code) => code,
        // `cantap … | head` has read enough.
        Err(error) if is_broken_pipe(&error) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!(
                "cantap: {}{}",
                cantap_work::advice::sentence(&error),
                habits::also(&error, &arguments)
            );
            ExitCode::from(match error {
                error if is_usage_error(&error) => exit::WRONG_COMMAND_LINE,
                _ if ends_by_itself && interrupt::requested() => interrupt::ENDED_BY_SIGNAL,
                _ => exit::FAILURE,
            })
        }
    }
}

/// The command line is wrong, or requests help. A device's options are a language of their own: an error in one is reported like an
/// error in a condition, on one line.
fn leave(mut error: clap::Error, command: Option<&clap::Command>, arguments: &[OsString]) -> ! {
    let address = error.source().and_then(|source| source.downcast_ref());
    if let Some(address @ cantap_address::AddressError::Option { .. }) = address {
        eprintln!("cantap: {address}");
        std::process::exit(exit::WRONG_COMMAND_LINE.into());
    }
    if let Some(advice) = habits::advice(&error, command, arguments) {
        // A command that is only spelled alike would mislead.
        error.remove(ContextKind::SuggestedSubcommand);
        error.remove(ContextKind::SuggestedArg);
        error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![advice.into()]));
    } else if matches!(error.get(ContextKind::InvalidArg), Some(ContextValue::String(arg)) if arg.starts_with('-'))
    {
        // That an option may be the name of a file is right, and hardly ever what was meant.
        error.remove(ContextKind::Suggested);
    }
    error.exit()
}

/// Errors of the command line that are detected only later, such as those in a condition after the databases have been
/// read.
fn is_usage_error(error: &anyhow::Error) -> bool {
    use cantap_work::timing_options::TimingOptionsError;

    error.is::<usage_error::UsageError>()
        || error.is::<cantap_signals::condition::ConditionError>()
        || error.is::<cantap_work::channels::NoSuchChannel>()
        || error.is::<cantap::periodic::BadPeriodic>()
        || error.downcast_ref().is_some_and(cantap_work::boards::BoardsError::is_usage)
        || error
            .downcast_ref()
            .is_some_and(|error: &TimingOptionsError| !matches!(error, TimingOptionsError::Timing(_)))
        || cantap_work::advice::is_unknown_format(error)
}

/// Whether it only says that nobody reads our output any more.
fn is_broken_pipe(error: &anyhow::Error) -> bool {
    let pipe = |cause: &(dyn std::error::Error + 'static)| {
        let cause = cause.downcast_ref::<std::io::Error>();
        cause.is_some_and(|cause| cause.kind() == std::io::ErrorKind::BrokenPipe)
    };
    error.chain().any(pipe)
}
