//! A gateway's rules: their file, what they do to a trace, and what they make a frame look like on the other bus.
//!
//! The rules themselves are the wire's, and what applies them is the firmware's own library: a dry run does what a board would do.

mod dry_run;
mod expected;
mod rules;
#[cfg(test)]
mod tests;
mod text;

pub use dry_run::{DryRun, DryRunCounts, Sent};
pub use expected::Map;
pub use rules::{Rule, Rules, RulesError};
pub use text::{checksum, counter};
