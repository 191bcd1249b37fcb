//! Conditions on what frames say together, such as `uds.sid == 0x22 and uds.nrc`, in addition to signals and
//! parts of frames.

use std::fmt;

use cantap_signals::Decoder;
use cantap_signals::condition::{Condition, ConditionError, ConditionEvent, Listener};
use cantap_trace::TraceRecord;

use crate::conversations::Conversations;
use crate::naming;
use crate::{Event, Options};

/// Parses a condition whose names may also be those of [`crate::naming`]. The protocols that it names are decoded on every channel, with
/// the pairs and sheets of the options; the decoder's signals include those of J1939's long messages.
pub fn condition(text: &str, decoder: &Decoder, options: &Options) -> Result<Condition, ConditionError> {
    let options = Options {
        protocols: Vec::new(),
        decoder: Some(decoder.clone().into()),
        pairs: options.pairs.clone(),
        sheets: options.sheets.clone(),
        descriptions: options.descriptions.clone(),
        calibration: options.calibration.clone(),
        types: options.types.clone(),
    };
    let listener = Watcher { options, conversations: None, events: Vec::new() };
    Condition::with_listener(text, decoder, Box::new(listener))
}

/// Decodes the protocols that a condition names.
struct Watcher {
    options: Options,
    /// Set from the first record on.
    conversations: Option<Box<Conversations>>,
    events: Vec<Event>,
}

impl fmt::Debug for Watcher {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Watcher").field("protocols", &self.options.protocols).finish_non_exhaustive()
    }
}

impl Listener for Watcher {
    fn knows(&mut self, name: &str) -> bool {
        let Some((protocol, _)) = naming::parts(name) else { return false };
        if !self.options.protocols.contains(&protocol) {
            self.options.protocols.push(protocol);
        }
        true
    }

    fn take(&mut self, record: &TraceRecord, report: &mut dyn FnMut(&dyn ConditionEvent)) {
        let options = &self.options;
        let conversations =
            self.conversations.get_or_insert_with(|| Box::new(Conversations::new(options, None)));
        conversations.take(record, &mut self.events);
        self.events.drain(..).for_each(|event| report(&event));
    }

    fn fresh(&self) -> Box<dyn Listener> {
        Box::new(Self { options: self.options.clone(), conversations: None, events: Vec::new() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::at;

    const TALK: [(f64, &str); 8] = [
        (0.0, "7E0#0322F190"),
        (1.0, "7E8#037F2231"),
        (2.0, "7E0#0322F18C"),
        (3.0, "7E8#0662F18C313233"),
        (4.0, "7E0#023E00"),
        (5.0, "18FECA00#0000A6010305FFFF"),
        (6.0, "7E8#027E00"),
        (5000.0, "123#00"),
    ];

    /// The frames at which the condition holds.
    fn hits(text: &str) -> Vec<usize> {
        let mut condition = condition(text, &Decoder::new(Vec::new()), &Options::default()).unwrap();
        (0..TALK.len()).filter(|&place| condition.holds(&at(TALK[place].0, TALK[place].1))).collect()
    }

    #[test]
    fn a_condition_asks_what_was_said() {
        assert_eq!(hits("uds.sid == 0x22 and uds.nrc"), [1]);
        assert_eq!(hits("uds.sid == 0x22 and not uds.nrc"), [3]);
        assert_eq!(hits("uds.nrc == requestOutOfRange"), [1]);
        assert_eq!(hits("UDS.kind == exchange"), [3, 6]);
        assert_eq!(hits("uds.did != 0xF190"), [3]);
        assert_eq!(hits("uds.response_ms > 1"), [6]);
        assert_eq!(hits("uds.from == '7E0' and uds.fault"), [1]);
        assert_eq!(hits("j1939.spn == 422 and j1939.fmi == 3"), [5]);
        assert_eq!(hits("j1939.node == 0 and j1939.pgn == 0xFECA"), [5]);
        assert_eq!(hits("id == 0x123 or uds.nrc"), [1, 7]);
        assert_eq!(hits("byte[1] == 0x7F and uds.nrc"), [1], "the frame that completes it");
        assert_eq!(hits("uds.spn == 1"), [] as [usize; 0]);
    }

    #[test]
    fn names_that_no_event_had_are_known_afterwards() {
        let none = Decoder::new(Vec::new());
        let mut asked = condition("uds.nrcc or uds.nrc", &none, &Options::default()).unwrap();
        for (ms, frame) in TALK {
            asked.holds(&at(ms, frame));
        }
        assert_eq!(asked.names_without_events().collect::<Vec<_>>(), ["uds.nrcc"]);
        let clone = asked.clone();
        assert_eq!(clone.names_without_events().count(), 1);
        assert!(condition("usd.nrc", &none, &Options::default()).is_err());
        assert!(condition("uds. == 1", &none, &Options::default()).is_err());
    }
}
