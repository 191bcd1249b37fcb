//! Columns hold everything in a record, and decoded values as the decoder returns them.

use std::sync::Arc;

use arrow_array::cast::AsArray;
use arrow_array::types::{Float64Type, Int32Type, UInt64Type};
use arrow_array::{ArrayRef, Float64Array, Int64Array, RecordBatch, StringArray};
use cantap_columns::{FrameColumns, MessageColumns, MessageTables, SignalColumns, WideColumns, records};
use cantap_signals::{
    ByteOrder, Database, Decoder, Message, Multiplexed, Signal, Source, ValueKind, ValueTable, dbc,
};
use cantap_trace::testing::record_lin_or_can;
use cantap_trace::{Direction, FdFrame, Frame, Id, PlainFrame, TraceEvent, TraceFrame, TraceRecord};
use proptest::prelude::*;

proptest! {
    #[test]
    fn every_record_comes_back_from_its_columns(wanted in prop::collection::vec(record_lin_or_can(1), 0..50)) {
        let mut columns = FrameColumns::default();
        for record in &wanted {
            columns.push(record);
        }
        prop_assert_eq!(columns.rows(), wanted.len());
        prop_assert_eq!(records(&columns.take()).unwrap(), wanted);
        prop_assert_eq!(columns.rows(), 0);
    }
}

#[test]
fn a_table_that_is_no_trace_says_which_column_it_lacks() {
    let mut columns = FrameColumns::default();
    let batch = columns.take().project(&[1, 2]).unwrap();
    let error = records(&batch).unwrap_err().to_string();
    assert_eq!(
        error,
        "a trace has a column 'time' (a timestamp, or float64 with seconds); there is none among channel, event"
    );
}

/// More about the types of other programs is in `python/tests/test_tables_of_others.py`.
#[test]
fn time_identifier_and_data_are_enough() {
    let batch = |times: Vec<f64>| {
        let ids = Int64Array::from_iter_values((0..times.len() as i64).map(|at| 0x7FF + at));
        let data = StringArray::from_iter_values(times.iter().map(|_| "11 2233"));
        let columns: [(&str, ArrayRef); 3] =
            [("time", Arc::new(Float64Array::from(times))), ("id", Arc::new(ids)), ("data", Arc::new(data))];
        RecordBatch::try_from_iter(columns).unwrap()
    };
    // The shortest decimal number counts, and what is finer than nanoseconds is rounded.
    let times = vec![1_700_000_000.123_456, -0.5, 0.1, 1e-9, 1.000_000_000_6, 5e-324, 1e9];
    let found = records(&batch(times)).unwrap();
    let ns: Vec<_> = found.iter().map(|record| record.time_ns).collect();
    assert_eq!(
        ns,
        [
            1_700_000_000_123_456_000,
            -500_000_000,
            100_000_000,
            1,
            1_000_000_001,
            0,
            1_000_000_000_000_000_000
        ]
    );
    let frames: Vec<_> = found[..2].iter().map(|record| record.frame().unwrap().to_string()).collect();
    assert_eq!(frames, ["7FF#112233", "00000800#112233"]);
    assert!(found.iter().all(|record| record.channel == 1));
    for wrong in [f64::INFINITY, 1e10, -1e300] {
        let error = records(&batch(vec![0.0, wrong])).unwrap_err().after(10).to_string();
        assert_eq!(error, format!("row 11: time: {wrong} s is out of range; seconds are wanted"));
    }
}

const DBC: &[u8] = br#"VERSION ""
BU_: ECU
BO_ 256 Gear: 8 ECU
 SG_ Lever : 0|8@1+ (1,0) [0|4] ""  ECU
 SG_ Speed : 8|16@1- (0.01,0) [-300|300] "km/h"  ECU
CM_ BO_ 256 "The gearbox.";
VAL_ 256 Lever 0 "Park" 3 "Drive" 4 "Drive" ;
"#;

fn decoder() -> Decoder {
    let database = dbc::parse("gear.dbc", DBC).unwrap();
    Decoder::new(vec![Source { channel: None, database }])
}

fn frame(time_ns: i64, text: &str) -> TraceRecord {
    let frame = text.parse().unwrap();
    TraceRecord {
        time_ns,
        device_ns: None,
        channel: 2,
        event: TraceEvent::Frame { frame, direction: Direction::Rx, late: false },
    }
}

