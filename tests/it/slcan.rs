//! slcan conversations, pinned byte for byte, on fakes. `docs/slcan.md` lists the letters.

use crate::fakes;

use cantap_firmware::bus::filters::Shape;
use cantap_firmware::bus::mailboxes::MAILBOXES;
use cantap_firmware::bus::queue::RecordQueue;
use cantap_firmware::bus::transmit::TX_QUEUE;
use cantap_firmware::{CAN_CLOCK_HZ, TICKS_PER_MS, TICKS_PER_US};
use cantap_wire::message::{ChannelConfig, Mode};
use cantap_wire::record::{BusErrorKind, ErrorState};
use cantap_wire::{BitTiming, Channel, Command, Frame, Reply};
use fakes::{Bench, SMALL_QUEUE};

const CAN1: Channel = Channel::Can1;

/// What the device answers to a line, including frames from the bus.
fn say<const N: usize>(bench: &mut Bench<'_, N>, line: &str) -> String {
    let before = bench.port.from_device.len();
    bench.say(format!("{line}\r").as_bytes());
    for _ in 0..3 {
        bench.millisecond();
    }
    String::from_utf8(bench.port.from_device[before..].to_vec()).unwrap()
}

/// Sends each line and compares the answer with the one beside it.
fn converse<const N: usize>(bench: &mut Bench<'_, N>, conversation: &[(&str, &str)]) {
    for (line, answer) in conversation {
        assert_eq!(say(bench, line), *answer, "the answer to {line:?}");
    }
}

/// A frame comes off the bus; returns what the device sends.
fn receive<const N: usize>(bench: &mut Bench<'_, N>, frame: &str) -> String {
    let before = bench.port.from_device.len();
    bench.receive(CAN1, frame.parse().unwrap());
    bench.poll();
    String::from_utf8(bench.port.from_device[before..].to_vec()).unwrap()
}

#[test]
fn a_channel_is_set_up_opened_and_closed() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(
        &mut bench,
        &[
            ("", "\r"),
            ("C", "\r"),
            ("O", "\x07"),
            ("S:", "\x07"),
            ("S", "\x07"),
            ("S6", "\r"),
            ("F", "\x07"),
            ("t1230", "\x07"),
            ("O", "\r"),
            ("O", "\x07"),
            ("L", "\x07"),
            ("S4", "\x07"),
            ("Z1", "\x07"),
            ("F", "F00\r"),
            ("C", "\r"),
            ("L", "\r"),
            ("t1230", "\x07"),
            ("C", "\r"),
            ("?", "\x07"),
            ("t12", "\x07"),
        ],
    );
    let modes: Vec<Mode> = bench.board.control[0].started.iter().map(|config| config.mode).collect();
    assert_eq!(modes, [Mode::Normal, Mode::ListenOnly]);
}

#[test]
fn each_s_digit_is_its_bit_rate() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    let rates = [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000, 83_333];
    for (digit, rate) in rates.into_iter().enumerate() {
        converse(&mut bench, &[(&format!("S{digit}"), "\r"), ("O", "\r"), ("C", "\r")]);
        let timing = bench.board.control[0].started[digit].timing;
        assert_eq!(timing.bitrate_bps(cantap_firmware::CAN_CLOCK_HZ), rate);
    }
}

/// Lawicel's `S7` is 800 kbit/s, python-can's 750: only python-can sends an empty line after it.
#[test]
fn s7_with_an_empty_line_behind_it_is_what_python_can_means() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(&mut bench, &[("", "\r"), ("S7", "\r"), ("", "\r"), ("O", "\r"), ("C", "\r")]);
    converse(&mut bench, &[("S7", "\r"), ("Z0", "\r"), ("", "\r"), ("O", "\r"), ("C", "\r")]);
    converse(&mut bench, &[("S7", "\r"), ("S6", "\r"), ("", "\r"), ("O", "\r"), ("C", "\r")]);
    let started = bench.board.control[0].started.iter();
    let rates: Vec<u32> =
        started.map(|config| config.timing.bitrate_bps(cantap_firmware::CAN_CLOCK_HZ)).collect();
    assert_eq!(rates, [750_000, 800_000, 500_000]);
}

