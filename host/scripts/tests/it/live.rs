//! Scripts on the virtual device, as on a board.

use std::cell::Cell;
use std::time::Duration;

use cantap::{Channel, Device, TraceEvent, TraceRecord};
use cantap_scripts::{Live, Message, Outcome, Report, Script};

use super::{decoder, failure, script};

fn device(options: &str) -> Device {
    let device = cantap_virtual::open(options.parse().unwrap()).unwrap();
    device.join(Channel::Can1, 500_000).unwrap();
    device
}

fn run(device: &Device, scripts: &[Script], duration: Option<Duration>) -> Report {
    let live = Live { decoder: decoder(), seed: 1, readable: None, duration };
    live.run(device, scripts, &mut |_| {}, &mut |_| {}, None, &mut || true).unwrap()
}

#[test]
fn a_test_of_the_vehicle_passes_as_on_the_bench() {
    let source = r#"
        fn test_vin() {
            let answer = request("7E0", "7E8", [0x22, 0xF1, 0x90]);
            check(answer.len() == 20, "17 characters");
        }
    "#;
    let report = run(&device("car"), &[script("tester", source)], None);
    assert!(report.is_success() && report.tests.len() == 1, "{report:?}");
    assert_eq!(report.frames_lost, 0);
}

#[test]
fn two_scripts_on_one_device_hear_each_other_and_repetitions_end_with_the_run() {
    let device = device("load=0");
    let server = script("server", r#"on_frame("123", |f| send(frame(0x124, f.data)));"#);
    let tester = script(
        "tester",
        r#"
        fn test_echo() {
            let p = periodic("200#01", "5ms");
            send("123#4142");
            check(expect("124", "1s").data == blob_of([0x41, 0x42]), "the same data");
        }
        fn blob_of(values) { let b = blob(); for value in values { b.push(value); } b }
        "#,
    );
    let report = run(&device, &[server, tester], Some(Duration::from_secs(20)));
    assert!(report.is_success(), "{report:?}");
    assert_eq!(report.frames_not_sent, 0);
    // Nothing is sent any more: what the device still confirms is nothing.
    let before = device.status().unwrap().channels[0];
    let again = run(&device, &[script("idle", "wait(\"60ms\");")], None);
    let after = device.status().unwrap().channels[0];
    assert!(again.is_success());
    assert_eq!(before.transmitted, after.transmitted);
}

#[test]
fn a_device_that_vanishes_is_an_error_and_not_a_hang() {
    let device = device("load=0");
    let source =
        r#"every("1ms", || send("100#")); fn test_a() { log("a"); } fn test_b() { log("b"); wait("1h"); }"#;
    let is_in_b = Cell::new(false);
    let mut turns = 0;
    let live = Live { decoder: decoder(), seed: 1, readable: None, duration: None };
    let mut on_message = |message: Message| is_in_b.set(is_in_b.get() || message.text == "b");
    let broken = live.run(&device, &[script("a", source)], &mut |_| {}, &mut on_message, None, &mut || {
        turns += u32::from(is_in_b.get());
        if turns == 20 {
            let _ = device.reset();
        }
        true
    });
    // What was found out until then is not lost, and what was not has not passed.
    let report = broken.unwrap_err().report;
    let passed: Vec<bool> = report.tests.iter().map(|test| test.outcome == Outcome::Passed).collect();
    assert_eq!(passed, [true, false], "{report:?}");
}

#[test]
fn what_cannot_be_sent_is_in_the_report() {
    let device = device("load=0,ack=no");
    let report = run(&device, &[script("a", "send(\"100#\"); wait(\"50ms\");")], None);
    assert_eq!((report.frames_sent, report.frames_not_sent), (0, 1), "{report:?}");
    let report = run(&device, &[script("a", "fail(\"no\");")], None);
    assert_eq!(failure(&report), "line 1: no");
}

/// A device keeps periods from 47 us to 2^32 ticks; it must neither end the run over others, nor keep another one in their place.
#[test]
fn a_period_that_the_device_does_not_keep_comes_from_here() {
    let device = device("load=0");
    for (period, once) in [("1us", false), ("10d", true)] {
        let source = format!("periodic(\"100#01\", \"{period}\"); wait(\"100ms\");");
        let report = run(&device, &[script("a", &source)], Some(Duration::from_millis(300)));
        assert!(report.is_success() && report.frames_repeated == 0, "{report:?}");
        assert_eq!((report.frames_sent > 0, report.frames_sent == 1), (true, once), "{report:?}");
    }
}

#[test]
fn a_script_does_not_hear_itself_and_a_node_keeps_its_address() {
    let device = device("load=0");
    let alone = script(
        "alone",
        r#"on_frame(|f| fail("heard " + f)); send("123#01"); periodic("124#02", "5ms"); wait("60ms");"#,
    );
    let report = run(&device, &[alone], Some(Duration::from_millis(200)));
    assert!(report.is_success() && report.frames_received == 0 && report.frames_sent > 5, "{report:?}");
    let node = script(
        "node",
        r#"let ecu = j1939(35, #{ identity: 1, arbitrary_address_capable: true }); wait("100ms"); check(ecu.address == 35, "35");"#,
    );
    let report = run(&device, &[node], Some(Duration::from_secs(5)));
    assert!(report.is_success(), "{report:?}");
    assert_eq!((report.frames_sent, report.frames_received), (1, 0), "{report:?}");
}

/// A device with other nodes on its bus that send these frames on channel 1 at these times, in milliseconds.
fn device_with(frames: &[(u64, &str)]) -> Device {
    let mut options: cantap_virtual::Options = "load=0".parse().unwrap();
    let entries = frames.iter().map(|(at_ms, frame)| (at_ms * 1_000_000, frame.parse().unwrap()));
    options.log = Some([entries.collect(), Vec::new()]);
    let device = cantap_virtual::open(options).unwrap();
    device.join(Channel::Can1, 500_000).unwrap();
    device
}

/// As a device's own replies: within microseconds, and none is left when the function, or the run, has ended.
#[test]
fn a_constant_reply_of_a_script_that_is_alone_is_the_device_s_own() {
    let asked: Vec<(u64, &str)> = (1..=20).map(|n| (n * 100, "7E0#0101")).collect();
    let device = device_with(&asked);
    let source = r#"
        let n = 0;
        let reply = on_frame("7E0", |f| send("7E8#01"));
        on_frame("7E0", |f| { n += 1; if n == 5 { stop(reply); } });
        on_frame("7E0", |f| send(frame("6E8", [n])));
    "#;
    let live =
        Live { decoder: decoder(), seed: 1, readable: None, duration: Some(Duration::from_millis(1500)) };
    let mut records = Vec::<TraceRecord>::new();
    let report = live
        .run(
            &device,
            &[script("a", source)],
            &mut |record| records.push(record),
            &mut |_| {},
            None,
            &mut || true,
        )
        .unwrap();
    assert!(report.is_success(), "{report:?}");
    let ends = |text: &str| -> Vec<u64> {
        let of =
            records.iter().filter(|record| record.frame().is_some_and(|frame| frame.to_string() == text));
        of.map(|record| record.device_ns.unwrap().get()).collect()
    };
    let (asked, replied) = (ends("7E0#0101"), ends("7E8#01"));
    assert!((5..=10).contains(&replied.len()) && asked.len() > replied.len(), "{asked:?} {replied:?}");
    assert_eq!(report.frames_repeated, replied.len() as u64);
    assert!(report.frames_sent > report.frames_repeated, "{report:?}");
    for replied in &replied {
        let asked = asked.iter().rfind(|asked| *asked < replied).unwrap();
        // Three bits of pause, and the reply's 58 with its stuff bits.
        assert!((100_000..140_000).contains(&(replied - asked)), "{asked} {replied}");
    }
    let again = run(&device, &[script("idle", "wait(\"500ms\");")], None);
    assert_eq!((again.frames_sent, again.frames_received > 0), (0, true), "{again:?}");
    // A script that ends with an error leaves none either, nor does one of two have any: a device does not answer itself.
    let fails = "on_frame(\"7E0\", |f| send(\"7E8#01\")); wait(\"1ms\"); fail(\"no\");";
    let after = "wait(\"300ms\");";
    let device = device_with(&[(400, "7E0#"), (500, "7E0#"), (600, "7E0#")]);
    let report = run(&device, &[script("a", fails)], None);
    assert_eq!(failure(&report), "line 1: no");
    let before = device.status().unwrap().channels[0].transmitted;
    run(&device, &[script("idle", after), script("idle 2", after)], None);
    assert_eq!(device.status().unwrap().channels[0].transmitted, before);
}

/// By the computer's clock, a second of this device is 0.5 ms shorter.
#[test]
fn the_times_of_a_run_are_those_of_the_device_s_clock() {
    let device = device("load=0,ppm=500");
    let sender = script("sender", "periodic(\"100#01\", \"50ms\");");
    let listener = script(
        "listener",
        r#"
        fn test_times() {
            let begins = [];
            let least = 1000.0;
            for n in 0..41 {
                let f = expect("100", "5s");
                check(now() > f.time - 0.001, `it came at ${now()}, before it was there at ${f.time}`);
                let begin = f.time - n * 0.05;
                begins.push(begin);
                if begin < least { least = begin; }
            }
            // A frame is late where the computer stood still, and never early.
            let in_time = begins.filter(|begin| begin - least < 0.000005).len();
            check(in_time > 20, `${in_time} frames are where they should be: ${begins}`);
        }
        "#,
    );
    let report = run(&device, &[sender, listener], Some(Duration::from_mins(1)));
    assert!(report.is_success(), "{report:?}");
}

#[test]
fn nothing_goes_wrong_on_purpose_on_a_device() {
    let device = device("load=0");
    for call in ["power_off(\"a\")", "error_burst(\"1ms\")", "lose(3)", "stall(\"1ms\")", "bus_off(\"a\")"] {
        let report = run(&device, &[script("a", &format!("{call};"))], None);
        assert!(failure(&report).contains("only on simulated buses"), "{call}: {report:?}");
    }
}

/// A listener beside a script that sends and traffic of other nodes: what it hears is what the trace has, in its order, with its times.
#[test]
fn a_script_hears_the_frames_of_the_trace_in_their_order_and_with_their_stamps() {
    let device = device("load=20");
    let sender = script("sender", r#"periodic("7F0#01", "3ms"); every("2ms", || send("7F1#02"));"#);
    let listener = script("listener", r#"on_frame(|f| log(f.to_string() + " " + f.time));"#);
    let live = Live { decoder: decoder(), seed: 1, readable: None, duration: Some(Duration::from_secs(1)) };
    let (mut records, mut heard) = (Vec::<TraceRecord>::new(), Vec::new());
    let report = live
        .run(
            &device,
            &[sender, listener],
            &mut |record| records.push(record),
            &mut |message| heard.push(message.text),
            None,
            &mut || true,
        )
        .unwrap();
    assert!(report.is_success(), "{report:?}");
    let frames: Vec<(u64, String)> = records
        .iter()
        .filter_map(|record| match record.event {
            TraceEvent::Frame { frame, .. } => Some((record.device_ns.unwrap().get(), frame.to_string())),
            _ => None,
        })
        .collect();
    let heard: Vec<(f64, &str)> = heard
        .iter()
        .map(|line| line.split_once(' ').unwrap())
        .map(|(frame, time)| (time.parse().unwrap(), frame))
        .collect();
    // The trace also has what came before the run.
    let begins =
        |at: &usize| frames[*at..].iter().zip(&heard[..20]).all(|((_, frame), (_, heard))| frame == heard);
    let first = (0..frames.len()).find(begins).unwrap();
    let frames = &frames[first..];
    let out_of_place = heard.iter().zip(frames).filter(|((_, heard), (_, frame))| heard != frame).count();
    // What the device had received before the run is at the run's beginning.
    let before = heard.iter().take_while(|(time, _)| *time == 0.0).count();
    assert!(before + 100 < heard.len(), "{before} of {} were before the run", heard.len());
    let error = |((time, _), (time_ns, _)): (&(f64, &str), &(u64, String))| {
        (time - heard[before].0 - (*time_ns as f64 - frames[before].0 as f64) / 1e9).abs()
    };
    let worst = heard.iter().zip(frames).skip(before).map(error).fold(0.0, f64::max);
    println!(
        "{} heard, {} in the trace, {out_of_place} out of place, {worst} s off",
        heard.len(),
        frames.len()
    );
    // A busy computer begins late.
    assert!(heard.len() > 100 && frames.len() - heard.len() < 20, "{} of {}", heard.len(), frames.len());
    assert_eq!(out_of_place, 0);
    assert!(worst < 2e-9, "{worst} s");
}
