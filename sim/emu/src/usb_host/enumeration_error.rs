//! How enumeration fails.

/// Why a device did not enumerate.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum EnumerationError {
    /// A descriptor that drivers would refuse or misread.
    #[error("descriptors: {0}")]
    Descriptor(String),
    /// A request that every device must support was refused.
    #[error("{0} was refused")]
    Refused(&'static str),
    /// A transfer went wrong.
    #[error("{what}: {how}")]
    Transfer {
        /// The request.
        what: &'static str,
        /// What was wrong with it.
        how: &'static str,
    },
}
