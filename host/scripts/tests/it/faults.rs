//! What goes wrong on simulated buses on purpose.

use cantap_can::LossStage;
use cantap_scripts::{Bench, ScriptError};
use cantap_trace::{TraceEvent, TraceRecord};

use super::{bench, failure, run, run_on, script};

const MS: i64 = 1_000_000;

fn texts(lines: &[String]) -> Vec<&str> {
    lines.iter().map(|line| line.split_once(": ").unwrap().1).collect()
}

/// Frames in a trace, and those of which it says that they are lost, by stage.
fn count(records: &[TraceRecord]) -> (u64, Vec<(LossStage, u64)>) {
    let mut lost: Vec<(LossStage, u64)> = Vec::new();
    for record in records {
        if let TraceEvent::Lost { stage: Some(stage), count, at_least: false } = record.event {
            match lost.iter_mut().find(|(of, _)| *of == stage) {
                Some((_, sum)) => *sum += u64::from(count),
                None => lost.push((stage, u64::from(count))),
            }
        }
    }
    (records.iter().filter(|record| record.frame().is_some()).count() as u64, lost)
}

/// A node, and one that says for how long it has not heard of it.
const ENGINE: &str = r#"send("700#00"); periodic("100#00", "10ms");"#;
const DASH: &str = r#"
    let last = 0.0;
    let warns = false;
    on_frame("100", |f| { last = now(); if warns { warns = false; send("3A0#00"); } });
    every("10ms", || if !warns && now() - last > 0.3 { warns = true; send("3A0#01"); });
"#;

#[test]
fn a_node_without_power_is_silent_and_begins_anew_with_it() {
    let tester = r#"
        fn test_the_dash_warns() {
            wait("2s");
            power_off("engine");
            wait("1ms");
            check(wait_for("100", "200ms") == (), "the engine is silent");
            expect("3A0", "300ms", |f| f.data[0] == 1);
            power_on("engine");
            expect("700", "2ms");
            expect("3A0", "20ms", |f| f.data[0] == 0);
        }
    "#;
    let scripts = [script("node/engine.rhai", ENGINE), script("dash.rhai", DASH), script("t", tester)];
    let first = run(10, &scripts);
    assert!(first.0.is_success(), "{:?}", first.0);
    assert_eq!(run(10, &scripts), first);
    // The same as a setting of the bus.
    let planned = "fn test_a() { wait(\"2s\"); expect(\"3A0\", \"500ms\"); expect(\"700\", \"600ms\"); }";
    let scripts = [script("engine", ENGINE), script("dash", DASH), script("t", planned)];
    let (report, records, _) = run_on(&bench("power_off=engine@2s+500ms", 10), &scripts);
    assert!(report.is_success(), "{report:?}");
    let boots: Vec<i64> = records
        .iter()
        .filter(|record| record.frame().is_some_and(|frame| frame.to_string().starts_with("700")))
        .map(|record| record.time_ns / MS)
        .collect();
    assert_eq!(boots, [0, 2500]);
}

#[test]
fn a_node_whose_frames_are_destroyed_goes_through_all_states_and_recovers() {
    let engine = r#"
        on_state(|channel, state| log(`${channel} ${state}`));
        let errors = 0;
        on_error(|channel, kind| errors += 1);
        periodic("100#00", "10ms");
        after("500ms", || log(errors));
    "#;
    let other = "on_state(|c, s| log(s)); after(\"95ms\", || bus_off(\"engine\"));";
    let scripts = [script("engine", engine), script("other", other)];
    let (report, records, lines) = run(1, &scripts);
    assert!(report.is_success(), "{report:?}");
    assert_eq!(texts(&lines), ["1 warning", "1 passive", "1 bus-off", "1 active", "32"]);
    let at = |place: usize| lines[place].split_once(' ').unwrap().0.parse::<u64>().unwrap();
    // 128 times eleven bits.
    assert_eq!(at(3) - at(2), 1408 * 2000);
    let errors = records.iter().filter(|record| matches!(record.event, TraceEvent::BusError { .. }));
    let times: Vec<i64> = errors.map(|record| record.time_ns).collect();
    assert!(times.len() == 32 && times[0] > 100 * MS && times[31] as u64 == at(2), "{times:?}");
    let sent = records.iter().filter(|record| record.frame().is_some()).map(|record| record.time_ns);
    let late: Vec<i64> = sent.filter(|at_ns| (100 * MS..109 * MS).contains(at_ns)).collect();
    assert!(late.len() == 1 && late[0] as u64 > at(3), "{late:?}");
    assert_eq!(run(1, &scripts), (report, records, lines));
}

