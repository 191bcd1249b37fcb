//! What such a chip receives, and what it cannot.

use super::*;

#[test]
fn it_listens_in_silence_to_both_kinds_of_identifiers_and_sends_nothing() {
    let adapter = StandIn::start(Chip::Elm);
    let device = open(&adapter.address());
    assert_eq!((device.hello().board.as_str(), device.hello().firmware), ("elm327", [2, 2, 0]));
    device.listen(Channel::Can1, 125_000).unwrap();
    adapter.bus(&["123#DEAD", "1ABCDEF0#", "456#R", "1ABCDEF0#0011223344556677", "7FF#"]);
    let received = frames(&until_frame(&device, "7FF#"));
    assert_eq!(received, ["123#DEAD", "1ABCDEF0#", "456#R", "1ABCDEF0#0011223344556677", "7FF#"]);
    assert_eq!(device.hello().capabilities & capability::TRANSMIT, 0);
    let frame = TxFrame { tag: 1, frame: "123#".parse().unwrap(), at_ticks: None };
    device.send(Channel::Can1, &[frame]).unwrap_err();
    device.join(Channel::Can1, 125_000).unwrap_err();
    device.stop().unwrap();
    let commands = adapter.commands();
    let has = |command: &str| commands.iter().any(|sent| sent == command);
    assert!(has("ATCSM1") && has("ATPBE004") && has("ATTPB") && !has("ATCSM0"), "{commands:?}");
    // No command was repeated by a lone CR, which would monitor again.
    assert_eq!(commands.iter().filter(|command| *command == "ATMA").count(), 1, "{commands:?}");
    assert_eq!(commands.last().unwrap(), "ATPC");
}

#[test]
fn what_an_old_copy_does_not_receive_is_known_before_it_is_missed() {
    let adapter = StandIn::start(Chip::OldCopy);
    let device = open(&adapter.address());
    assert_eq!(device.hello().board.as_str(), "elm327-standard");
    assert!(row(&device.hello().board).unwrap().limits.unwrap().contains("extended frames are not received"));
    assert_eq!(refusal(&device.listen(Channel::Can1, 125_000).unwrap_err()), Some(Refusal::BadTiming));
    device.listen(Channel::Can1, 250_000).unwrap();
    adapter.bus(&["1ABCDEF0#", "7FF#"]);
    assert_eq!(frames(&until_frame(&device, "7FF#")), ["7FF#"]);
    assert!(adapter.commands().iter().any(|command| command == "ATSP8"));
    drop(device);
    let device = open(&format!("{}?ids=extended", adapter.address()));
    assert_eq!(device.hello().board.as_str(), "elm327-extended");
    device.listen(Channel::Can1, 500_000).unwrap();
    adapter.bus(&["7FF#", "1ABCDEF0#"]);
    assert_eq!(frames(&until_frame(&device, "1ABCDEF0#")), ["1ABCDEF0#"]);
}

#[test]
fn a_copy_that_does_not_confirm_its_silence_is_not_opened_until_the_user_allows_it() {
    let adapter = StandIn::start(Chip::Acknowledging);
    let device = open(&adapter.address());
    assert_eq!(row(&device.hello().board).unwrap().listen_only, ListenOnly::Never);
    let refused = device.listen(Channel::Can1, 500_000).unwrap_err();
    assert!(matches!(refused, DeviceError::AlwaysAcknowledges { .. }), "{refused}");
    assert!(!adapter.commands().iter().any(|command| command == "ATMA"));
    device.join(Channel::Can1, 500_000).unwrap();
    adapter.bus(&["123#"]);
    until_frame(&device, "123#");
}

#[test]
fn a_full_buffer_is_a_gap_of_unknown_size_and_it_goes_on() {
    let adapter = StandIn::start(Chip::Elm);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    adapter.bus(&["100#", "101#0011"]);
    adapter.ends("7E8064100BUFFER FULL");
    adapter.waits_for_monitoring();
    adapter.bus(&["102#", "7FF#"]);
    let records = until_frame(&device, "7FF#");
    assert_eq!(frames(&records), ["100#", "101#0011", "102#", "7FF#"]);
    assert_eq!(gaps(&records), [("queue", 0, true)]);
    let at =
        records.iter().position(|record| matches!(record.event, TraceEvent::Lost { stage: Some(_), .. }));
    let after = &records[at.unwrap() + 1];
    assert_eq!(after.frame().unwrap().to_string(), "102#");
    assert!(device.failures().unwrap().last.contains("buffer was full"));
}

