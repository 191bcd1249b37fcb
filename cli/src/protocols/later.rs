//! What the first records could not show: a tester that is plugged in later, channels that were silent, and other protocols that begin
//! later.

use std::collections::BTreeSet;

use cantap_protocols::{Begun, Event, Evidence};

use crate::commands::decode::Seconds;

/// Reports a protocol that has begun.
pub(super) fn tell_begun(begun: &Begun) {
    let Begun { evidence: Evidence { channel, protocol, .. }, from_ns, is_whole, .. } = begun;
    let before = if *is_whole {
        String::new()
    } else {
        format!("; --protocol {protocol} reads what came before by it, too")
    };
    eprintln!("cantap: channel {channel} speaks {protocol} from {} on{before}", Seconds(*from_ns));
}

/// Reports what was not in the first frames, once for each channel.
pub(super) fn tell_diagnostics(events: &[Event], told: &mut BTreeSet<u8>) {
    for Event { channel, protocol, start_ns, .. } in events {
        if protocol.is_diagnostics() && told.insert(*channel) {
            eprintln!("cantap: channel {channel} speaks {protocol} from {} on", Seconds(*start_ns));
        }
    }
}
