//! How a connection that nobody has named shows on a channel.

use cantap_trace::{Id, TraceRecord};

use super::connection::MasterSlave;

/// What a frame is.
#[derive(Clone, Debug, PartialEq)]
pub enum Sign {
    /// None of a connection that begins.
    None,
    /// What may belong to one.
    Plausible,
    /// With it, a connection is certain: all of its records so far, without this one.
    Certain(MasterSlave, Vec<TraceRecord>),
}

/// Finds out who is a master and who its slave.
pub trait ConnectionFinder: Default {
    /// Takes a data frame.
    fn look(&mut self, record: &TraceRecord, id: Id, data: &[u8]) -> Sign;
}

/// How many connections of a channel are followed.
const MOST_FOUND: usize = 64;

/// Counts on one channel.
#[derive(Clone, Debug, Default)]
pub struct ConnectionSigns<F> {
    finder: F,
    found: Vec<MasterSlave>,
    count: u32,
}

impl<F: ConnectionFinder> ConnectionSigns<F> {
    /// Takes a data frame, and returns whether it is one of those that are examined.
    pub fn take(&mut self, record: &TraceRecord, id: Id, data: &[u8]) -> bool {
        match self.finder.look(record, id, data) {
            Sign::Certain(parties, records) => {
                if self.found.len() < MOST_FOUND && !self.found.contains(&parties) {
                    self.found.push(parties);
                }
                self.count += records.len() as u32 + 1;
                true
            }
            Sign::Plausible => true,
            Sign::None => {
                let is_part = self.has(id);
                self.count += u32::from(is_part);
                is_part
            }
        }
    }

    /// Whether frames with this identifier are those of a connection that was found.
    pub fn has(&self, id: Id) -> bool {
        self.found.iter().any(|one| one.master == id || one.slave == id)
    }

    /// The number of frames that indicate it.
    pub const fn count(&self) -> u32 {
        self.count
    }
}
