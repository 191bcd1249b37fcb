//! What such a chip does that it should not: stops, starts again, babbles, vanishes, answers late or twice.

use super::*;

#[test]
fn messages_about_the_bus_are_errors_and_gaps_and_no_frames() {
    let adapter = StandIn::start(Chip::Elm);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    adapter.says("7E8064100<DATA ERROR\r7E806<RX ERROR\r");
    for message in ["CAN ERROR", "UNABLE TO CONNECT", "STOPPED"] {
        adapter.ends(message);
        adapter.waits_for_monitoring();
    }
    // Without a reason.
    adapter.ends("");
    adapter.waits_for_monitoring();
    adapter.bus(&["7FF#"]);
    let records = until_frame(&device, "7FF#");
    assert_eq!(frames(&records), ["7FF#"]);
    let unknown = ("controller", 0, true);
    assert_eq!(gaps(&records), [("controller", 1, false), unknown, unknown, unknown, unknown]);
    let errors = |record: &TraceRecord| match record.event {
        TraceEvent::ErrorsSuppressed { count } => count,
        TraceEvent::BusError { kind: None | Some(BusErrorKind::Stuff), .. } => 1,
        _ => 0,
    };
    assert_eq!(records.iter().map(errors).sum::<u32>(), 3);
}

#[test]
fn one_that_has_started_again_ends_the_session_since_its_settings_are_gone() {
    for message in ["LV RESET", "ERR94", "ELM327 v2.2"] {
        let adapter = StandIn::start(Chip::Elm);
        let device = open(&adapter.address());
        device.listen(Channel::Can1, 500_000).unwrap();
        adapter.bus(&["100#"]);
        adapter.ends(message);
        let end = device.records().find_map(Result::err).unwrap();
        assert!(
            end.to_string().contains("started again") || matches!(end, DeviceError::Vanished { .. }),
            "{end}"
        );
        assert_eq!(device.counters().channels[0].received, 1);
    }
}

/// Each of them, on a serial port and behind a server.
fn everywhere(elm: Chip, stn: Chip) -> impl Iterator<Item = StandIn> {
    [StandIn::start(elm), StandIn::start_on_tcp(elm), StandIn::start(stn), StandIn::start_on_tcp(stn)]
        .into_iter()
}

#[test]
fn babbling_is_counted_and_costs_no_memory_and_no_silence() {
    for adapter in everywhere(Chip::Elm, Chip::Stn) {
        let address = adapter.address();
        let device = open(&address);
        device.listen(Channel::Can1, 500_000).unwrap();
        for _ in 0..256 {
            adapter.says(&"x".repeat(1024));
        }
        // Lengths and identifiers that lie, prompts without an end, and what pretends to be several things.
        adapter.says("\r800\r7E8F\r7E8064100BE3EA8130000\r\0\x07\r");
        for _ in 0..64 {
            adapter.says(&">".repeat(1024));
        }
        adapter.says(if address.starts_with("stn") { "\r7FF0\r" } else { "\r7FF\r" });
        let records = until_frame(&device, "7FF#");
        let link = losses(&records).iter().filter(|(stage, _)| *stage == "link").count();
        assert!((5..100).contains(&link), "{address}: {link}");
        assert!(gaps(&records).len() < 200);
        // Each prompt might be the answer to a command: it is told to go on no more often than it is looked at.
        assert!(device.failures().unwrap().last.contains("prompts"));
    }
}

#[test]
fn pulled_out_it_ends_with_a_reason_and_nothing_captured_is_lost() {
    for chip in [Chip::Elm, Chip::Stn] {
        is_pulled_out(chip);
    }
}

fn is_pulled_out(chip: Chip) {
    let adapter = StandIn::start(chip);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    for id in 0..100 {
        adapter.bus(&[&format!("{id:03X}#")]);
    }
    until_frame(&device, "063#");
    adapter.port.pull();
    let end = device.records().find_map(Result::err).unwrap();
    assert!(matches!(end, DeviceError::Vanished { .. }), "{end}");
    assert_eq!(device.counters().channels[0].received, 100);
}

#[test]
fn one_that_does_not_stop_holds_up_nothing() {
    let adapter = StandIn::start(Chip::Stuck);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    adapter.bus(&["123#"]);
    until_frame(&device, "123#");
    device.stop().unwrap();
    assert_eq!(device.counters().channels[0].received, 1);
}

