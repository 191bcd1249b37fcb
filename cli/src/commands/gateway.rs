//! `cantap gateway`: the device passes frames on between its two buses; or its rules are tried on a trace.

mod arguments;
mod device;
mod dry;

use std::process::ExitCode;

use cantap_work::gateway::Rules;

pub use arguments::Args;

use crate::usage_error::usage;

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if args.dry_run.is_none()
        && let Some(option) = args.read.given().or(args.databases.given())
    {
        return Err(usage(format!(
            "{option} is for a trace that --dry-run reads; what a device passes on, the rules say"
        )));
    }
    let rules = args.rules.as_deref().map(Rules::read).transpose()?;
    if args.stop || args.forget {
        return device::stop(args);
    }
    match (&rules, &args.dry_run) {
        (Some(rules), Some(trace)) => dry::run(args, rules, trace),
        (Some(rules), None) if args.save => device::save(args, rules),
        (Some(rules), None) => device::run(args, rules),
        (None, _) if args.timing.options().is_given() => Err(usage(
            "the gateway that the device runs on its own has its bit rates; leave them out, or give RULES to start another",
        )),
        (None, _) => device::show(args),
    }
}
