//! Columns hold everything that a record says, and decoded values as the decoder gives them.

use arrow_array::cast::AsArray;
use arrow_array::types::{Float64Type, Int32Type, UInt64Type};
use cantap_columns::{FrameColumns, MessageColumns, SignalColumns, records};
use cantap_signals::{Decoder, Source, dbc};
use cantap_trace::testing::record_or_fd;
use cantap_trace::{Direction, TraceEvent, TraceRecord};
use proptest::prelude::*;

proptest! {
    #[test]
    fn every_record_comes_back_from_its_columns(wanted in prop::collection::vec(record_or_fd(1), 0..50)) {
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
    let batch = columns.take().project(&[0, 1, 2]).unwrap();
    let error = records(&batch).unwrap_err().to_string();
    assert_eq!(error, "a trace has a column 'detail' of type text; there is none");
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
        TraceRecord { time_ns: 2_000, channel: 2, event: TraceEvent::GAP },
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
    let (reference, _, message) = decoder.messages().next().unwrap();
    let mut columns = MessageColumns::new(message);
    let mut values = Vec::new();
    // The second frame is too short for the speed.
    for record in [frame(1_000, "100#0364000000000000"), frame(2_000, "100#04")] {
        assert_eq!(decoder.decode(2, record.frame().unwrap(), &mut values), Some(reference));
        columns.push(message, &record, &values);
    }
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
