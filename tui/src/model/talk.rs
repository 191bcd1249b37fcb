//! The meaning of the frames, as they arrive.

use std::collections::VecDeque;

use cantap::TraceRecord;
use cantap_protocols::{Event, Options, Overview, UnderWay};

use cantap_work::reading::Reading;

/// How many events are kept.
const RECENT: usize = 500;

/// What can be shown of it.
#[derive(Clone, Default)]
pub struct Talked {
    /// Nodes, services and objects.
    pub overview: Overview,
    /// The last events; the newest last.
    pub recent: VecDeque<Event>,
    /// Transfers in progress.
    pub under_way: Vec<UnderWay>,
    /// Number of events so far, and of those in which something went wrong.
    pub events: u64,
    /// See [`Self::events`].
    pub faults: u64,
}

/// Decodes the protocols found on each channel.
pub struct Talk {
    reading: Reading,
}

impl Default for Talk {
    fn default() -> Self {
        Self::new(&Options::default())
    }
}

impl Talk {
    /// By these pairs and descriptions.
    pub fn new(options: &Options) -> Self {
        Self { reading: Reading::new(options.clone(), None, None) }
    }

    /// Takes records. The first seconds of a bus are examined before they are decoded.
    pub fn take(&mut self, records: &[TraceRecord], talked: &mut Talked) {
        self.read(records, true, talked);
    }

    /// There are no more records: what waits in the first seconds is read now, and what was under way ends.
    pub fn conclude(&mut self, talked: &mut Talked) {
        self.read(&[], false, talked);
    }

    fn read(&mut self, records: &[TraceRecord], more: bool, talked: &mut Talked) {
        let Ok(()) = self.reading.take(records, more, |event| {
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
