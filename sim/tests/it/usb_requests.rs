//! What hosts request from a device apart from data: a new configuration, interfaces set again, endpoints halted, requests that
//! are too long or not supported. Afterwards the port works as before, and every frame is delivered or counted.

use crate::common;

use cantap_emu::otg::Misuse;
use cantap_emu::traffic::{Kind, Traffic};
use cantap_emu::usb_host::Timing;
use cantap_emu::usb_host::control::{DEVICE_REMOTE_WAKEUP, Outcome, Request, SET_FEATURE};
use cantap_sim::board::{self, CLOCK};
use cantap_sim::rig::{MS, Rig};
use cantap_wire::message::EndReason;
use cantap_wire::{Channel, Command};

const MEGABIT: u32 = 1_000_000;
const BULK_IN: u8 = 0x82;
const BULK_OUT: u8 = 0x01;
const NOTIFY_IN: u8 = 0x81;
const DATA_INTERFACE: u16 = 1;
const GET_DESCRIPTOR: u8 = 6;

/// A board that captures both channels.
fn capturing() -> Rig {
    let mut rig = Rig::new(common::firmware(), board::setup(), Timing::hasty(CLOCK));
    rig.connect().unwrap();
    let from = rig.now();
    for channel in Channel::ALL {
        rig.add_traffic(
            channel,
            MEGABIT,
            Traffic::new(Kind::Mix, channel.index() as u64, 30.0, from, u64::MAX),
        );
    }
    listen(&mut rig);
    rig
}

fn listen(rig: &mut Rig) {
    for channel in Channel::ALL {
        rig.listen(channel, MEGABIT).unwrap();
    }
    rig.run_for(3 * MS).unwrap();
}

/// How a request on endpoint 0 ends.
fn ask(rig: &mut Rig, request: Request) -> Outcome {
    rig.with_host(|host, _| host.control(request));
    let mut outcome = None;
    rig.run_while(2000 * MS, |rig| {
        outcome = rig.with_host(|host, _| host.control_outcome());
        outcome.is_none()
    })
    .unwrap();
    outcome.expect("a request ends")
}

