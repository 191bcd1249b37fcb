//! The part of a trace that a command reads.

use cantap_formats::time_range::{TimePoint, TimeRange};

/// From when and up to when; commands that read a trace flatten this into their arguments, whose trace is `input`.
#[derive(clap::Args)]
pub struct RangeArgs {
    /// From this time: seconds from the first record (also 90s, 10m, 2h), seconds since 1970, or a date in
    /// UTC.
    #[arg(long, value_name = "TIME", allow_hyphen_values = true, requires = "input")]
    start: Option<TimePoint>,
    /// Up to this time, exclusive.
    #[arg(long, value_name = "TIME", allow_hyphen_values = true, requires = "input")]
    end: Option<TimePoint>,
}

impl RangeArgs {
    /// The range.
    pub fn range(&self) -> TimeRange {
        TimeRange::new(self.start, self.end)
    }
}
