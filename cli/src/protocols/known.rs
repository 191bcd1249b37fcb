//! An inventory of a bus, as text and JSON.

use std::fmt::Write as _;

use cantap::TraceRecord;
use cantap_protocols::{Histogram, Overview, Protocol};
use cantap_trace::counted;
use serde_json::{Value, json};

use cantap_work::node_text::about;
use cantap_work::reading::Reading;

/// Responses, nodes and objects of a trace, collected by reading it.
pub struct Known {
    reading: Reading,
    overview: Overview,
}

impl Known {
    /// With a reader that has not read anything.
    pub fn new(reading: Reading) -> Self {
        Self { reading, overview: Overview::default() }
    }

    /// Takes records; if `more` is false, this was the end.
    pub fn take(&mut self, records: &[TraceRecord], more: bool) {
        let overview = &mut self.overview;
        let Ok(()) = self.reading.take(records, more, |event| {
            overview.take(&event);
            Ok::<_, std::convert::Infallible>(())
        });
    }

    /// What is known.
    pub fn overview(&self) -> &Overview {
        &self.overview
    }

    /// A table of services and one of nodes.
    pub fn text(&self) -> String {
        let mut out = String::new();
        // Writing to a String cannot fail.
        let mut head = "\nServices, with the time until the response in ms: minimum, median, 99 %, maximum\n";
        for ((channel, protocol, title), figures) in self.overview.services() {
            let _ = write!(
                out,
                "{}  {channel} {protocol:<9} {title:<32} {:>7}",
                std::mem::take(&mut head),
                figures.count
            );
            match times(&figures.responses) {
                Some([min, median, p99, max]) => {
                    let _ = write!(out, " {min:>9.3} {median:>9.3} {p99:>9.3} {max:>9.3}");
                }
                None => out.push_str("  no response"),
            }
            for (count, what) in
                [(figures.unanswered, "unanswered"), (figures.faults - figures.unanswered, "faults")]
            {
                if count > 0 {
                    let _ = write!(out, ", {count} {what}");
                }
            }
            out.push('\n');
        }
        let mut head = "\nNodes\n";
        for ((channel, protocol, node), known) in self.overview.nodes() {
            let _ = writeln!(
                out,
                "{}  {channel} {protocol:<9} {node:<10} {:>7} events{}",
                std::mem::take(&mut head),
                known.events,
                about(known)
            );
        }
        if self.overview.left_out() > 0 {
            let _ = writeln!(
                out,
                "  not counted, because there are too many nodes, services or objects: {}",
                counted(self.overview.left_out(), "event")
            );
        }
        out
    }

    /// The same for programs.
    pub fn object(&self) -> Value {
        let services = self.overview.services().map(|((channel, protocol, title), figures)| {
            let [min, median, p99, max] = times(&figures.responses).map_or([None; 4], |times| times.map(Some));
            json!({
                "channel": channel, "protocol": protocol.name(), "service": title, "count": figures.count, "faults": figures.faults,
                "unanswered": figures.unanswered, "response_min_ms": min, "response_median_ms": median, "response_p99_ms": p99,
                "response_max_ms": max,
            })
        });
        let nodes = self.overview.nodes().map(|((channel, protocol, node), known)| {
            let mut node = named((channel, protocol, &node));
            let about = json!({
                "first_s": known.first_ns as f64 / 1e9, "last_s": known.last_ns as f64 / 1e9, "events": known.events,
                "faults": known.faults, "state": known.state, "drive": known.drive, "missed": known.missed, "period_ms": known.period_ms,
                "identity": known.identity, "codes": known.codes,
            });
            if let (Value::Object(node), Value::Object(about)) = (&mut node, about) {
                node.extend(about);
            }
            node
        });
        json!({
            "services": services.collect::<Vec<_>>(),
            "nodes": nodes.collect::<Vec<_>>(),
            "left_out": self.overview.left_out(),
        })
    }
}

/// A node's key as members.
pub fn named((channel, protocol, node): (u8, Protocol, &str)) -> Value {
    json!({ "channel": channel, "protocol": protocol.name(), "node": node })
}

/// Least, median, 99 % and most, in milliseconds.
fn times(responses: &Histogram) -> Option<[f64; 4]> {
    let at = |percent| responses.percentile_ms(percent);
    Some([at(0.0)?, at(50.0)?, at(99.0)?, at(100.0)?])
}