#[test]
fn what_cannot_listen_is_refused_with_the_reason() {
    let adapter = StandIn::start(Chip::RefusesMonitoring);
    let device = open(&adapter.address());
    assert_eq!(refusal(&device.listen(Channel::Can1, 500_000).unwrap_err()), Some(Refusal::Unsupported));
    let adapter = StandIn::start(Chip::AcceptsAll);
    let device = open(&adapter.address());
    assert_eq!(refusal(&device.listen(Channel::Can1, 250_000).unwrap_err()), Some(Refusal::BadTiming));
    assert!(!adapter.commands().iter().any(|command| command == "ATMA"));
    let adapter = StandIn::start(Chip::Formats);
    let error = open_error(&adapter.address());
    assert!(matches!(error, OpenError::Unsuitable { command: "ATCAF0", .. }), "{error}");
    // An ELM327 is no STN chip.
    let adapter = StandIn::start(Chip::Elm);
    let error = open_error(&format!("stn:{}", adapter.port.path));
    assert!(matches!(error, OpenError::Foreign { .. }), "{error}");
}

#[test]
fn an_stn_chip_has_any_bit_rate_and_lengths_that_can_be_checked() {
    let adapter = StandIn::start(Chip::Stn);
    let device = open(&adapter.address());
    assert_eq!((device.hello().board.as_str(), device.hello().firmware), ("stn", [4, 0, 4]));
    device.listen(Channel::Can1, 1_000_000).unwrap();
    adapter.bus(&["123#DEAD", "1ABCDEF0#11"]);
    // Two digits were lost on the way.
    adapter.says("1232DE\r");
    adapter.bus(&["456#R3", "7FF#"]);
    let records = until_frame(&device, "7FF#");
    assert_eq!(frames(&records), ["123#DEAD", "1ABCDEF0#11", "456#R3", "7FF#"]);
    assert_eq!(gaps(&records), [("link", 1, true)]);
    let commands = adapter.commands();
    let at = |command: &str| commands.iter().position(|sent| sent == command).unwrap();
    assert!(at("STP31") < at("STPBR1000000") && at("STFAP00,00") < at("STM"), "{commands:?}");
    assert!(at("STCMM0") < at("STM") && !commands.iter().any(|command| command == "STCMM1"));
}

#[test]
fn over_tcp_it_is_the_same() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("elm327:tcp://{}", listener.local_addr().unwrap());
    let adapter = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let mut state = State::new(Chip::Elm);
        let mut byte = [0];
        loop {
            match stream.read(&mut byte) {
                Ok(0) => return state.commands,
                Ok(_) => {
                    let was = state.monitors;
                    let mut answer = state.byte(byte[0]);
                    if state.monitors && !was {
                        answer.extend(state.print("123#DEAD").into_bytes());
                        answer.extend(state.print("1ABCDEF0#").into_bytes());
                    }
                    stream.write_all(&answer).unwrap();
                }
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(_) => return state.commands,
            }
        }
    });
    let device = open(&address);
    device.listen(Channel::Can1, 500_000).unwrap();
    assert_eq!(frames(&until_frame(&device, "1ABCDEF0#")), ["123#DEAD", "1ABCDEF0#"]);
    drop(device);
    assert_eq!(adapter.join().unwrap().last().unwrap(), "ATPC");
}

#[test]
fn losses_are_not_counted_and_that_is_in_the_stream() {
    let adapter = StandIn::start(Chip::Elm);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    adapter.bus(&["7FF#"]);
    let records = until(&device, |record| record.frame().is_some());
    assert_eq!(records[0].event, TraceEvent::UNCOUNTED);
    assert_eq!(device.counters().channels[0].lost(), 0);
    assert_eq!(device.counters().channels[0].unknown, 1);
}
