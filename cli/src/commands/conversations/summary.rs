//! A summary in a few lines on standard error.

use std::collections::BTreeMap;

use cantap::{TraceEvent, TraceRecord};
use cantap_protocols::{Event, Protocol};
use cantap_trace::counted;

/// Counts.
#[derive(Default)]
pub(super) struct Summary {
    frames: u64,
    lost: u64,
    gaps: u64,
    /// Starts of channels whose device does not count its losses. They are gaps, too.
    uncounted: u64,
    /// For each protocol: events, and those in which something went wrong.
    events: BTreeMap<Protocol, (u64, u64)>,
}

impl Summary {
    pub fn record(&mut self, record: &TraceRecord) {
        match record.event {
            TraceEvent::Frame { .. } => self.frames += 1,
            TraceEvent::Lost { count, .. } => {
                self.lost += u64::from(count);
                self.gaps += 1;
                self.uncounted += u64::from(record.event == TraceEvent::UNCOUNTED);
            }
            _ => {}
        }
    }

    pub fn event(&mut self, event: &Event) {
        let (all, faults) = self.events.entry(event.protocol).or_default();
        *all += 1;
        *faults += u64::from(event.is_fault());
    }

    pub fn object(&self) -> serde_json::Value {
        let counts = |pick: fn(&(u64, u64)) -> u64| -> serde_json::Map<_, _> {
            let some = self.events.iter().filter(|(_, counts)| pick(counts) > 0);
            some.map(|(protocol, counts)| (protocol.to_string(), pick(counts).into())).collect()
        };
        serde_json::json!({
            "frames": self.frames,
            "lost": self.lost,
            "gaps": self.gaps,
            "events": counts(|(all, _)| *all),
            "faults": counts(|(_, faults)| *faults),
        })
    }

    pub fn tell(&self) {
        let mut said = Vec::new();
        for (protocol, (all, faults)) in &self.events {
            said.push(match faults {
                0 => format!("{all} {protocol}"),
                faults => format!("{all} {protocol} ({faults} with a fault)"),
            });
        }
        let said =
            if said.is_empty() { "nothing that a protocol explains".to_owned() } else { said.join(", ") };
        eprintln!("cantap: {}: {said}", counted(self.frames, "frame"));
        if self.uncounted > 0 {
            eprintln!(
                "cantap: frames may be missing that nobody counted: the adapter does not report its losses"
            );
        }
        let places = self.gaps - self.uncounted;
        if places > 0 {
            let lost = if self.lost == 0 {
                "frames".to_owned()
            } else {
                format!("{} or more", counted(self.lost, "frame"))
            };
            eprintln!(
                "cantap: {lost} are missing in the trace, at {places}",
                places = counted(places, "place")
            );
        }
    }
}
