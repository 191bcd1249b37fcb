//! A gateway's rules: their file, what they do to a trace, what they make a frame look like on the other bus, and their counts on a device.
//!
//! The rules themselves are the wire's, and what applies them is the firmware's own library: a dry run does what a board would do.

mod counts;
mod counts_text;
mod dry_run;
mod expected;
mod rules;
#[cfg(test)]
mod tests;
mod text;

pub use counts::{Counts, Direction, Named, Row, Sums, other_number, state_name};
pub use dry_run::{DryRun, DryRunCounts, Sent};
pub use expected::Map;
pub use rules::{Rule, Rules, RulesError};
pub use text::{checksum, counter};