/// A host that does not check the answers would otherwise hear nothing but errors, or disturb the bus.
#[test]
fn after_a_rate_that_was_refused_nothing_is_opened_at_the_one_before() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(&mut bench, &[("S6", "\r"), ("O", "\r"), ("C", "\r"), ("Q1", "\r")]);
    for refused in ["S:", "S", "S66", "s009C", "s00", "s00GG"] {
        converse(&mut bench, &[(refused, "\x07"), ("O", "\x07"), ("L", "\x07")]);
    }
    converse(&mut bench, &[("S5", "\r"), ("O", "\r")]);
    assert_eq!(bench.board.control[0].started.len(), 2);
}

/// `s` takes an SJA1000's BTR0 and BTR1 at 16 MHz: 001C is 500 kbit/s with its sample point at 87.5 %.
#[test]
fn raw_registers_of_an_sja1000_give_its_rate_and_triple_sampling_is_refused() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(
        &mut bench,
        &[("s009C", "\x07"), ("s00", "\x07"), ("s00GG", "\x07"), ("s001C", "\r"), ("O", "\r")],
    );
    let timing = bench.board.control[0].started[0].timing;
    assert_eq!(timing, BitTiming { prescaler: 9, segment1: 6, segment2: 1, jump_width: 1 });
    converse(&mut bench, &[("s001C", "\x07"), ("C", "\r")]);
}

#[test]
fn frames_are_sent_and_their_order_kept() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(
        &mut bench,
        &[
            ("S8", "\r"),
            ("O", "\r"),
            ("t1232DEAD", "z\r"),
            ("T1ABBCCDD0", "Z\r"),
            ("r7FF8", "z\r"),
            ("R000000012", "Z\r"),
            ("t8000", "\x07"),
            ("t1239", "\x07"),
            ("t1232DE", "\x07"),
            ("t1232DEADBE", "\x07"),
            ("r123211", "\x07"),
            ("TFFFFFFFF0", "\x07"),
        ],
    );
    let sent: Vec<String> =
        std::iter::from_fn(|| bench.send_one(CAN1)).map(|frame: Frame| frame.to_string()).collect();
    assert_eq!(sent, ["123#DEAD", "1ABBCCDD#", "7FF#R8", "00000001#R2"]);
}

#[test]
fn a_full_transmit_queue_is_waited_for_and_then_refused_and_flagged() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(&mut bench, &[("S8", "\r"), ("O", "\r")]);
    let taken = (0..400).take_while(|_| say(&mut bench, "t1230") == "z\r").count();
    assert_eq!(taken, TX_QUEUE + MAILBOXES);
    // One is sent, which makes room for the line that waited; the next waits in vain.
    bench.send_one(CAN1);
    converse(&mut bench, &[("t1231AA", "z\r")]);
    for _ in 0..100 {
        bench.millisecond();
    }
    assert!(bench.port.from_device.ends_with(b"\x07"));
    // So do those after it, but without waiting as long again; and other requests are answered.
    converse(
        &mut bench,
        &[("t1230", "\x07"), ("F", "F02\r"), ("t1230", "\x07"), ("F", "F02\r"), ("F", "F00\r")],
    );
    bench.send_one(CAN1);
    converse(&mut bench, &[("t1230", "z\r")]);
}

/// A program that sends as fast as it can write, as python-can does, and reads the answers later.
#[test]
fn every_line_of_a_burst_is_answered_and_every_frame_sent() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(&mut bench, &[("S8", "\r"), ("O", "\r")]);
    let before = bench.port.from_device.len();
    let burst: Vec<u8> =
        (0..2000).flat_map(|n| format!("T{n:08X}81122334455667788\r").into_bytes()).collect();
    bench.say(&burst);
    let mut sent = Vec::new();
    for _ in 0..2500 {
        bench.millisecond();
        sent.extend(bench.send_one(CAN1).map(|frame| frame.id().raw()));
    }
    assert_eq!(sent, (0..2000).collect::<Vec<_>>());
    assert_eq!(bench.port.from_device[before..], *"Z\r".repeat(2000).as_bytes());
    converse(&mut bench, &[("F", "F00\r")]);
}