#[test]
fn nothing_that_it_says_while_it_is_asked_counts_as_an_answer() {
    // A terminal that echoes what it is sent is no ELM327.
    let port = Port::start(|byte| vec![byte, b'>']);
    let error = open_error(&format!("elm327:{}", port.path));
    assert!(matches!(error, OpenError::Foreign { .. }), "{error}");
    // One that never stops talking is given up, too.
    let port = Port::start(|_| b"ELM327 v1.5 ".repeat(100));
    let error = open_error(&format!("elm327:{}", port.path));
    assert!(matches!(error, OpenError::Foreign { .. }), "{error}");
}

/// `OK` to what was asked before would be taken for the promise to be silent.
#[test]
fn one_whose_answers_come_twice_or_late_is_not_opened() {
    let adapter = StandIn::start(Chip::Twice);
    let error = open_error(&adapter.address());
    assert!(matches!(error, OpenError::Foreign { .. }), "{error}");
    assert!(!adapter.commands().iter().any(|command| command == "ATMA"));
}

/// Each of its words costs the connection, in turn.
#[test]
fn one_that_vanishes_at_any_moment_is_an_error_and_no_hang() {
    let mut opened = 0;
    for most in 0.. {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("elm327:tcp://{}", listener.local_addr().unwrap());
        let adapter = std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            let mut state = State::new(Chip::Elm);
            let mut byte = [0];
            while state.commands.len() < most && stream.read(&mut byte).is_ok_and(|len| len == 1) {
                if stream.write_all(&state.byte(byte[0])).is_err() {
                    break;
                }
            }
            state.monitors
        });
        let place: Place = address.parse().unwrap();
        let Ok(link) = cantap_adapters::open(&place) else {
            adapter.join().unwrap();
            continue;
        };
        opened += 1;
        let Ok(device) = cantap::Device::over(link, &address) else { continue };
        let listened = device.listen(Channel::Can1, 500_000);
        let end = device.records().find_map(Result::err);
        // The last command was to monitor: the connection ended behind it.
        if adapter.join().unwrap() {
            assert!(matches!(end, Some(DeviceError::Vanished { .. })), "{end:?}");
            break;
        }
        assert!(listened.is_err() || end.is_some(), "{most}");
    }
    assert!(opened > 1, "{opened}");
}

#[test]
fn one_that_stops_and_never_prompts_is_asked_and_then_given_up() {
    // It prompts when it is asked.
    for adapter in everywhere(Chip::Elm, Chip::Stn) {
        let device = open(&adapter.address());
        device.listen(Channel::Can1, 500_000).unwrap();
        adapter.bus(&["100#"]);
        adapter.state.lock().unwrap().monitors = false;
        adapter.says("BUFFER FULL\r");
        adapter.bus(&["7FF#"]);
        let records = until_frame(&device, "7FF#");
        assert_eq!(
            (frames(&records), gaps(&records)),
            (vec!["100#".to_owned(), "7FF#".to_owned()], vec![("queue", 0, true)])
        );
        assert!(device.failures().unwrap().last.contains("prompts that did not come"));
    }
    // It does not.
    std::thread::scope(|scope| {
        for adapter in everywhere(Chip::Stuck, Chip::StuckStn) {
            scope.spawn(move || {
                let device = open(&adapter.address());
                device.listen(Channel::Can1, 500_000).unwrap();
                adapter.bus(&["100#"]);
                adapter.says("BUFFER FULL\r");
                let end = device.records().find_map(Result::err).unwrap();
                assert!(end.to_string().contains("no longer answers"), "{end}");
                assert_eq!(device.counters().channels[0].received, 1);
            });
        }
    });
}

/// Half a line, and long afterwards its end; digits, prompts and zeros of a line at the wrong speed.
#[test]
fn halves_echoes_and_garbage_make_no_frames() {
    let adapter = StandIn::start(Chip::Elm);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    adapter.bus(&["100#"]);
    adapter.says("7E8\0 06 4");
    until_frame(&device, "100#");
    std::thread::sleep(Duration::from_millis(300));
    adapter.says("1 00\r");
    // What it echoes in spite of `ATE0`, and a frame with more digits than there are.
    adapter.says("ATMA\r7DF 02 01 0C 00 00 00 00 00 00 00\r");
    let mut number = 1u32;
    let garbage: Vec<u8> = std::iter::repeat_with(|| {
        number = number.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let byte = (number >> 24) as u8;
        if byte.is_multiple_of(32) { b'\r' } else { byte | 0x80 }
    })
    .take(2000)
    .collect();
    adapter.port.says(garbage);
    adapter.says("\r7FF\r");
    let records = until_frame(&device, "7FF#");
    assert_eq!(frames(&records), ["7E8#064100", "7FF#"]);
    assert!((3..200).contains(&losses(&records).len()), "{:?}", losses(&records));
    device.stop().unwrap();
}
