//! Times as scripts write them.

use std::time::Duration;

use cantap_trace::grammar;

use crate::script_result::Result;

/// Nanoseconds of a time such as `20ms`.
pub fn ns(text: &str) -> Result<u64> {
    grammar::duration(text).map(as_ns).map_err(Into::into)
}

/// The same; not zero.
pub fn positive_ns(text: &str) -> Result<u64> {
    grammar::positive_duration(text).map(as_ns).map_err(Into::into)
}

fn as_ns(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX / 2).min(u64::MAX / 2)
}
