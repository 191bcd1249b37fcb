//! What is said of a statement is what happens.

use std::time::Duration;

use cantap::Channel;
use cantap_scripts::{DeviceReplies, Explained, Live, Report, Runner, Target, TimedBy};

use super::{decoder, script};

const BOARD: Target =
    Target::Device { clock: TimedBy::Board, periodic_slots: 32, transmits: true, replies: None };

fn explain(source: &str, target: Target) -> Vec<Explained> {
    script("a.rhai", source).explain(target).unwrap()
}

fn runners(source: &str, target: Target) -> Vec<(usize, String, Runner)> {
    let explained = explain(source, target).into_iter();
    explained.map(|one| (one.line, one.function, one.placement.runner)).collect()
}

/// Runs a script on the virtual device, beside one to which it answers, and returns what was said of it and how it went.
fn both(source: &str) -> (Vec<Explained>, Report) {
    let device = cantap_virtual::open("load=0".parse().unwrap()).unwrap();
    device.join(Channel::Can1, 500_000).unwrap();
    let said = explain(source, Target::of(device.hello()));
    let asker =
        script("asker", r#"wait("20ms"); send("7E0#023E00"); send("18EA00F9#00EE00"); wait("300ms");"#);
    let live = Live { decoder: decoder(), seed: 1, readable: None, duration: Some(Duration::from_secs(5)) };
    let scripts = [script("a.rhai", source), asker];
    let before = live.run(&device, &scripts[1..], &mut |_| {}, &mut |_| {}, None, &mut || true).unwrap();
    let mut report = live.run(&device, &scripts, &mut |_| {}, &mut |_| {}, None, &mut || true).unwrap();
    assert!(report.is_success(), "{report:?}");
    report.frames_sent -= before.frames_sent;
    (said, report)
}

#[test]
fn each_statement_that_sends_sends_from_where_it_says() {
    let ends = "\nafter(\"250ms\", || stop(p));";
    for (source, function) in [
        (r#"send("123#01");"#.to_owned(), "send"),
        (r#"after("10ms", || send("123#01"));"#.to_owned(), "after"),
        (r#"let h = (); h = every("10ms", || send("123#01")); wait("100ms"); stop(h);"#.to_owned(), "every"),
        (format!(r#"let p = periodic("123#01", "10ms");{ends}"#), "periodic"),
        (format!(r#"let p = periodic("123#01", "10ms"); change(p, frame("123#02"));{ends}"#), "change"),
        (r#"let h = on_frame("7E0", |f| send("123#01")); wait("250ms"); stop(h);"#.to_owned(), "on_frame"),
        (r#"on_request("7E0", "7E8", |data| [0x7E, 0]); wait("250ms");"#.to_owned(), "on_request"),
        (r#"let ecu = j1939(0, #{ identity: 1 }); wait("250ms");"#.to_owned(), "j1939"),
        (r#"let ecu = j1939(0, #{ identity: 1 }); wait("250ms"); ecu.send(65280, [1]);"#.to_owned(), "send"),
    ] {
        let (said, report) = both(&source);
        let said = said.iter().find(|one| one.function == function).unwrap();
        assert!(report.frames_sent > 0, "{source} {report:?}");
        let by_device = report.frames_repeated == report.frames_sent;
        assert!(by_device || report.frames_repeated == 0, "{source} {report:?}");
        let ran = if by_device { Runner::Device } else { Runner::Host };
        assert_eq!(said.placement.runner, ran, "{source} {said:?} {report:?}");
    }
}

#[test]
fn more_repeated_frames_than_the_device_takes_come_from_here() {
    let source = r#"for id in 0..40 { periodic(frame(0x100 + id, [id]), "50ms"); }"#;
    let device = cantap_virtual::open("load=0".parse().unwrap()).unwrap();
    device.join(Channel::Can1, 500_000).unwrap();
    let slots = device.hello().periodic_slots;
    let said = explain(source, Target::of(device.hello()));
    assert_eq!((said.len(), said[0].placement.runner), (1, Runner::Device));
    assert!(
        said[0]
            .placement
            .accuracy
            .ends_with(&format!("; {slots} at once on each channel, more from the host"))
    );
    let live = Live { decoder: decoder(), seed: 1, readable: None, duration: Some(Duration::from_secs(1)) };
    let mut ids = std::collections::BTreeMap::<u32, u32>::new();
    let mut count = |record: cantap::TraceRecord| {
        if let Some(frame) = record.frame() {
            *ids.entry(frame.id().raw()).or_default() += 1;
        }
    };
    let report =
        live.run(&device, &[script("a", source)], &mut count, &mut |_| {}, None, &mut || true).unwrap();
    assert!(report.is_success() && report.frames_not_sent == 0, "{report:?}");
    assert_eq!(ids.len(), 40);
    let count = |ids: Vec<u32>| ids.into_iter().map(u64::from).sum::<u64>();
    let by_device = count(ids.range(..0x100 + u32::from(slots)).map(|(_, count)| *count).collect());
    let by_host = count(ids.range(0x100 + u32::from(slots)..).map(|(_, count)| *count).collect());
    // At the end, confirmations may come whose records are not waited for.
    assert!((1..=report.frames_repeated).contains(&by_device), "{by_device} {report:?}");
    assert!((1..=report.frames_sent - report.frames_repeated).contains(&by_host), "{by_host} {report:?}");
    // Until the run ends: a host's are sent as often as a device's, as far as it has its turns.
    assert!(ids.values().all(|count| *count >= 2), "{ids:?}");
}

#[test]
fn statements_are_found_where_they_stand_and_by_whom_they_are_called() {
    let source = "
let n = 1;
on_frame(\"7DF\", |f| {
    if f.data[0] > n { answer(); send(\"7E8#00\"); }
});
every(\"10ms\", || change(p, frame(\"1#\")));
let p = periodic(\"100#00\", \"10ms\");
let ecu = j1939(0, #{ identity: 1 });
fn answer() { send(\"7E9#00\"); }
fn test_it() { request(\"7E0\", \"7E8\", [1]); log(1); expect(\"7E8\", \"1s\"); }
";
    let found: Vec<_> = explain(source, BOARD)
        .into_iter()
        .map(|one| (one.line, one.function, one.within.map(|(of, line)| format!("{of} {line}"))))
        .collect();
    let row = |line: usize, function: &str, within: Option<&str>| {
        (line, function.to_owned(), within.map(str::to_owned))
    };
    assert_eq!(
        found,
        [
            row(3, "on_frame", None),
            row(4, "send", Some("on_frame 3")),
            row(6, "every", None),
            row(6, "change", Some("every 6")),
            row(7, "periodic", None),
            row(8, "j1939", None),
            row(9, "send", None),
            row(10, "request", None),
        ]
    );
}

#[test]
fn constant_replies_of_a_script_that_is_alone_are_the_device_s() {
    let alone = |slots: u8| Target::Device {
        clock: TimedBy::Board,
        periodic_slots: 32,
        transmits: true,
        replies: Some(DeviceReplies { channel: Channel::Can1, slots }),
    };
    let source = "
on_frame(\"7E0\", |f| send(\"7E8#01\"));
on_frame(\"7E0\", |f| send(2, \"7E8#01\"));
on_frame(\"001-7FE\", |f| { send(\"7E8#01\"); });
on_frame(|f| send(1, \"7E8#01\"));
on_frame(\"7E0\", |f| send(frame(0x7E8, f.data)));
";
    let (device, host) = (Runner::Device, Runner::Host);
    let found = |target| -> Vec<Runner> {
        runners(source, target).into_iter().map(|(_, _, runner)| runner).collect()
    };
    // Each function, and what stands in it.
    assert_eq!(found(alone(8)), [device, device, host, host, host, host, device, device, host, host]);
    assert_eq!(found(alone(1))[6], host, "two lengths of identifiers are two replies");
    assert!(found(BOARD).iter().all(|runner| *runner == host));
    let said = &explain(source, alone(8))[0].placement.accuracy;
    assert!(said.starts_with("replies by itself, within 14 us"), "{said}");
}

#[test]
fn a_device_that_sends_nothing_and_simulated_buses_are_said_to_be_such() {
    let mute =
        Target::Device { clock: TimedBy::Computer, periodic_slots: 0, transmits: false, replies: None };
    let source = "periodic(\"1#\", \"1s\"); send(\"1#\");";
    let all = |runner| vec![(1, "periodic".to_owned(), runner), (1, "send".to_owned(), runner)];
    assert_eq!(runners(source, mute), all(Runner::Nothing));
    assert_eq!(runners(source, Target::Simulation), all(Runner::Simulation));
    assert!(explain(source, BOARD)[0].placement.accuracy.starts_with("its timer, to 2 us"));
    assert!(script("a", "send(").explain(BOARD).is_err());
}