/// Nothing was lost on the way, and the controller was driven correctly.
fn nothing_was_lost(mut rig: Rig) {
    rig.run_for(3 * MS).unwrap();
    for channel in Channel::ALL {
        rig.close(channel).unwrap();
        assert_eq!(rig.ledger.losses(channel).total(), 0, "{channel:?}");
        assert!(rig.ledger.delivered_count(channel) > 20, "{channel:?}");
    }
    assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
    assert_eq!(rig.with_host(|_, otg| otg.misuse()), Misuse::default());
    assert_eq!(rig.machine.resets(), 0);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_device_that_is_configured_again_begins_with_data0_on_every_pipe() {
    let mut rig = capturing();
    for round in 0..6 {
        // A different number of packets on each pipe every time, so that both states of the toggles occur.
        for _ in 0..round % 3 {
            rig.ask(Command::Status).unwrap();
        }
        rig.run_for(round * MS / 3).unwrap();
        assert_eq!(ask(&mut rig, Request::set_configuration(0)), Outcome::Done(Vec::new()), "round {round}");
        rig.run_for(5 * MS).unwrap();
        for channel in Channel::ALL {
            assert!(!rig.takes_part(channel), "{channel:?} still listens with nobody there");
        }
        rig.cut();
        assert_eq!(ask(&mut rig, Request::set_configuration(1)), Outcome::Done(Vec::new()), "round {round}");
        rig.wait_for_port().unwrap();
        rig.greet().unwrap_or_else(|error| panic!("round {round}: {error}"));
        listen(&mut rig);
    }
    nothing_was_lost(rig);
}

/// A reconfiguration under an open port, of which the program that has it learns nothing: when it makes a request, it learns when and why
/// its session ended. What the reconfiguration removed from the endpoint is counted, and nothing else is missing.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_client_under_which_the_device_is_configured_anew_is_told_when_it_asks() {
    for (round, without) in [(0, false), (1, true), (2, false), (3, true)] {
        let mut rig = capturing();
        rig.with_host(|host, _| host.keep_port(true));
        rig.run_for(2 * MS + round * MS / 3).unwrap();
        let configured_at = rig.now();
        if without {
            assert_eq!(ask(&mut rig, Request::set_configuration(0)), Outcome::Done(Vec::new()));
            rig.run_for(3 * MS).unwrap();
        }
        assert_eq!(ask(&mut rig, Request::set_configuration(1)), Outcome::Done(Vec::new()));
        rig.run_for(10 * MS).unwrap();
        for channel in Channel::ALL {
            assert!(!rig.takes_part(channel), "{channel:?} still listens with nobody there");
        }
        assert_eq!(rig.session_end(), None, "round {round}: reported to a program that may be a new one");
        rig.ask(Command::Status).unwrap_err();
        let Some((ticks, EndReason::Configured)) = rig.session_end() else {
            panic!("round {round}: refused before the end was reported: {:?}", rig.session_end());
        };
        let ended_at = rig.clock_origin() + ticks * 12;
        assert!((configured_at..configured_at + 3 * MS).contains(&ended_at), "round {round}");
        rig.follow_session_end();
        for channel in Channel::ALL {
            let losses = rig.ledger.losses(channel);
            assert!(losses.total() == losses.link && losses.link < 100, "round {round}: {losses:?}");
            assert!(rig.ledger.delivered_count(channel) > 5, "round {round}");
        }
        assert!(rig.ledger.holds(), "round {round}: {:?}", rig.ledger.faults());
        assert_eq!(rig.with_host(|host, _| host.counters().enumerations), 1);
        // A program that greets the device on the same port can carry on.
        rig.greet().unwrap();
        listen(&mut rig);
        rig.with_host(|host, _| host.keep_port(false));
        assert_eq!(rig.with_host(|_, otg| otg.misuse()), Misuse::default());
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn an_interface_set_anew_under_an_open_port_loses_nothing() {
    let mut rig = capturing();
    for round in 0..8 {
        rig.run_for(round * MS / 5).unwrap();
        assert_eq!(ask(&mut rig, Request::set_interface(DATA_INTERFACE)), Outcome::Done(Vec::new()));
        rig.ask(Command::Status).unwrap();
    }
    nothing_was_lost(rig);
}

/// The driver notices the halt with its next token or packet and clears it, as Linux's does.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_halt_and_its_end_lose_nothing() {
    let mut rig = capturing();
    for (round, endpoint) in [BULK_IN, BULK_OUT, BULK_IN, BULK_OUT, BULK_IN].into_iter().enumerate() {
        rig.run_for(round as u64 * MS / 7).unwrap();
        let stalls = rig.with_host(|host, _| host.counters().stalls);
        assert_eq!(ask(&mut rig, Request::halt(endpoint)), Outcome::Done(Vec::new()));
        rig.ask(Command::Status).unwrap_or_else(|error| panic!("round {round}, {endpoint:#x}: {error}"));
        assert!(rig.with_host(|host, _| host.counters().stalls) > stalls, "{endpoint:#x} was not halted");
        assert_eq!(ask(&mut rig, Request::endpoint_status(endpoint)), Outcome::Done(vec![0, 0]));
    }
    assert_eq!(ask(&mut rig, Request::halt(NOTIFY_IN)), Outcome::Done(Vec::new()));
    assert_eq!(ask(&mut rig, Request::endpoint_status(NOTIFY_IN)), Outcome::Done(vec![1, 0]));
    assert_eq!(ask(&mut rig, Request::clear_halt(NOTIFY_IN)), Outcome::Done(Vec::new()));
    assert_eq!(ask(&mut rig, Request::endpoint_status(NOTIFY_IN)), Outcome::Done(vec![0, 0]));
    nothing_was_lost(rig);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_configuration_ends_a_halt() {
    let mut rig = capturing();
    for endpoint in [BULK_IN, BULK_OUT, NOTIFY_IN] {
        // With the port closed, no driver notices the halt.
        rig.with_host(|host, _| host.close_port());
        rig.run_for(5 * MS).unwrap();
        rig.cut();
        assert_eq!(ask(&mut rig, Request::halt(endpoint)), Outcome::Done(Vec::new()));
        assert_eq!(ask(&mut rig, Request::endpoint_status(endpoint)), Outcome::Done(vec![1, 0]));
        assert_eq!(ask(&mut rig, Request::set_configuration(1)), Outcome::Done(Vec::new()));
        assert_eq!(
            ask(&mut rig, Request::endpoint_status(endpoint)),
            Outcome::Done(vec![0, 0]),
            "{endpoint:#x}"
        );
        rig.wait_for_port().unwrap();
        rig.greet().unwrap();
        listen(&mut rig);
    }
    nothing_was_lost(rig);
}

/// usb-device has room for 128 bytes. More is refused, and the next request is answered.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_request_with_more_data_than_there_is_room_for_is_refused_and_leaves_nothing_behind() {
    let mut rig = capturing();
    let encapsulated = |len| Request::with_data(0x21, 0, 0, 0, vec![7; len]);
    for (len, outcome) in [
        (128, Outcome::Done(Vec::new())),
        (129, Outcome::Stalled),
        (64, Outcome::Done(Vec::new())),
        (500, Outcome::Stalled),
        (192, Outcome::Stalled),
    ] {
        assert_eq!(ask(&mut rig, encapsulated(len)), outcome, "{len} bytes");
        assert_eq!(
            ask(&mut rig, Request::endpoint_status(BULK_IN)),
            Outcome::Done(vec![0, 0]),
            "after {len}"
        );
    }
    nothing_was_lost(rig);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn what_the_descriptors_do_not_offer_is_refused() {
    let mut rig = capturing();
    let wakeup = Request::new(0x00, SET_FEATURE, DEVICE_REMOTE_WAKEUP, 0, 0);
    assert_eq!(ask(&mut rig, wakeup), Outcome::Stalled);
    let Outcome::Done(device) = ask(&mut rig, Request::new(0x80, GET_DESCRIPTOR, 1 << 8, 0, 18)) else {
        panic!()
    };
    assert_eq!(device[2..4], [0x00, 0x02], "bcdUSB");
    let store = Request::new(0x80, GET_DESCRIPTOR, 15 << 8, 0, 5);
    assert_eq!(ask(&mut rig, store), Outcome::Stalled, "USB 2.0 has no binary object store");
    let Outcome::Done(head) = ask(&mut rig, Request::new(0x80, GET_DESCRIPTOR, 2 << 8, 0, 9)) else {
        panic!()
    };
    assert_eq!((head[7], head[8]), (0x80, 50), "powered by the bus, without remote wakeup, 100 mA");
    nothing_was_lost(rig);
}
