//! What a reader has found out about the bus, on standard error.

use cantap_protocols::{Announcement, Evidence, Relative};

use crate::seconds::Seconds;

/// Reports it.
pub(super) fn tell(announcement: &Announcement) {
    match announcement {
        Announcement::Found { protocols, relatives } => tell_found(protocols, relatives),
        Announcement::Begun { channel, protocol, from_ns, is_whole } => {
            let before = if *is_whole {
                String::new()
            } else {
                format!("; --protocol {protocol} reads what came before by it, too")
            };
            eprintln!("cantap: channel {channel} speaks {protocol} from {} on{before}", Seconds(*from_ns));
        }
    }
}

fn tell_found(protocols: &[Evidence], relatives: &[(u8, Relative)]) {
    for (channel, relative) in relatives {
        eprintln!("cantap: channel {channel} has {relative}, which is recognised and not read");
    }
    if protocols.is_empty() && relatives.is_empty() {
        eprintln!(
            "cantap: no protocol is known by its first frames; name one with --protocol to read the trace by it"
        );
        return;
    }
    let mut channels: Vec<(u8, Vec<&str>)> = Vec::new();
    for Evidence { channel, protocol, .. } in protocols {
        match channels.last_mut().filter(|(last, _)| last == channel) {
            Some((_, names)) => names.push(protocol.name()),
            None => channels.push((*channel, vec![protocol.name()])),
        }
    }
    for (channel, names) in channels {
        eprintln!("cantap: channel {channel} speaks {}", names.join(", "));
    }
}