#[test]
fn values_have_names_texts_units_and_losses_beside_them() {
    let decoder = decoder();
    let mut columns = SignalColumns::new(&decoder);
    let trace = [
        frame(1_000, "100#0364000000000000"),
        TraceRecord { time_ns: 2_000, device_ns: None, channel: 2, event: TraceEvent::GAP },
        frame(3_000, "100#0138FF"),
    ];
    let mut values = Vec::new();
    for record in &trace {
        match record.frame().and_then(|frame| decoder.decode(record.channel, frame, &mut values)) {
            Some(message) => columns.push_values(&decoder, record, message, &values),
            None => columns.push_event(record),
        }
    }
    let batch = columns.take();
    let texts = |name: &str| -> Vec<Option<String>> {
        let column = batch.column_by_name(name).unwrap().as_any_dictionary();
        let values = column.values().as_string::<i32>();
        let keys = column.normalized_keys();
        (0..batch.num_rows())
            .map(|row| column.keys().is_valid(row).then(|| values.value(keys[row]).to_owned()))
            .collect()
    };
    let some = |texts: [&str; 5]| texts.map(|text| (!text.is_empty()).then(|| text.to_owned())).to_vec();
    assert_eq!(texts("event"), some(["value", "value", "lost", "value", "value"]));
    assert_eq!(texts("signal"), some(["Lever", "Speed", "", "Lever", "Speed"]));
    assert_eq!(texts("text"), some(["Drive", "", "", "", ""]));
    assert_eq!(texts("unit"), some(["", "km/h", "", "", "km/h"]));
    let value = batch.column_by_name("value").unwrap().as_primitive::<Float64Type>();
    assert_eq!(value.iter().collect::<Vec<_>>(), [Some(3.0), Some(1.0), None, Some(1.0), Some(-2.0)]);
    let raw = batch.column_by_name("raw").unwrap().as_primitive::<UInt64Type>();
    assert_eq!(raw.iter().collect::<Vec<_>>(), [Some(3), Some(100), None, Some(1), Some(0xFF38)]);
}

#[test]
fn a_message_has_a_column_for_each_signal() {
    let decoder = decoder();
    let (reference, ..) = decoder.messages().next().unwrap();
    let mut columns = MessageColumns::new(&decoder, reference);
    // The second frame is too short for the speed.
    for record in [frame(1_000, "100#0364000000000000"), frame(2_000, "100#04")] {
        columns.push(&record);
    }
    assert_eq!((columns.rows(), columns.values()), (2, 3));
    let batch = columns.take();
    let names: Vec<_> = batch.schema().fields().iter().map(|field| field.name().clone()).collect();
    assert_eq!(names, ["time", "channel", "id", "Lever", "Lever.text", "Speed"]);
    assert_eq!(batch.schema().metadata()["description"], "The gearbox.");
    assert_eq!(batch.schema().field(5).metadata()["unit"], "km/h");
    let speed = batch.column(5).as_primitive::<Float64Type>();
    assert_eq!(speed.iter().collect::<Vec<_>>(), [Some(1.0), None]);
    let text = batch.column(4).as_dictionary::<Int32Type>();
    let texts = text.values().as_string::<i32>();
    let text: Vec<_> = text.keys().iter().map(|key| texts.value(key.unwrap() as usize)).collect();
    assert_eq!(text, ["Drive", "Drive"]);
}

prop_compose! {
    fn signal()(
        big: bool,
        kind in prop::sample::select(vec![
            ValueKind::Unsigned, ValueKind::Signed, ValueKind::SignMagnitude, ValueKind::Half, ValueKind::Single, ValueKind::Double,
        ]),
        start in 0u16..100,
        length in 1u16..=64,
        (factor, offset) in prop::sample::select(vec![(1.0, 0.0), (0.1, -40.0), (1.0 / 3.0, 0.5), (1000.0, 0.0)]),
        texts in prop::collection::vec((-2i64..10, "[a-c]"), 0..4),
        multiplexed in prop::option::of((0usize..6, 0u64..4)),
    ) -> Signal {
        let order = if big { ByteOrder::Big } else { ByteOrder::Little };
        let length = match kind {
            ValueKind::Half => 16,
            ValueKind::Single => length.clamp(10, 32),
            ValueKind::Double => length.max(13),
            _ => length,
        };
        let values = ValueTable::new(texts);
        let multiplexed = multiplexed.map(|(switch, last)| Multiplexed { switch, values: vec![0..=last] });
        Signal { order, kind, factor, offset, values, multiplexed, ..Signal::new("S", start, length) }
    }
}

