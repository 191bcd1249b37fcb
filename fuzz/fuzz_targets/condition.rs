//! Any text as a condition, as a pattern, as a filter with names of messages, and as a message to be encoded.

#![no_main]

use cantap_signals::condition::Condition;
use cantap_signals::named::{NamedFilter, NamedId};
use cantap_signals::search::{DataPattern, IdPattern};
use cantap_signals::{Decoder, Source, dbc, encode};
use cantap_trace::{Direction, TraceEvent, TraceRecord};

const DATABASE: &[u8] =
    b"BO_ 1 A: 8 X\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" X\n SG_ T : 8|32@1- (0.1,3) [0|0] \"\" X\n\
                          VAL_ 1 S 0 \"off\" 1 \"on\" ;\nSIG_VALTYPE_ 1 T : 1;\n";

libfuzzer_sys::fuzz_target!(|text: &str| {
    let Ok(database) = dbc::parse("fuzz.dbc", DATABASE) else { return };
    let decoder = Decoder::new(vec![Source { channel: None, database }]);
    let frame = encode::encode(&decoder, None, text).map(|encoded| encoded.frame);
    if let Ok(mut condition) = Condition::new(text, &decoder) {
        let Ok(frame) = frame.or_else(|_| "001#0102030405060708".parse()) else { return };
        let event = TraceEvent::Frame { frame: frame.into(), direction: Direction::Rx, late: false };
        condition.holds(&TraceRecord { time_ns: 0, device_ns: None, channel: 1, event });
    }
    let _ = text.parse::<NamedFilter>().map(|named| named.resolve(&decoder));
    let _ = text.parse::<NamedId>().map(|named| named.resolve(&decoder));
    let _ = (text.parse::<IdPattern>(), text.parse::<DataPattern>());
});
