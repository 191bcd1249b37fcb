//! Conversions of A2L files stand for the same values as by pya2l, on random numbers. Reciprocals are compared where pya2l inverts them: without a
//! constant in the divisor.
//!
//! The Python that has it is `CANTAP_PYTHON`, otherwise `python3`. If it is missing, its test passes, unless `CANTAP_REQUIRE_PEERS=1`.

use std::io::Write as _;
use std::process::{Command, Stdio};

use cantap_protocols::a2l::{Conversion, Meaning, Texts};
use cantap_testing::peers;
use serde_json::{Value, json};

const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/a2l_peer.py");

/// Conversions with the words in which the peer takes them.
fn conversions(random: &mut fastrand::Rng) -> Vec<(Conversion, &'static str, Value)> {
    let mut all = Vec::new();
    let mut coefficient = || f64::from(random.i32(-4000..4000)) / 16.0 + 0.01;
    for _ in 0..200 {
        let [b, c, f] = [coefficient(), coefficient(), coefficient()];
        for coefficients in [[0.0, b, c, 0.0, 0.0, f], [0.0, 0.0, c, 0.0, b, 0.0]] {
            all.push((Conversion::Rational(coefficients), "rational", json!(coefficients)));
        }
        all.push((Conversion::Linear { factor: b, offset: c }, "linear", json!([b, c])));
    }
    for _ in 0..50 {
        let mut at = 0;
        let ranges: Vec<_> = (0..random.u32(1..12))
            .map(|number| {
                let from = at + random.i32(0..5);
                at = from + random.i32(1..6);
                (f64::from(from), f64::from(at - 1), format!("text {number}"))
            })
            .collect();
        let texts = |ranges| Conversion::Texts(Texts { ranges, default: Some("default".to_owned()) });
        all.push((texts(ranges.clone()), "ranges", json!(ranges)));
        let single: Vec<_> = ranges.into_iter().map(|(from, _, text)| (from, from, text)).collect();
        all.push((texts(single.clone()), "texts", json!(single)));
    }
    all
}

#[test]
fn numbers_stand_for_the_same_values_and_texts() {
    let Some(python) = peers::python_with("numpy, pya2l.functions") else { return };
    let mut random = fastrand::Rng::with_seed(161);
    let conversions = conversions(&mut random);
    let numbers: Vec<i32> = (1..60).chain([255, 32_767, 65_535, 1_000_000]).collect();
    let asked: Vec<_> = conversions
        .iter()
        .map(|(_, kind, parameters)| json!({ "kind": kind, "parameters": parameters, "numbers": numbers }))
        .collect();
    let mut peer =
        Command::new(python).arg(SCRIPT).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    peer.stdin.take().unwrap().write_all(json!(asked).to_string().as_bytes()).unwrap();
    let output = peer.wait_with_output().unwrap();
    assert!(output.status.success());
    let results: Vec<Vec<Value>> = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(results.len(), conversions.len());
    for ((conversion, _, parameters), theirs) in conversions.iter().zip(results) {
        for (number, theirs) in numbers.iter().zip(theirs) {
            match conversion.meaning(f64::from(*number)) {
                Meaning::Text(ours) => assert_eq!(theirs, ours, "{parameters} {number}"),
                Meaning::Value(ours) => {
                    let theirs = theirs.as_f64().unwrap();
                    let error = (ours - theirs).abs() / theirs.abs().max(1.0);
                    assert!(error < 1e-9, "{parameters} {number}: {ours}, not {theirs}");
                }
                Meaning::Nothing => panic!("{parameters} {number} stands for {theirs}"),
            }
        }
    }
}