/// As many as the option for a device on such a bus destroys.
#[test]
fn a_script_whose_first_frames_are_destroyed_is_bus_off_after_thirty_two() {
    let source = "on_state(|c, s| log(s)); send(\"123#\");";
    let (report, records, lines) = run_on(&bench("load=0,disturb=32", 1), &[script("a", source)]);
    assert_eq!(texts(&lines), ["warning", "passive", "bus-off", "active"]);
    assert_eq!((report.frames_sent, count(&records).0), (1, 1));
    let (_, _, lines) = run_on(&bench("load=0,disturb=31", 1), &[script("a", source)]);
    // 248 errors less one for the frame that was sent.
    assert_eq!(texts(&lines), ["warning", "passive"]);
}

#[test]
fn an_error_burst_destroys_everything_on_its_channel_and_nothing_after_it() {
    let sends = "every(\"1ms\", || { send(\"100#\"); send(2, \"200#\"); }); on_error(|c, k| log(c));";
    let source = format!("{sends} after(\"100ms\", || error_burst(2, \"10ms\"));");
    let by_function = run(1, &[script("a", &source)]);
    let by_option = run_on(&bench("error_burst=2@100ms+10ms", 1), &[script("a", sends)]);
    for (report, records, lines) in [by_function, by_option] {
        assert!(report.is_success(), "{report:?}");
        assert!(lines.len() > 10 && lines.iter().all(|line| line.ends_with(": 2")), "{lines:?}");
        let within = |channel: u8| {
            let of =
                records.iter().filter(move |record| record.channel == channel && record.frame().is_some());
            of.filter(|record| (100 * MS..110 * MS).contains(&record.time_ns)).count()
        };
        assert_eq!((within(1), within(2)), (10, 0));
        // What was not sent then is sent after it, but for what the run's end left.
        assert!(report.frames_not_sent <= 2, "{report:?}");
    }
    // Others' frames too.
    let (_, records, _) =
        run_on(&bench("load=50,error_burst=100ms+10ms", 1), &[script("a", "wait(\"1s\");")]);
    let until = |channel: u8, from: i64, to: i64| {
        records
            .iter()
            .filter(|record| record.channel == channel && record.frame().is_some())
            .filter(|record| (from * MS..to * MS).contains(&record.time_ns))
            .count()
    };
    assert!(until(1, 101, 110) == 0 && until(2, 101, 110) > 5 && until(1, 110, 120) > 5);
}

/// Frames on the bus are those delivered and those counted as lost.
#[test]
fn frames_that_a_host_loses_are_counted_by_stage() {
    let dash = "let n = 0; on_frame(|f| n += 1); after(\"4s\", || log(n));";
    let run_with = |bus: &str| run_on(&bench(bus, 5), &[script("dash", dash), script("other", dash)]);
    let seen =
        |lines: &[String]| -> Vec<u64> { texts(lines).iter().map(|text| text.parse().unwrap()).collect() };
    let (_, all, lines) = run_with("load=30");
    let (all, before) = (count(&all).0, seen(&lines));
    assert_eq!(before[0], before[1]);
    // For all: the trace, and both scripts.
    let (report, records, lines) = run_with("load=30,lose=1s*3,lose=2s+50ms");
    let (left, lost) = count(&records);
    let [(LossStage::Host, lost)] = lost[..] else { panic!("{lost:?}") };
    assert!(lost > 3 && left + lost == all, "{left} {lost} {all}");
    assert_eq!(report.frames_lost, 2 * lost);
    assert_eq!(seen(&lines), [before[0] - lost, before[0] - lost]);
    // For one.
    let (report, records, lines) = run_with("load=30,lose=dash@1s*3");
    assert_eq!((count(&records), report.frames_lost), ((all, Vec::new()), 3));
    assert_eq!(seen(&lines), [before[0] - 3, before[0]]);
    // A host that stalls loses what its device does not keep for it.
    let (report, records, _) = run_with("load=100,frames=std0,channels=1");
    assert_eq!(report.frames_lost, 0);
    let all = count(&records).0;
    let (report, records, _) = run_with("load=100,frames=std0,channels=1,stall=1s+1s");
    let (left, lost) = count(&records);
    let [(LossStage::Queue, lost)] = lost[..] else { panic!("{lost:?}") };
    assert!(lost > 5000 && left + lost == all, "{left} {lost} {all}");
    assert_eq!(report.frames_lost, 2 * lost);
    let times: Vec<i64> = records.iter().map(|record| record.time_ns).collect();
    assert!(times.is_sorted());
}

