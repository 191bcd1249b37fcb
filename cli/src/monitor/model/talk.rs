//! What the frames mean, as they come.

use std::collections::VecDeque;

use cantap::TraceRecord;
use cantap_protocols::{Event, Options, Overview, UnderWay};

use crate::protocols::Reading;

/// Events that are kept in words.
const RECENT: usize = 500;

/// What there is to see of it.
#[derive(Clone, Default)]
pub struct Talked {
    /// Nodes, services and objects.
    pub overview: Overview,
    /// The last events; the newest last.
    pub recent: VecDeque<Event>,
    /// Transfers that have begun and have not ended.
    pub under_way: Vec<UnderWay>,
    /// Events so far, and those in which something went wrong.
    pub events: u64,
    /// See [`Self::events`].
    pub faults: u64,
}

/// Reads the protocols that each channel shows.
pub struct Talk {
    reading: Reading,
}

impl Default for Talk {
    fn default() -> Self {
        Self { reading: Reading::new(Options::default(), None, true) }
    }
}

impl Talk {
    /// Takes records. The first seconds of a bus are looked at before they are read.
    pub fn take(&mut self, records: &[TraceRecord], talked: &mut Talked) {
        let Ok(()) = self.reading.take(records, true, |event| {
            talked.events += 1;
            talked.faults += u64::from(event.is_fault());
            talked.overview.take(&event);
            if talked.recent.len() == RECENT {
                talked.recent.pop_front();
            }
            talked.recent.push_back(event);
            Ok::<_, std::convert::Infallible>(())
        });
        talked.under_way = self.reading.under_way();
    }
}
