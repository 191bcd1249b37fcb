//! What a run on a device needs, and why it breaks off.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use cantap::DeviceError;
use cantap_signals::Decoder;

use crate::node::ScriptError;
use crate::report::Report;

/// What a run on a device needs.
#[derive(Clone, Debug)]
pub struct Live {
    /// The databases for messages and signals.
    pub decoder: Arc<Decoder>,
    /// Selects another sequence of random numbers; each script has its own.
    pub seed: u64,
    /// The folder of which scripts may read the files; none for no files at all.
    pub readable: Option<PathBuf>,
    /// When the run ends, since its beginning; scripts with tests end it earlier.
    pub duration: Option<Duration>,
}

/// Why a run on a device broke off.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LiveError {
    /// A script cannot run.
    #[error(transparent)]
    Script(#[from] ScriptError),
    /// The device is gone, or refused something.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// Whoever has the device does not want the scripts any more.
    #[error("the scripts' session with the device is over")]
    Over,
}

/// A run on a device that broke off, and what it had come to.
#[derive(Debug, thiserror::Error)]
#[error("{error}")]
pub struct BrokenOff {
    /// Why.
    #[source]
    pub error: LiveError,
    /// How it went until then.
    pub report: Report,
}
