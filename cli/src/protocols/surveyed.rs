//! The first records show which protocols a bus uses. They wait until then, and are then read like all
//! others.

use cantap::TraceRecord;
use cantap_protocols::{Evidence, Relative, Survey};

/// A survey examines no more records than this.
const MOST_RECORDS: usize = 200_000;
/// Nor more than this time of the bus, in nanoseconds.
const LONGEST_NS: i64 = 3_000_000_000;

/// Records waiting for the survey.
pub(super) struct Surveyed {
    survey: Option<Survey>,
    waiting: Vec<TraceRecord>,
}

impl Surveyed {
    /// Without a survey, nothing waits.
    pub fn new(is_wanted: bool) -> Self {
        Self { survey: is_wanted.then(Survey::new), waiting: Vec::new() }
    }

    /// Takes records; returns whether the survey is done.
    pub fn take(&mut self, records: &[TraceRecord], more: bool) -> bool {
        let Some(survey) = &mut self.survey else {
            self.waiting.extend_from_slice(records);
            return true;
        };
        for record in records {
            survey.take(record);
        }
        self.waiting.extend_from_slice(records);
        let spans = match (self.waiting.first(), self.waiting.last()) {
            (Some(first), Some(last)) => last.time_ns.saturating_sub(first.time_ns),
            _ => 0,
        };
        !more || self.waiting.len() >= MOST_RECORDS || spans >= LONGEST_NS
    }

    /// The survey, if there is one.
    pub const fn survey(&self) -> Option<&Survey> {
        self.survey.as_ref()
    }

    /// The protocols of each channel; `None` without a survey.
    pub fn found(&self) -> Option<Vec<Evidence>> {
        self.survey.as_ref().map(Survey::found)
    }

    /// Protocols recognised but not decoded.
    pub fn relatives(&self) -> Vec<(u8, Relative)> {
        self.survey.as_ref().map_or_else(Vec::new, Survey::relatives)
    }

    /// The records that waited.
    pub fn release(&mut self) -> Vec<TraceRecord> {
        std::mem::take(&mut self.waiting)
    }
}

/// Reports what was found.
pub(super) fn tell(found: Option<&[Evidence]>, relatives: &[(u8, Relative)]) {
    let Some(found) = found else { return };
    for (channel, relative) in relatives {
        eprintln!("cantap: channel {channel} has {relative}, which is recognised and not read");
    }
    if found.is_empty() && relatives.is_empty() {
        eprintln!(
            "cantap: no protocol is known by its first frames; name one with --protocol to read the trace by it"
        );
        return;
    }
    let mut channels: Vec<(u8, Vec<&str>)> = Vec::new();
    for Evidence { channel, protocol, .. } in found {
        match channels.last_mut().filter(|(last, _)| last == channel) {
            Some((_, names)) => names.push(protocol.name()),
            None => channels.push((*channel, vec![protocol.name()])),
        }
    }
    for (channel, names) in channels {
        eprintln!("cantap: channel {channel} speaks {}", names.join(", "));
    }
}