#[test]
fn received_frames_are_lines_with_the_stamps_that_were_asked_for() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(&mut bench, &[("S8", "\r"), ("O", "\r")]);
    assert_eq!(receive(&mut bench, "123#DEADBEEF"), "t1234DEADBEEF\r");
    assert_eq!(receive(&mut bench, "1F334455#"), "T1F3344550\r");
    assert_eq!(receive(&mut bench, "7FF#R3"), "r7FF3\r");
    assert_eq!(receive(&mut bench, "00000001#R"), "R000000010\r");
    converse(&mut bench, &[("C", "\r"), ("Z1", "\r"), ("O", "\r")]);
    let now_ms = bench.board.clock.now.get() / TICKS_PER_MS;
    assert_eq!(receive(&mut bench, "123#"), format!("t1230{:04X}\r", now_ms % 60_000));
    // The stamp wraps after a minute.
    bench.pass(60_000 * TICKS_PER_MS);
    assert_eq!(receive(&mut bench, "123#"), format!("t1230{:04X}\r", now_ms % 60_000));
    converse(&mut bench, &[("C", "\r"), ("Z2", "\r"), ("O", "\r")]);
    bench.pass(7 * TICKS_PER_US);
    let now_us = bench.board.clock.now.get() / TICKS_PER_US;
    assert_eq!(receive(&mut bench, "123#"), format!("t1230{now_us:08X}\r"));
    converse(&mut bench, &[("C", "\r"), ("Z0", "\r"), ("O", "\r")]);
    assert_eq!(receive(&mut bench, "123#"), "t1230\r");
}

#[test]
fn frames_are_polled_where_asked() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(
        &mut bench,
        &[("S8", "\r"), ("P", "\x07"), ("X0", "\r"), ("O", "\r"), ("P", "\r"), ("A", "A\r")],
    );
    for id in ["001#", "002#", "003#"] {
        assert_eq!(receive(&mut bench, id), "");
    }
    converse(&mut bench, &[("P", "t0010\r"), ("A", "t0020\rt0030\rA\r"), ("A", "A\r"), ("t1230", "\r")]);
}

#[test]
fn losses_and_errors_set_flags_that_reading_clears() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(&mut bench, &[("S8", "\r"), ("O", "\r")]);
    // Four frames for a FIFO of three.
    for _ in 0..4 {
        bench.board.traffic[0].arrive("123#".parse().unwrap());
    }
    bench.interrupt(CAN1);
    bench.poll();
    converse(&mut bench, &[("F", "F08\r"), ("F", "F00\r")]);
    // A host that does not read until the queue is full.
    bench.port.takes = 0;
    for _ in 0..5000 {
        bench.receive(CAN1, "123#1122334455667788".parse().unwrap());
    }
    bench.port.takes = usize::MAX;
    bench.millisecond();
    bench.receive(CAN1, "124#".parse().unwrap());
    bench.millisecond();
    converse(&mut bench, &[("F", "F01\r"), ("F", "F00\r")]);
    bench.board.traffic[0].error = Some(BusErrorKind::Stuff);
    bench.board.traffic[0].state = Some(ErrorState::Warning);
    bench.millisecond();
    converse(&mut bench, &[("F", "F84\r")]);
    bench.board.traffic[0].state = Some(ErrorState::Passive);
    bench.millisecond();
    converse(&mut bench, &[("F", "F24\r"), ("F", "F00\r")]);
}

