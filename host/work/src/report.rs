//! Messages for a person, on their way to wherever a program shows them: what happened meanwhile, and is no result and no error.

use std::fmt;
use std::sync::Arc;

/// How much a message matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Severity {
    /// Worth knowing.
    Note,
    /// It must not be overlooked.
    Warning,
}

/// Where messages go. Copies share it.
///
/// ```
/// use cantap_work::report::{Reporter, Severity};
///
/// let reporter = Reporter::new(|severity, text| {
///     if severity == Severity::Warning {
///         eprintln!("{text}");
///     }
/// });
/// reporter.warn("channel 1: only errors and no frame");
/// ```
#[derive(Clone)]
pub struct Reporter(Arc<Show>);

type Show = dyn Fn(Severity, &str) + Send + Sync;

impl Reporter {
    /// Passes messages, each one sentence or more without a line's end, to this function.
    pub fn new(show: impl Fn(Severity, &str) + Send + Sync + 'static) -> Self {
        Self(Arc::new(show))
    }

    /// Shows nothing.
    pub fn silent() -> Self {
        Self::new(|_, _| {})
    }

    /// Reports something worth knowing.
    pub fn note(&self, text: impl AsRef<str>) {
        (self.0)(Severity::Note, text.as_ref());
    }

    /// Reports something that must not be overlooked.
    pub fn warn(&self, text: impl AsRef<str>) {
        (self.0)(Severity::Warning, text.as_ref());
    }
}

impl fmt::Debug for Reporter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Reporter")
    }
}
