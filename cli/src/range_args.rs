//! The part of a trace that a command reads.

use std::path::PathBuf;

use cantap_formats::time_range::{TimePoint, TimeRange};

use crate::usage_error::usage;

/// From when and up to when; commands that read a trace flatten this into their arguments.
#[derive(clap::Args)]
pub struct RangeArgs {
    /// From this time: seconds from the first record (also 90s, 10m, 2h), seconds since 1970, or a date in
    /// UTC.
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    start: Option<TimePoint>,
    /// Up to this time, exclusive.
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    end: Option<TimePoint>,
}

impl RangeArgs {
    /// Whether it is a part.
    pub const fn is_given(&self) -> bool {
        self.start.is_some() || self.end.is_some()
    }

    /// The range of this trace; an error if there is none, because a device is listened to.
    pub fn of(&self, input: Option<&PathBuf>) -> anyhow::Result<TimeRange> {
        if input.is_none() && self.is_given() {
            return Err(usage(
                "--start and --end choose a part of a trace; how long a device is listened to says -t",
            ));
        }
        if let (Some(TimePoint::At(start)), Some(TimePoint::At(end)))
        | (Some(TimePoint::AfterFirst(start)), Some(TimePoint::AfterFirst(end))) = (self.start, self.end)
            && end <= start
        {
            return Err(usage("nothing is between --start and --end: the end is not after the start"));
        }
        Ok(TimeRange::new(self.start, self.end))
    }
}