/// With K1, what `F` would report comes in lines that Linux's slcan driver accepts, none of them shorter than five
/// characters.
#[test]
fn losses_errors_and_states_are_lines_where_they_are_asked_for() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(
        &mut bench,
        &[("K2", "\x07"), ("K", "\x07"), ("K1", "\r"), ("S8", "\r"), ("O", "\r"), ("K0", "\x07")],
    );
    // Four frames for a FIFO of three.
    for _ in 0..4 {
        bench.board.traffic[0].arrive("123#".parse().unwrap());
    }
    let before = bench.port.from_device.len();
    bench.interrupt(CAN1);
    bench.poll();
    assert_eq!(bench.port.from_device[before..], *b"t1230\rt1230\rt1230\re3ooo\r");
    let kinds = [
        (BusErrorKind::Stuff, 's'),
        (BusErrorKind::Form, 'f'),
        (BusErrorKind::Acknowledgment, 'a'),
        (BusErrorKind::BitRecessive, 'B'),
        (BusErrorKind::BitDominant, 'b'),
        (BusErrorKind::Crc, 'c'),
    ];
    for (kind, letter) in kinds {
        let before = bench.port.from_device.len();
        bench.board.traffic[0].error = Some(kind);
        bench.millisecond();
        let line = format!("e3{letter}{letter}{letter}\r");
        assert_eq!(bench.port.from_device[before..], *line.as_bytes(), "{kind:?}");
    }
    let states = [
        (ErrorState::Warning, (96, 0), "sw000096\r"),
        (ErrorState::Passive, (12, 128), "sp128012\r"),
        (ErrorState::BusOff, (255, 128), "sb128255\r"),
        (ErrorState::Active, (0, 7), "sa007000\r"),
    ];
    for (state, counters, line) in states {
        let before = bench.port.from_device.len();
        bench.board.traffic[0].counters = counters;
        bench.board.traffic[0].state = Some(state);
        bench.millisecond();
        assert_eq!(bench.port.from_device[before..], *line.as_bytes(), "{state:?}");
    }
    // The flags are still set, as without K1.
    converse(&mut bench, &[("F", "FAC\r"), ("C", "\r"), ("K0", "\r"), ("O", "\r")]);
    let before = bench.port.from_device.len();
    bench.board.traffic[0].error = Some(BusErrorKind::Stuff);
    bench.millisecond();
    assert_eq!(bench.port.from_device[before..], *b"");
}

#[test]
fn a_frame_refused_for_want_of_room_is_a_line_where_it_is_asked_for() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(&mut bench, &[("K1", "\r"), ("S8", "\r"), ("O", "\r")]);
    let taken = (0..400).take_while(|_| say(&mut bench, "t1230") == "z\r").count();
    assert_eq!(taken, TX_QUEUE + MAILBOXES);
    for _ in 0..100 {
        bench.millisecond();
    }
    assert!(bench.port.from_device.ends_with(b"\x07e3OOO\r"));
}

/// A host that polls gets answers and nothing in between.
#[test]
fn a_host_that_polls_is_not_interrupted_by_reports() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(&mut bench, &[("K1", "\r"), ("X0", "\r"), ("S8", "\r"), ("O", "\r")]);
    let before = bench.port.from_device.len();
    bench.board.traffic[0].error = Some(BusErrorKind::Stuff);
    bench.millisecond();
    assert_eq!(bench.port.from_device[before..], *b"");
    converse(&mut bench, &[("F", "F80\r")]);
}

/// M and m are an SJA1000's acceptance code and mask; a mask bit of 1 means "don't care". With W1, one long filter.
#[test]
fn acceptance_code_and_mask_become_filters_of_a_closed_channel() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(
        &mut bench,
        &[("S8", "\r"), ("W1", "\r"), ("M24600000", "\r"), ("m001FFFFF", "\r"), ("O", "\r")],
    );
    let layout = bench.board.filters.written.last().unwrap().clone();
    // Eleven bits from the top, compared with the format: standard ID 123.
    let bank = layout.banks.iter().flatten().find(|bank| bank.shape == Shape::Mask16).unwrap();
    assert_eq!((bank.first & 0xFFFF, bank.first >> 16), (0x123 << 5, 0xFFE8), "{layout:?}");
    converse(&mut bench, &[("M00000000", "\x07"), ("mFFFFFFFF", "\x07"), ("C", "\r"), ("mFFFFFFFF", "\r")]);
    assert_eq!(*bench.board.filters.written.last().unwrap(), cantap_firmware::bus::filters::Layout::open());
}