#[test]
fn a_host_that_stalls_is_late_and_its_device_goes_on_repeating() {
    let dash = r#"
        periodic("200#", "10ms");
        on_frame("100", |f| if now() - f.time > 0.001 { log(`late ${f.time}`); });
        every("10ms", || log("timer"));
    "#;
    let engine = "periodic(\"100#00\", \"50ms\"); after(\"100ms\", || stall(\"dash\", \"95ms\"));";
    let scripts = [script("dash", dash), script("engine", engine)];
    let (report, records, lines) = run(1, &scripts);
    assert!(report.is_success(), "{report:?}");
    let of = |text: &str, from: u64, to: u64| {
        let times = lines.iter().filter(|line| line.contains(text));
        let times = times.map(|line| line.split_once(' ').unwrap().0.parse::<u64>().unwrap() / MS as u64);
        times.filter(|at| (from..to).contains(at)).count()
    };
    // Its timers fell due nine times meanwhile, and are made up for, as everything that waited.
    assert_eq!((of("timer", 101, 195), of("timer", 195, 196), of("timer", 0, 1000)), (0, 9, 99));
    assert_eq!((of("late", 0, 1000), of("late", 195, 196)), (2, 2));
    let repeated = records.iter().filter(|record| record.frame().is_some_and(|f| f.to_string() == "200#"));
    assert_eq!(repeated.filter(|record| (100 * MS..200 * MS).contains(&record.time_ns)).count(), 10);
    assert_eq!(report.frames_lost, 0);
    assert_eq!(run(1, &scripts), (report, records, lines));
}

#[test]
fn a_request_that_may_have_missed_a_frame_fails_and_says_so() {
    let source = r#"
        fn test_vin() { wait("100ms"); lose("tester", 1); request("7E0", "7E8", [0x22, 0xF1, 0x90]); }
    "#;
    let (report, _, _) = run_on(&bench("car,channels=1", 60), &[script("tester", source)]);
    assert!(!report.is_success() && report.frames_lost == 1, "{report:?}");
}

#[test]
fn who_is_not_there_or_tests_is_refused() {
    let on = |options: &str| -> Bench { bench(options, 1) };
    let quiet = script("a", "wait(\"1s\");");
    let refused = |bench: Bench| {
        bench.run(std::slice::from_ref(&quiet), &mut |_| {}, &mut |_| {}, &mut || true).unwrap_err()
    };
    let reason = "there is no node engine; there are a".to_owned();
    assert_eq!(refused(on("power_off=engine@1s")), ScriptError::Fault { reason });
    for (calls, reason) in [
        ("power_off(\"engine\");", "no node engine; there are a"),
        ("power_on(\"\");", "no node ; there are a"),
        ("stall(\"soon\");", "a number and a unit"),
        ("lose(-1);", "-1 frames"),
        ("error_burst(3, \"1ms\");", "no channel 3"),
        ("error_burst(\"0s\");", "longer than zero"),
    ] {
        let (report, _, _) = run(1, &[script("a", calls)]);
        assert!(failure(&report).contains(reason), "{calls}: {report:?}");
    }
    let (report, _, _) = run(1, &[script("a", "fn test_a() { power_off(\"a\"); }")]);
    assert!(failure(&report).contains("has tests"), "{report:?}");
}

/// An error before it is an error still, and what a node does to itself ends only itself.
#[test]
fn power_off_hides_no_error_and_is_repeatable_from_within() {
    let bad = script("bad", "wait(\"10ms\"); fail(\"gone\");");
    let (report, _, _) = run_on(&bench("power_off=bad@20ms+10ms", 1), &[bad, script("b", "wait(\"1s\");")]);
    assert_eq!(report.errors.len(), 2, "{report:?}");
    let own =
        "send(frame(0x100, [random(0, 255)])); wait(\"10ms\"); power_off(\"own\", \"10ms\"); wait(\"1s\");";
    let (report, records, _) = run(1, &[script("own", own)]);
    assert!(report.is_success(), "{report:?}");
    assert!((49..=51).contains(&records.len()), "{}", records.len());
    let different: std::collections::BTreeSet<String> =
        records.iter().map(|record| record.frame().unwrap().to_string()).collect();
    assert!(different.len() > 30, "each begins with other random numbers: {different:?}");
    assert_eq!(run(1, &[script("own", own)]).1, records);
    // Two that switch each other on and themselves off: time passes, and the run ends.
    let switches = |other: &str, own: &str| {
        script(own, &format!("power_on(\"{other}\"); power_off(\"{own}\", \"0s\"); wait(\"1s\");"))
    };
    let (report, _, _) = run(1, &[switches("b", "a"), switches("a", "b")]);
    assert!(report.is_success() && report.duration_ns == 1_000_000_000, "{report:?}");
}
