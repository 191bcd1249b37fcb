//! How a trace is read.

use super::Format;
use super::seek::IndexFolder;
use super::table::Columns;
use super::zone::Zone;

/// How to read.
#[derive(Clone, Debug, Default)]
pub struct ReadOptions {
    /// The format; if not given, it is determined by the file's first bytes where they are clear, otherwise
    /// by its suffix.
    pub format: Option<Format>,
    /// Wait for more at the end of the file instead of ending.
    pub follow: bool,
    /// End after the first issue.
    pub strict: bool,
    /// The zone of dates in files that name none.
    pub zone: Zone,
    /// Which columns of a table mean what. If they are given and no format is, files are tables.
    pub columns: Option<Columns>,
    /// Where indexes of large files are kept and looked for, for [`TraceReader::within`](crate::TraceReader::within); none without.
    pub index: Option<IndexFolder>,
}
