//! What a reader has found out about the bus, as sentences.

use cantap_protocols::{Announcement, Evidence, Relative};

use cantap_trace::Seconds;

/// One sentence for each finding.
pub fn lines(announcement: &Announcement) -> Vec<String> {
    match announcement {
        Announcement::Found { protocols, relatives } => found(protocols, relatives),
        Announcement::Begun { channel, protocol, from_ns, is_whole } => {
            let before = if *is_whole {
                String::new()
            } else {
                format!("; --protocol {protocol} reads what came before by it, too")
            };
            vec![format!("channel {channel} speaks {protocol} from {} on{before}", Seconds(*from_ns))]
        }
    }
}

fn found(protocols: &[Evidence], relatives: &[(u8, Relative)]) -> Vec<String> {
    if protocols.is_empty() && relatives.is_empty() {
        return vec![
            "no protocol is known by its first frames; name one with --protocol to read the trace by it"
                .to_owned(),
        ];
    }
    let mut channels: Vec<(u8, Vec<&str>)> = Vec::new();
    for Evidence { channel, protocol, .. } in protocols {
        match channels.last_mut().filter(|(last, _)| last == channel) {
            Some((_, names)) => names.push(protocol.name()),
            None => channels.push((*channel, vec![protocol.name()])),
        }
    }
    let relatives = relatives.iter().map(|(channel, relative)| {
        let is_read = matches!(relative, Relative::RvC { .. });
        let what = if is_read { "which is read with J1939" } else { "which is recognised and not read" };
        format!("channel {channel} has {relative}, {what}")
    });
    let spoken =
        channels.into_iter().map(|(channel, names)| format!("channel {channel} speaks {}", names.join(", ")));
    relatives.chain(spoken).collect()
}
