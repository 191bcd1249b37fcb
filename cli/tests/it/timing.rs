//! `cantap timing` as users run it.

use std::process::{Command, Output};

fn timing(arguments: &[&str]) -> (Option<i32>, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_cantap")).arg("timing").args(arguments).output();
    let Output { status, stdout, stderr } = output.unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

#[test]
fn the_whole_table_of_a_small_clock_is_as_documented() {
    let (code, out, err) = timing(&["-b", "1M", "--clock", "8M"]);
    assert_eq!((code, err.as_str()), (Some(0), ""));
    assert_eq!(
        out,
        "  BRP PROP+PS1 PS2  sample  quanta  quantum ns  SJW      error ppm  tolerance  cable\n    \
         1        6   1  87.5 %       8       125.0  1..1 (1)      0.0    0.485 %   32 m\n*   \
         1        5   2  75.0 %       8       125.0  1..2 (1)      0.0    0.490 %   20 m\n    \
         1        4   3  62.5 %       8       125.0  1..3 (1)      0.0    0.495 %    8 m\n    \
         1        3   4  50.0 %       8       125.0  1..4 (1)      0.0    0.500 %    0 m\n    \
         1        2   5  37.5 %       8       125.0  1..4 (1)      0.0    0.505 %    0 m\n    \
         1        1   6  25.0 %       8       125.0  1..4 (1)      0.0    0.510 %    0 m\n    \
         2        2   1  75.0 %       4       250.0  1..1 (1)      0.0    0.980 %    0 m\n    \
         2        1   2  50.0 %       4       250.0  1..2 (1)      0.0    1.000 %    0 m\n\n\
         * chosen: --segments 1,5,2,1 or --btr 0x00140000, 8 quanta of 125.0 ns at 8000000 Hz\n\n\
         |SY|PR|PR|PR|PR|P1|P2|P2|\n                  ^ sample point 75.0 %\n\
         SY synchronisation, PR propagation, P1 P2 phase segments\n\n\
         tolerance: of each node's clock, the smaller of min(PS1,PS2)/(2(13 tbit - PS2)) and SJW/(20 tbit)\n\
         cable: (PROP/2 - 150 ns for a node, in and out) / 5 ns/m\n"
    );
}

#[test]
fn json_has_every_timing_and_the_chosen_one() {
    let (code, out, _) = timing(&["-b", "83.333k", "--json"]);
    assert_eq!(code, Some(0));
    let object: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!((&object["bitrate_bps"], &object["clock_hz"]), (&83_333.into(), &36_000_000.into()));
    let timings = object["timings"].as_array().unwrap();
    let chosen: Vec<_> = timings.iter().filter(|timing| timing["chosen"] == true).collect();
    assert_eq!(chosen, [&object["chosen"]]);
    assert!((chosen[0]["error_ppm"].as_f64().unwrap() - 4.0).abs() < 0.01, "{chosen:?}");
    assert_eq!(chosen[0]["sample_point_pct"], 87.5);
}

#[test]
fn impossible_wishes_are_one_line_that_says_what_is_possible() {
    let (code, out, err) = timing(&["-b", "999999"]);
    assert_eq!((code, out.as_str(), err.lines().count()), (Some(1), "", 1));
    assert!(err.contains("947368") && err.contains("1000000"), "{err}");
    let (code, _, err) = timing(&["-b", "500k", "--triple"]);
    assert!(code == Some(1) && err.contains("samples each bit once"), "{err}");
    let (code, _, err) = timing(&["-b", "fast"]);
    assert!(code == Some(2) && err.contains("500k"), "{err}");
}

#[test]
fn a_clock_that_reaches_nothing_is_told_in_a_sentence() {
    for clock in ["1", "100"] {
        let (code, out, err) = timing(&["-b", "500k", "--clock", clock]);
        assert_eq!((code, out.as_str()), (Some(1), ""));
        assert_eq!(
            err,
            "cantap: the clock cannot be divided to 500000 bit/s, nor to any other rate from 5000 to 1000000; a CAN \
             controller's clock has some MHz\n"
        );
    }
    for clock in ["0", "4294967295", "fast"] {
        let (code, _, err) = timing(&["-b", "500k", "--clock", clock]);
        assert!(code == Some(2) && err.contains("write the clock of the CAN controller in Hz"), "{err}");
    }
    assert_eq!(timing(&["-b", "500k", "--clock", "1000M"]).0, Some(0));
}
