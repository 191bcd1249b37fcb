//! What is encoded decodes to the same: for every kind of signal, every position, and every possible value.

use cantap_signals::{
    ByteOrder, Database, Decoder, Message, Multiplexed, Number, Signal, Source, ValueKind, encode,
};
use cantap_trace::Id;
use proptest::prelude::*;

fn message(signals: Vec<Signal>) -> Message {
    let id = Id::standard(5).unwrap();
    let (name, description) = ("M".to_owned(), String::new());
    let (cycle_ms, container) = (None, None);
    Message { id, name, description, length: 8, cycle_ms, j1939: false, container, signals, line: 0 }
}

fn decoder(message: Message) -> Decoder {
    let database = Database { messages: vec![message], ..Database::default() };
    Decoder::new(vec![Source { channel: None, database }])
}

prop_compose! {
    fn signal()(
        big: bool,
        kind in prop::sample::select(vec![
            ValueKind::Unsigned, ValueKind::Signed, ValueKind::SignMagnitude, ValueKind::OnesComplement, ValueKind::Half, ValueKind::Single, ValueKind::Double,
        ]),
        start in 0u16..64,
        length in 1u16..=64,
        scale in prop::sample::select(vec![(1.0, 0.0), (0.5, -40.0), (0.1, 0.0), (2.0, 512.0), (-0.25, 7.0), (1e-3, 1.5), (1000.0, -3.0)]),
    ) -> Signal {
        let length = match kind {
            ValueKind::Half => 16,
            // Ten bits hold the sign, the exponent and one bit of the fraction.
            ValueKind::Single => length.clamp(10, 32),
            ValueKind::Double => length.max(13),
            _ => length,
        };
        let (factor, offset) = if matches!(kind, ValueKind::Half | ValueKind::Single | ValueKind::Double) { (1.0, 0.0) } else { scale };
        let order = if big { ByteOrder::Big } else { ByteOrder::Little };
        Signal { order, kind, factor, offset, ..Signal::new("S", start, length) }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { max_global_rejects: 200_000, ..ProptestConfig::with_cases(20_000) })]

    #[test]
    fn encoding_undoes_decoding(signal in signal(), raw: u64) {
        prop_assume!(signal.bytes_needed() <= 8);
        let raw = raw >> (64 - signal.length);
        let number = signal.number(raw);
        prop_assume!(number.is_finite());
        // A float has 53 bits: what scaling removes from a longer integer cannot come back.
        let is_float = signal.integer(raw).is_none();
        prop_assume!(matches!(number, Number::Integer(_)) || signal.length <= 48 || is_float);
        let decoder = decoder(message(vec![signal.clone()]));
        let encoded = encode::encode(&decoder, None, &format!("M:S={number}"));
        let encoded = encoded.map_err(|error| TestCaseError::fail(format!("{number}: {error}")))?;
        let mut values = Vec::new();
        decoder.decode(1, &encoded.frame.into(), &mut values).unwrap();
        prop_assert_eq!(signal.number(values[0].raw), number);
        // Minus zero and zero are the same number.
        let only_the_sign = match signal.kind {
            ValueKind::OnesComplement => raw == u64::MAX >> (64 - signal.length),
            _ => raw == 1 << (signal.length - 1),
        };
        if !only_the_sign || matches!(signal.kind, ValueKind::Unsigned | ValueKind::Signed) {
            prop_assert_eq!(values[0].raw, raw);
        }
        prop_assert_eq!(signal.extract(encoded.frame.data()), Some(values[0].raw));
        let raw_text = format!("M:S=raw:{raw}");
        prop_assert_eq!(signal.extract(encode::encode(&decoder, None, &raw_text).unwrap().frame.data()), Some(raw));
    }

    #[test]
    fn a_multiplexed_signal_brings_its_multiplexers(
        outer in 0u64..16, inner in 0u64..16, width in 0u64..4, value in 0u64..256,
    ) {
        let switch = |switch, low: u64| Some(Multiplexed { switch, values: vec![low..=low + width] });
        let signals = vec![
            Signal { multiplexed: switch(1, inner), ..Signal::new("Deep", 16, 8) },
            Signal { multiplexed: switch(2, outer), ..Signal::new("Inner", 8, 8) },
            Signal::new("Outer", 0, 8),
        ];
        let decoder = decoder(message(signals));
        let frame = encode::encode(&decoder, None, &format!("M:Deep={value}")).unwrap().frame;
        prop_assert_eq!(frame.data()[..3].to_vec(), vec![outer as u8, inner as u8, value as u8]);
        let mut values = Vec::new();
        decoder.decode(1, &frame.into(), &mut values).unwrap();
        let mut found: Vec<_> = values.iter().map(|value| (value.signal, value.raw)).collect();
        found.sort_unstable();
        prop_assert_eq!(found, vec![(0, value), (1, inner), (2, outer)]);
    }
}

/// Cycles and other nonsense that no file can contain but a program can make.
#[test]
fn databases_made_by_programs_cannot_make_the_decoder_run_away() {
    let loops = |at: usize| Some(Multiplexed { switch: at, values: vec![0..=255] });
    let signals = vec![
        Signal { multiplexed: loops(1), ..Signal::new("A", 0, 8) },
        Signal { multiplexed: loops(0), ..Signal::new("B", 8, 8) },
        Signal { multiplexed: loops(99), ..Signal::new("C", 8, 8) },
        Signal::new("NoBits", 0, 0),
        Signal::new("TooMany", 0, 65),
        Signal::new("Fine", 0, 8),
    ];
    let decoder = decoder(message(signals));
    let mut values = Vec::new();
    decoder.decode(1, &"005#0102".parse().unwrap(), &mut values).unwrap();
    assert_eq!(values.iter().map(|value| value.signal).collect::<Vec<_>>(), [5]);
    assert_eq!(
        encode::encode(&decoder, None, "M:Fine=3").unwrap().frame.to_string(),
        "005#0300000000000000",
        "the signal C counts as always there"
    );
    for text in ["M:A=1", "M:NoBits=0", "M:TooMany=raw:1"] {
        assert!(encode::encode(&decoder, None, text).is_err() || text.contains("M:A"), "{text}");
    }
}