/// The frame says what is in it: it cannot be decoded together with others.
#[test]
fn a_plain_frame_that_contains_pdus_has_their_values() {
    let file = include_bytes!("../../../signals/tests/data/container.arxml");
    let database = cantap_signals::arxml::parse("container.arxml", file).unwrap();
    let decoder = Arc::new(Decoder::new(vec![Source { channel: None, database }]));
    let record = frame(1_000, "123#07010203030801F4");
    let mut tables = [(); 2].map(|()| MessageTables::new(Arc::clone(&decoder), false));
    tables[0].push(&record);
    tables[1].push_frames(&[PlainFrame::of(&record).unwrap()]);
    // Counter=7 Engine.Counter=8 Engine.Speed=500
    assert_eq!(tables.each_mut().map(MessageTables::counts), [(1, 3); 2]);
    let [mut of_record, mut of_frame] = tables.map(|tables| tables.finish().0.remove(0).1);
    assert_eq!(of_record.take(), of_frame.take());
}

proptest! {
    /// Frames decoded together have the same values as when decoded one by one: whatever the signals, J1939 or not, chosen or not,
    /// in short frames and in CAN FD frames.
    #[test]
    fn frames_are_decoded_together_as_one_by_one(
        signals in prop::collection::vec(signal(), 1..6),
        j1939: bool,
        chosen in prop::collection::vec(any::<bool>(), 6),
        data in prop::collection::vec((prop::sample::select(vec![0, 1, 2, 5, 7, 8, 8, 8, 8, 8, 8, 8, 12, 64]), any::<u64>()), 1..40),
        ones: bool,
    ) {
        let id = if j1939 { Id::extended(0x18FE_F100) } else { Id::standard(0x123) }.unwrap();
        let (name, description) = ("M".to_owned(), String::new());
        let mut signals = signals;
        for (at, signal) in signals.iter_mut().enumerate() {
            signal.name = format!("S{at}");
        }
        let (cycle_ms, container) = (None, None);
        let message = Message { id, name, description, length: 8, cycle_ms, j1939, container, signals, line: 0 };
        let database = Database { messages: vec![message], ..Database::default() };
        let mut decoder = Decoder::new(vec![Source { channel: None, database }]);
        decoder.retain(|_, index, _| chosen[index]);
        let (reference, ..) = decoder.messages().next().unwrap();
        let (mut together, mut alone) = (MessageColumns::new(&decoder, reference), MessageColumns::new(&decoder, reference));
        let (mut values, mut count) = (Vec::new(), 0);
        // Repeated, so that there are more than are decoded at once.
        for (at, (len, word)) in data.iter().cycle().take(700).enumerate() {
            let word = if ones && at % 3 == 0 { u64::MAX } else { word.rotate_left(at as u32) };
            let bytes = word.to_le_bytes().repeat(8);
            let frame: TraceFrame = match Frame::data_frame(id, &bytes[..*len]) {
                Some(frame) => frame.into(),
                None => FdFrame::new(id, true, false, &bytes[..*len]).unwrap().into(),
            };
            let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
            let record = TraceRecord { time_ns: at as i64, device_ns: None, channel: 1, event };
            prop_assert_eq!(decoder.decode(1, &frame, &mut values), Some(reference));
            prop_assert!(!together.has_value(frame.data_len()) || !values.is_empty());
            together.push(&record);
            alone.push_values(&record, &values);
            count += values.len() as u64;
        }
        prop_assert_eq!((together.values(), alone.values()), (count, count));
        prop_assert_eq!(together.take(), alone.take());
        prop_assert_eq!(together.rows(), 0);
    }

    /// A table for each message has what the decoder gives for each record alone, and what happened beside frames is in a table of its own:
    /// whether its frames come as records or as plain ones.
    #[test]
    fn tables_of_messages_have_what_each_record_says(
        messages in prop::collection::vec((prop::collection::vec(signal(), 1..4), any::<bool>(), 0u32..3), 1..4),
        chosen in prop::option::of(prop::collection::vec(any::<bool>(), 12)),
        records in prop::collection::vec((record_lin_or_can(1), 0usize..4, any::<bool>()), 0..60),
    ) {
        let messages = messages.into_iter().enumerate().map(|(at, (mut signals, extended, id))| {
            let id = if extended { Id::extended(id) } else { Id::standard(id) }.unwrap();
            signals.iter_mut().enumerate().for_each(|(at, signal)| signal.name = format!("S{at}"));
            let (name, description, j1939) = (format!("M{at}"), String::new(), extended);
            Message { id, name, description, length: 8, cycle_ms: None, j1939, signals, container: None, line: 0 }
        });
        let database = Database { messages: messages.collect(), ..Database::default() };
        let mut decoder = Decoder::new(vec![Source { channel: None, database }]);
        if let Some(chosen) = &chosen {
            decoder.retain(|message, index, _| chosen[4 * message.index() + index % 4]);
        }
        let decoder = Arc::new(decoder);
        // Most have an identifier of a message.
        let records: Vec<_> = records.into_iter().map(|(mut record, id, extended)| {
            let id = if extended { Id::extended(id as u32) } else { Id::standard(id as u32) }.unwrap();
            if let TraceEvent::Frame { frame: TraceFrame::Classic(frame), .. } = &mut record.event {
                *frame = Frame::from_bus(id, frame.is_remote(), frame.dlc(), frame.padded_data());
            }
            record
        }).collect();
        let mut expected = decoder.messages().map(|(reference, ..)| MessageColumns::new(&decoder, reference)).collect::<Vec<_>>();
        let (mut events, mut values, mut frames, mut count) = (FrameColumns::default(), Vec::new(), 0, 0);
        let mut of_records = MessageTables::new(Arc::clone(&decoder), chosen.is_some());
        let mut of_frames = MessageTables::new(Arc::clone(&decoder), chosen.is_some());
        for record in &records {
            of_records.push(record);
            match PlainFrame::of(record) {
                Some(frame) => of_frames.push_frames(&[frame]),
                None => of_frames.push(record),
            }
            let Some(frame) = record.frame() else {
                events.push(record);
                continue;
            };
            if let Some(reference) = decoder.decode(record.channel, frame, &mut values)
                && (chosen.is_none() || !values.is_empty())
            {
                expected[reference.index()].push_values(record, &values);
                frames += 1;
                count += values.len() as u64;
            }
        }
        let events = events.take();
        let expected: Vec<RecordBatch> =
            expected.iter_mut().filter(|table| table.rows() > 0).map(MessageColumns::take).collect();
        for mut tables in [of_records, of_frames] {
            prop_assert_eq!(tables.counts(), (frames, count));
            let (tables, mut beside) = tables.finish();
            let tables: Vec<_> = tables.into_iter().map(|(_, mut table)| table.take()).collect();
            prop_assert_eq!(&tables, &expected);
            prop_assert_eq!(beside.take(), events.clone());
        }
    }
}

