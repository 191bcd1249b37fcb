//! What the first records could not show: a tester that is plugged in later, and channels that were silent.

use std::collections::BTreeSet;

use cantap::TraceRecord;
use cantap_protocols::{Event, Evidence, Protocol, Survey};

use super::surveyed::LONGEST_NS;
use crate::commands::decode::Seconds;

/// How often to look whether a channel that was silent speaks a protocol by now, in nanoseconds.
const LOOK_EVERY_NS: i64 = 100_000_000;
/// So many messages show it before [`LONGEST_NS`] are over.
const CONVINCING: u32 = 5;

/// Surveys channels that were silent in the first records, from their first frame on: a machine may have been switched on later.
pub(super) struct Later {
    survey: Survey,
    channels: Box<[Silent; 256]>,
}

/// What has become of a channel that was silent.
#[derive(Clone, Copy, PartialEq)]
enum Silent {
    /// It was not, or its protocol is known, or it has none.
    Over,
    /// There was no frame.
    Waits,
    /// When its first frame was, and when to look next.
    Since(i64, i64),
}

impl Later {
    /// After the survey of the first records.
    pub fn new(survey: &Survey) -> Self {
        let silent = |channel| if survey.has_heard(channel) { Silent::Over } else { Silent::Waits };
        let channels = Box::new(std::array::from_fn(|channel| silent(channel as u8)));
        Self { survey: Survey::default(), channels }
    }

    /// Takes the next record, and returns and reports what has shown by now.
    pub fn take(&mut self, record: &TraceRecord, quiet: bool) -> Vec<Evidence> {
        let channel = &mut self.channels[usize::from(record.channel)];
        if *channel == Silent::Over || record.frame().is_none() {
            return Vec::new();
        }
        self.survey.take(record);
        let look = |since_ns| Silent::Since(since_ns, record.time_ns.saturating_add(LOOK_EVERY_NS));
        let since_ns = match *channel {
            Silent::Since(since_ns, look_ns) if record.time_ns >= look_ns => since_ns,
            Silent::Since(..) => return Vec::new(),
            Silent::Waits | Silent::Over => {
                *channel = look(record.time_ns);
                return Vec::new();
            }
        };
        let mut found = self.survey.found();
        found.retain(|found| found.channel == record.channel);
        let is_over = record.time_ns.saturating_sub(since_ns) >= LONGEST_NS;
        if !is_over && found.iter().all(|found| found.messages < CONVINCING) {
            *channel = look(since_ns);
            return Vec::new();
        }
        *channel = Silent::Over;
        for Evidence { channel, protocol, .. } in found.iter().filter(|_| !quiet) {
            eprintln!(
                "cantap: channel {channel} speaks {protocol}; it was silent at first, and is read from {} on; --protocol \
                 {protocol} reads all of it",
                Seconds(record.time_ns)
            );
        }
        found
    }
}

/// Whether it is found at any time, and not only in the first frames.
pub(super) const fn is_diagnostics(protocol: Protocol) -> bool {
    matches!(protocol, Protocol::IsoTp | Protocol::Uds | Protocol::Kwp2000 | Protocol::Obd)
}

/// Reports what was not in the first frames, once for each channel.
pub(super) fn tell_diagnostics(events: &[Event], told: &mut BTreeSet<u8>) {
    for Event { channel, protocol, start_ns, .. } in events {
        if is_diagnostics(*protocol) && told.insert(*channel) {
            eprintln!("cantap: channel {channel} speaks {protocol} from {} on", Seconds(*start_ns));
        }
    }
}
