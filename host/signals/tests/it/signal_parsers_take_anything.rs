//! No text makes the parsers of databases, conditions and values panic or run away; and whatever they accept
//! can be decoded and encoded.

use cantap_signals::condition::Condition;
use cantap_signals::search::{DataPattern, IdPattern};
use cantap_signals::{Database, Decoder, Source, dbc, dbf, encode, file};
use cantap_trace::{Direction, Frame, TraceEvent, TraceRecord};
use proptest::prelude::*;

const DBC: &[&[u8]] = &[
    include_bytes!("../data/dbc/floating_point.dbc"),
    include_bytes!("../data/dbc/issue_184_extended_mux_cascaded.dbc"),
    include_bytes!("../data/dbc/issue_184_extended_mux_multiple_values.dbc"),
    include_bytes!("../data/dbc/j1939.dbc"),
    include_bytes!("../data/dbc/motohawk.dbc"),
    include_bytes!("../data/dbc/multiplex.dbc"),
    include_bytes!("../data/dbc/signed.dbc"),
];

/// Pieces of which formats and conditions consist, and some that do not belong in them.
const PIECES: &[&str] = &[
    "\"",
    "\\\"",
    "\n",
    " ",
    ";",
    ":",
    "|",
    "@",
    "-",
    "-1",
    "0",
    "64",
    "65",
    "4294967295",
    "99999999999999999999",
    "1e999",
    "nan",
    "m0M",
    "M",
    "BO_ 1 A: 8 X\n",
    " SG_ S : 0|8@1+ (1,0) [0|0] \"\" X\n",
    "SG_MUL_VAL_ 1 S S 0-1;\n",
    "VAL_ 1 S 0 \"a\" ;\n",
    "SIG_VALTYPE_ 1 S : 1;\n",
    "CM_ \"",
    "NS_ :\n",
    "[[message]]\n",
    "[[message.signal]]\n",
    "name = \"S\"\n",
    "at = \"D1\"\n",
    "when = { signal = \"S\", is = 1 }\n",
    "[",
    "]",
    "{",
    "é",
    "\u{0}",
    "(",
    ")",
    "and",
    "not",
    "byte[",
    "==",
    "'",
    "S",
    "id",
];

/// One change to a text.
#[derive(Clone, Debug)]
enum Change {
    Flip(prop::sample::Index, u8),
    Insert(prop::sample::Index, &'static str),
    Remove(prop::sample::Index, prop::sample::Index),
    Repeat(prop::sample::Index, prop::sample::Index),
    Cut(prop::sample::Index),
}

fn change() -> impl Strategy<Value = Change> {
    let index = any::<prop::sample::Index>;
    prop_oneof![
        (index(), any::<u8>()).prop_map(|(at, byte)| Change::Flip(at, byte)),
        (index(), prop::sample::select(PIECES)).prop_map(|(at, piece)| Change::Insert(at, piece)),
        (index(), index()).prop_map(|(from, to)| Change::Remove(from, to)),
        (index(), index()).prop_map(|(from, to)| Change::Repeat(from, to)),
        index().prop_map(Change::Cut),
    ]
}

fn changed(bytes: &[u8], changes: &[Change]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    for change in changes {
        let len = bytes.len().max(1);
        // A short stretch: removing half of the file would leave little to test.
        let stretch = |from: &prop::sample::Index, to: &prop::sample::Index, len: usize| {
            let from = from.index(len);
            from..(from + to.index(60)).min(len - 1)
        };
        match change {
            Change::Flip(at, byte) => {
                if let Some(old) = bytes.get_mut(at.index(len)) {
                    *old ^= byte;
                }
            }
            Change::Insert(at, piece) => {
                let at = at.index(bytes.len() + 1);
                bytes.splice(at..at, piece.bytes());
            }
            Change::Remove(from, to) => {
                let stretch = stretch(from, to, len);
                bytes.drain(stretch.start.min(bytes.len())..stretch.end.min(bytes.len()));
            }
            Change::Repeat(from, to) => {
                let stretch = stretch(from, to, len);
                let copy = bytes.get(stretch.clone()).unwrap_or_default().to_vec();
                bytes.splice(stretch.start..stretch.start, copy);
            }
            Change::Cut(at) => bytes.truncate(at.index(bytes.len() + 1)),
        }
    }
    bytes
}

/// Does everything that a program does with a database.
fn use_it(database: Database) {
    let names: Vec<_> = database.messages.iter().map(|message| message.name.clone()).collect();
    let ids: Vec<_> = database.messages.iter().map(|message| message.id).collect();
    let mut decoder = Decoder::new(vec![Source { channel: None, database }]);
    decoder.assume_j1939();
    let mut values = Vec::new();
    for id in ids {
        for data in [&[][..], &[0xA5; 3], &[0xFF; 8], &[0; 8]] {
            let frame = Frame::data_frame(id, data).unwrap().into();
            if let Some(message) = decoder.decode(1, &frame, &mut values) {
                for value in &values {
                    let signal = &decoder.message(message).signals[value.signal as usize];
                    let _ = (signal.number(value.raw).to_string(), signal.text(value.raw));
                }
            }
        }
        if let Some(message) = decoder.find(1, id) {
            values.clear();
            decoder.decode_data(message, &[0x5A; 70], &mut values);
        }
    }
    for name in names {
        let _ = encode::encode(&decoder, None, &name);
        let _ = encode::encode(&decoder, None, &format!("{name}:S=1"));
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(600))]