#[test]
fn no_two_columns_have_one_name_and_no_text_is_there_twice() {
    let text = br#"VERSION ""
BU_: ECU
BO_ 256 Gear: 8 ECU
 SG_ time : 0|8@1+ (1,0) [0|4] ""  ECU
 SG_ Other : 8|8@1+ (1,0) [0|4] ""  ECU
 SG_ Lever : 16|8@1+ (1,0) [0|4] ""  ECU
VAL_ 256 Lever 0 "Park" 3 "Drive" 4 "Drive" ;
"#;
    let mut database = dbc::parse("gear.dbc", text).unwrap();
    // Other kinds of databases have names with a point.
    "Lever.text".clone_into(&mut database.messages[0].signals[1].name);
    let decoder = Decoder::new(vec![Source { channel: None, database }]);
    let (reference, ..) = decoder.messages().next().unwrap();
    let mut columns = MessageColumns::new(&decoder, reference);
    for data in ["100#010203", "100#010204", "100#010200", "100#010205"] {
        columns.push(&frame(0, data));
    }
    let batch = columns.take();
    let schema = batch.schema();
    let names: Vec<_> = schema.fields().iter().map(|field| field.name().as_str()).collect();
    assert_eq!(names, ["time", "channel", "id", "Gear.time", "Lever.text", "Gear.Lever", "Gear.Lever.text"]);
    let texts = batch.column(6).as_dictionary::<Int32Type>();
    assert_eq!(texts.values().as_string::<i32>().iter().flatten().collect::<Vec<_>>(), ["Park", "Drive"]);
    let keys: Vec<_> = texts.keys().iter().collect();
    assert_eq!(keys, [Some(1), Some(1), Some(0), None]);
    let wide = WideColumns::new([("time", "s"), ("Speed", ""), ("Speed", "")]);
    let schema = wide.schema();
    let names: Vec<_> = schema.fields().iter().map(|field| field.name().as_str()).collect();
    assert_eq!(names, ["time", "signal.time", "Speed", "signal.Speed"]);
}
