//! What is known of a node, as text.

use std::fmt::Write as _;

use cantap_protocols::KnownNode;
use cantap_trace::counted;

/// Faults, state, identity and codes, as far as there are any.
pub fn about(known: &KnownNode) -> String {
    let mut about = String::new();
    if known.faults > 0 {
        let _ = write!(about, ", {} faults", known.faults);
    }
    if let Some(state) = &known.state {
        let _ = write!(about, ", {state}");
    }
    if let Some(drive) = known.drive {
        let _ = write!(about, ", drive: {drive}");
    }
    if known.missed > 0 {
        let _ = write!(about, " ({} missed", counted(known.missed, "time"));
        if let Some(period_ms) = known.period_ms {
            let _ = write!(about, ", period {period_ms:.0} ms");
        }
        about.push(')');
    }
    if let Some(identity) = &known.identity {
        let _ = write!(about, ", {identity}");
    }
    for (list, codes) in &known.codes {
        let _ = write!(about, "; {list}: {codes}");
    }
    about
}
