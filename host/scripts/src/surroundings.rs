//! What the scripts of a run have in common.

use std::sync::Arc;

use cantap_signals::Decoder;

use crate::device_replies::DeviceReplies;
use crate::faults::BenchNodes;
use crate::files::GrantedFiles;

/// What each script of a run is given.
#[derive(Clone)]
pub struct Surroundings {
    /// The databases.
    pub decoder: Arc<Decoder>,
    /// Selects the random numbers; each script has its own.
    pub seed: u64,
    /// The files that scripts may read.
    pub files: Arc<GrantedFiles>,
    /// The replies of the device, if the script may have them.
    pub replies: Option<DeviceReplies>,
    /// All nodes of simulated buses, on which things can go wrong; none on a device.
    pub nodes: Option<BenchNodes>,
}
