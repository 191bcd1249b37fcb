//! Identifiers that need 29 bits in files that do not mark them as extended.

use std::collections::HashSet;

use cantap_can::Id;

use super::fault::{Fault, FaultKind};

/// Those met so far, for one warning per file.
#[derive(Default)]
pub struct Unflagged {
    first: Option<Fault>,
    /// Which they are, with their message: a file may say the same of a message several times.
    seen: HashSet<(u32, String)>,
}

impl Unflagged {
    /// The identifier of a message, if a frame can have it. One above 11 bits cannot be a standard one, whatever the file says.
    pub fn id(&mut self, raw: u32, extended: bool, symbol: &str, line: u32) -> Option<Id> {
        if extended || raw <= Id::MAX_STANDARD {
            return if extended { Id::extended(raw) } else { Id::standard(raw) };
        }
        let id = Id::extended(raw)?;
        self.seen.insert((raw, symbol.to_owned()));
        self.first.get_or_insert_with(|| {
            let kind = FaultKind::UnflaggedIds { id: raw.into(), messages: 0 };
            Fault { line, symbol: symbol.to_owned(), kind }
        });
        Some(id)
    }

    /// The warning, if there were any.
    pub fn warning(self) -> Option<Fault> {
        let mut fault = self.first?;
        if let FaultKind::UnflaggedIds { messages, .. } = &mut fault.kind {
            *messages = self.seen.len();
        }
        Some(fault)
    }
}