#[test]
fn version_serial_number_and_registers_are_told() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(&mut bench, &[("V", "V1001\r"), ("N", "NCDEF\r"), ("Y", "\x07"), ("S8", "\r"), ("O", "\r")]);
    assert_eq!(say(&mut bench, "I"), format!("I{}\r", "0".repeat(56)));
    bench.board.traffic[0].counters = (8, 0);
    bench.board.traffic[0].error = Some(BusErrorKind::Acknowledgment);
    bench.millisecond();
    bench.board.traffic[0].counters = (9, 0);
    let with_esr = |esr: u32| format!("{}{esr:08X}{}\r", "0".repeat(40), "0".repeat(8));
    assert_eq!(say(&mut bench, "I"), format!("I{}", with_esr(9 << 16)));
    assert_eq!(say(&mut bench, "Y"), format!("Y{}", with_esr(8 << 16)));
}

#[test]
fn q_keeps_the_bit_rate_for_the_next_session() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(
        &mut bench,
        &[("Q1", "\x07"), ("S5", "\r"), ("O", "\r"), ("Q1", "\x07"), ("C", "\r"), ("Q1", "\r")],
    );
    bench.port.open = false;
    bench.millisecond();
    bench.port.open = true;
    converse(&mut bench, &[("O", "\r"), ("C", "\r"), ("Q0", "\r")]);
    let timing = bench.board.control[0].started[1].timing;
    assert_eq!(timing.bitrate_bps(cantap_firmware::CAN_CLOCK_HZ), 250_000);
    bench.port.open = false;
    bench.millisecond();
    bench.port.open = true;
    converse(&mut bench, &[("O", "\x07")]);
}

/// A rate is saved even if it has not been used; a refused one is not replaced by the previous one.
#[test]
fn q_keeps_a_rate_that_was_only_set() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(&mut bench, &[("S4", "\r"), ("Q1", "\r")]);
    again(&mut bench);
    converse(&mut bench, &[("L", "\r"), ("C", "\r"), ("S:", "\x07"), ("Q1", "\x07")]);
    let timing = bench.board.control[0].started[0].timing;
    assert_eq!(timing.bitrate_bps(cantap_firmware::CAN_CLOCK_HZ), 125_000);
}

/// Another program opens the port.
fn again<const N: usize>(bench: &mut Bench<'_, N>) {
    bench.port.open = false;
    bench.millisecond();
    bench.port.open = true;
}

/// Opens the channel as slcand does, and returns what the device sends on a bus error.
fn reported<const N: usize>(bench: &mut Bench<'_, N>) -> String {
    converse(bench, &[("C", "\r"), ("S6", "\r"), ("O", "\r")]);
    let before = bench.port.from_device.len();
    bench.board.traffic[0].error = Some(BusErrorKind::Stuff);
    bench.millisecond();
    let said = String::from_utf8(bench.port.from_device[before..].to_vec()).unwrap();
    converse(bench, &[("C", "\r")]);
    said
}