    #[test]
    fn a_dbc_file_may_be_broken_anywhere(which in 0..DBC.len(), changes in prop::collection::vec(change(), 1..6)) {
        if let Ok(database) = dbc::parse("x.dbc", &changed(DBC[which], &changes)) {
            use_it(database);
        }
    }

    #[test]
    fn a_dbc_file_may_be_a_heap_of_pieces(pieces in prop::collection::vec(prop::sample::select(PIECES), 0..40)) {
        if let Ok(database) = dbc::parse("x.dbc", pieces.concat().as_bytes()) {
            use_it(database);
        }
    }

    #[test]
    fn a_dbf_file_may_be_broken_anywhere(changes in prop::collection::vec(change(), 1..6)) {
        if let Ok(database) = dbf::parse("x.dbf", &changed(super::dbf::FILE.as_bytes(), &changes)) {
            use_it(database);
        }
    }

    #[test]
    fn a_signal_file_may_be_broken_anywhere(changes in prop::collection::vec(change(), 1..6)) {
        let docs = include_str!("../../../../docs/signal-file.md");
        let example = docs.split("```toml\n").nth(1).unwrap().split("```").next().unwrap();
        if let Ok(database) = file::parse("x.toml", &changed(example.as_bytes(), &changes)) {
            use_it(database);
        }
    }

    #[test]
    fn conditions_and_patterns_may_be_anything(
        pieces in prop::collection::vec(prop::sample::select(PIECES), 0..12), noise in ".{0,20}", frame: [u8; 8],
    ) {
        let text = pieces.join(" ") + &noise;
        let database = dbc::parse("x.dbc", b"BO_ 1 A: 8 X\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" X\n").unwrap();
        let decoder = Decoder::new(vec![Source { channel: None, database }]);
        let frame = Frame::data_frame("001".parse().unwrap(), &frame).unwrap().into();
        let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
        match Condition::new(&text, &decoder) {
            Ok(mut condition) => { condition.holds(&TraceRecord { time_ns: 0, device_ns: None, channel: 1, event }); }
            Err(error) => prop_assert!(error.to_string().lines().count() == 3, "{}", error),
        }
        let _ = (text.parse::<IdPattern>(), text.parse::<DataPattern>(), encode::encode(&decoder, None, &text));
        let _ = encode::encode(&decoder, None, &format!("A:S={text}"));
    }
}

/// Texts for which the work would grow faster than their length if something were wrong.
#[test]
fn large_files_take_no_more_than_their_share() {
    let signals: String = (0..3000)
        .map(|n| format!(" SG_ S{n} m{n} : 0|8@1+ (1,0) [0|0] \"\" X\n"))
        .collect::<Vec<_>>()
        .concat();
    let unknown = "VAL_ 7 Nobody 1 \"one\" ;\n".repeat(3000);
    let chain: String =
        (1..3000).map(|n| format!("SG_MUL_VAL_ 1 S{n} S{} 0-1;\n", n - 1)).collect::<Vec<_>>().concat();
    let head = "BO_ 1 A: 8 X\n";
    for (text, accepted) in [
        (format!("{head}{signals}"), true),
        (format!("{head}{signals}{unknown}"), true),
        (format!("{head}{signals}{chain}"), false),
        (format!("{head}{}", "\n".repeat(100_000)), true),
        (format!("{head}CM_ \"{}", "x".repeat(1_000_000)), true),
        (format!("{head}CM_ \"\n{}", head.repeat(1000)), true),
        ("[".repeat(100_000), false),
        (format!("NS_ :{}", "\n\tX_".repeat(10_000)), true),
    ] {
        let start = std::time::Instant::now();
        let result = dbc::parse("x.dbc", text.as_bytes());
        assert_eq!(
            result.is_ok(),
            accepted,
            "{:.60}: {:.200}",
            text,
            result.err().map(|error| error.to_string()).unwrap_or_default()
        );
        if let Ok(database) = result {
            use_it(database);
        }
        // A second on an idle computer; only what grows with the square of the length takes this long.
        assert!(start.elapsed().as_secs() < 120, "{:.60} takes {:?}", text, start.elapsed());
    }
    assert!(file::parse("x.toml", b"x = ").is_err());
    assert!(file::parse("x.toml", format!("x = {}", "[".repeat(100_000)).as_bytes()).is_err());
    assert!(file::parse("x.toml", format!("x{} = 1", ".x".repeat(100_000)).as_bytes()).is_err());
}
