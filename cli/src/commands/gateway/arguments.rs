//! The command line of `cantap gateway`.

use std::path::PathBuf;
use std::time::Duration;

use cantap_formats::Format;

use crate::args;
use crate::completion;
use crate::database_args::DatabaseArgs;
use crate::input::ReadArgs;
use crate::one_board::OneBoard;
use crate::timing_args::TimingArgs;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "The device acknowledges and sends on both its buses, until Ctrl-C. With --save it does so without a host, each time it starts. \
                  --dry-run applies the rules to a trace as a device does, between buses that are never busy; nothing is sent. docs/gateway.md \
                  describes the file of rules.\n\nExamples:\n  \
                  cantap gateway rules.toml -d /dev/ttyACM0 -b 500k -b 2:250k --show\n  \
                  cantap gateway rules.toml -d /dev/ttyACM0 -b 500k --save\n  \
                  cantap gateway --show -d /dev/ttyACM0\n  \
                  cantap gateway --forget -d /dev/ttyACM0\n  \
                  cantap gateway rules.toml --dry-run car.log\n  \
                  cantap gateway rules.toml --dry-run car.log --all -o both.log\n  \
                  cantap delay both.log --from 1 --to 2 --map rules.toml\n\n\
                  Exit code: 1 if the gateway ended on its own: both channels are on one bus, or one was closed."
)]
pub struct Args {
    /// The file of rules (TOML).
    #[arg(value_name = "RULES", required_unless_present_any = ["show", "stop", "forget"])]
    pub(super) rules: Option<PathBuf>,
    #[command(flatten)]
    pub(super) device: OneBoard,
    #[command(flatten)]
    pub(super) timing: TimingArgs,
    /// How long to run, as 10, 500ms or 2m.
    #[arg(short, long, value_parser = args::positive_duration)]
    pub(super) time: Option<Duration>,
    /// Print the counts of each rule once a second. Without RULES, of the gateway that the device runs on its own.
    #[arg(long)]
    pub(super) show: bool,
    /// Store the rules and bit rates on the device, which then runs them on its own each time it starts. Replaces what `cantap
    /// defaults` has stored.
    #[arg(long, requires = "rules", conflicts_with_all = ["show", "time"])]
    pub(super) save: bool,
    /// End the gateway that the device runs on its own. If it is stored, it starts again with the device.
    #[arg(long, conflicts_with_all = ["rules", "show", "time", "save", "bitrates", "sample_point", "sjw", "triple", "segments", "btr"])]
    pub(super) stop: bool,
    /// End it and erase it from the device, with everything else that is stored there.
    #[arg(long, conflicts_with_all = ["rules", "show", "time", "save", "stop", "bitrates", "sample_point", "sjw", "triple", "segments", "btr"])]
    pub(super) forget: bool,
    /// Apply the rules to a trace instead; - for standard input.
    #[arg(long, value_name = "FILE", requires = "rules",
          conflicts_with_all = ["OneBoard", "bitrates", "sample_point", "sjw", "triple", "segments", "btr", "time", "show", "save", "stop", "forget"])]
    pub(super) dry_run: Option<PathBuf>,
    /// Write what would have been sent as a trace.
    #[arg(short, long, value_name = "FILE", requires = "dry_run")]
    pub(super) output: Option<PathBuf>,
    /// Write the trace's own records, too.
    #[arg(long, requires = "output")]
    pub(super) all: bool,
    /// The format to write, if the output's name does not show it.
    #[arg(long = "format", visible_alias = "to", value_name = "FORMAT", requires = "output", add = completion::written_formats())]
    pub(super) written_format: Option<Format>,
    /// Print one JSON object; with --show one a second, too.
    #[arg(long, conflicts_with_all = ["save", "stop", "forget"])]
    pub(super) json: bool,
    #[command(flatten)]
    pub(super) databases: DatabaseArgs,
    #[command(flatten)]
    pub(super) read: ReadArgs,
}