/// slcand never sends `K1`: once it is saved, slcand gets reports too, even after a power cycle, and native programs do not
/// change it.
#[test]
fn q_keeps_k_so_that_programs_that_never_send_it_have_reports() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    assert_eq!(reported(&mut bench), "");
    again(&mut bench);
    // By itself: no rate is saved with it.
    converse(&mut bench, &[("K1", "\r"), ("Q1", "\r")]);
    again(&mut bench);
    converse(&mut bench, &[("O", "\x07")]);
    assert_eq!(reported(&mut bench), "e3sss\r");
    // A session that sets it otherwise affects only itself.
    converse(&mut bench, &[("K0", "\r")]);
    assert_eq!(reported(&mut bench), "");
    again(&mut bench);
    assert_eq!(reported(&mut bench), "e3sss\r");
    // Saving a rate keeps it, both here and in the native protocol.
    converse(&mut bench, &[("Q1", "\r")]);
    again(&mut bench);
    bench.greet();
    let config = ChannelConfig::listen_only(BitTiming::choose(CAN_CLOCK_HZ, 250_000, None).unwrap());
    bench.ask(Command::Configure { channel: Channel::Can2, config }).unwrap();
    bench.ask(Command::SaveDefaults).unwrap();
    let saved = bench.board.chip.saved.clone();

    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.board.chip.saved = saved.clone();
    assert_eq!(reported(&mut bench), "e3sss\r");
    // Settings saved by firmware without `K1` lack only the last byte: there are no reports, and nothing else is lost.
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.board.chip.saved = saved[..saved.len() - 1].to_vec();
    assert_eq!(reported(&mut bench), "");
    bench.greet();
    assert!(matches!(bench.ask(Command::Defaults { channel: CAN1 }), Ok(Reply::Defaults(_))));
    assert!(matches!(bench.ask(Command::Defaults { channel: Channel::Can2 }), Ok(Reply::Defaults(_))));
    bench.board.chip.saved = saved;
    again(&mut bench);
    converse(&mut bench, &[("K0", "\r"), ("Q1", "\r")]);
    again(&mut bench);
    assert_eq!(reported(&mut bench), "");
    converse(&mut bench, &[("K1", "\r"), ("Q1", "\r"), ("Q0", "\r")]);
    again(&mut bench);
    assert_eq!(reported(&mut bench), "");
}

#[test]
fn too_long_and_broken_lines_are_refused_as_lines() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(&mut bench, &[("S8", "\r"), (&format!("t{}", "1".repeat(300)), "\x07"), ("V", "V1001\r")]);
    // Terminal programs end lines with CR LF.
    converse(&mut bench, &[("O", "\r"), ("\nF", "F00\r")]);
}

#[test]
fn the_native_language_takes_over_from_slcan() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(&mut bench, &[("S8", "\r"), ("O", "\r")]);
    bench.greet();
    let Ok(Reply::Status(status)) = bench.ask(Command::Status) else { panic!() };
    assert_eq!(status.channels[0].open, None);
}

#[test]
fn half_a_line_does_not_keep_the_native_language_from_taking_over() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.say(b"A");
    bench.greet();
    // Long enough that the rest of the line is being skipped.
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.say(&[b't'; 200]);
    bench.greet();
}

/// slcan has no message for the end of a session: a BEL follows what was captured, and the channel is closed. Its settings
/// stay.
#[test]
fn a_host_that_wakes_gets_what_was_captured_and_a_bel() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(&mut bench, &[("S6", "\r"), ("O", "\r")]);
    bench.board.traffic[0].arrive("123#11".parse().unwrap());
    bench.interrupt(CAN1);
    bench.sleep(true);
    for _ in 0..3 {
        bench.millisecond();
    }
    assert!(!bench.board.control[0].running);
    let before = bench.port.from_device.len();
    bench.sleep(false);
    for _ in 0..3 {
        bench.millisecond();
    }
    assert_eq!(bench.port.from_device[before..], *b"t123111\r\x07");
    converse(&mut bench, &[("t1230", "\x07"), ("O", "\r")]);
}

/// What follows the rest of the session is the answer to the line that triggered it.
#[test]
fn a_program_whose_host_configured_the_device_anew_gets_the_rest_when_it_says_something() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    converse(&mut bench, &[("S6", "\r"), ("O", "\r")]);
    bench.board.traffic[0].arrive("123#11".parse().unwrap());
    bench.interrupt(CAN1);
    bench.port.history.configured += 1;
    let before = bench.port.from_device.len();
    for _ in 0..3 {
        bench.millisecond();
    }
    assert!(!bench.board.control[0].running);
    assert_eq!(bench.port.from_device.len(), before, "it may be another program that is listening");
    converse(&mut bench, &[("t1230", "t123111\r\x07"), ("t1230", "\x07"), ("O", "\r")]);
}
