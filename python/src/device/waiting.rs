//! Waiting, so that Python stays in control.

use std::time::Duration;

use pyo3::prelude::*;

use crate::error::Error;
use crate::grammar::Seconds;

/// A frame that has not ended after this time will not end on its own.
const MOST_TIME: Duration = Duration::from_hours(24);

/// A time to wait, at most a day.
pub fn duration(time: Seconds) -> Result<Duration, Error> {
    Ok(time.duration("time to wait")?.min(MOST_TIME))
}

/// Lets Python handle signals.
#[expect(clippy::redundant_closure_for_method_calls, reason = "the method is for one lifetime")]
pub fn signals() -> Result<(), Error> {
    Python::attach(|py| py.check_signals()).map_err(Error::Python)
}
