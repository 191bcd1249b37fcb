//! The pipes under load: a host that floods, and the question of who touches the controller.

use crate::common;

use cantap_emu::machine::Setup;
use cantap_emu::memory_map::OTG_FS_IRQ;
use cantap_emu::otg::Misuse;
use cantap_emu::usb_host::Timing;
use cantap_sim::board::{self, CLOCK};
use cantap_sim::rig::{MS, Rig, timing};
use cantap_wire::message::{ChannelConfig, Mode, TxFrame};
use cantap_wire::{Channel, Command, Frame};

/// A host that sends faster than it is served, in pieces that end anywhere in a packet. Only NAK slows it down; cleared before
/// the end of a transfer, that would cost four bytes of a packet.
fn flood(mut next: impl FnMut(&mut fastrand::Rng) -> Command) {
    let image = common::firmware();
    let mut rig = Rig::new(image, Setup { joined: true, ..board::setup() }, Timing::new(CLOCK));
    rig.connect().unwrap();
    for channel in Channel::ALL {
        let config =
            ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing(1_000_000).unwrap()) };
        rig.open(channel, config).unwrap();
    }
    let mut random = fastrand::Rng::with_seed(600);
    for _ in 0..2000 {
        let (_, bytes) = rig.session.request(next(&mut random));
        rig.with_host(|host, _| host.send(&bytes));
    }
    rig.run_for(150 * MS).unwrap();
    let misuse = rig.with_host(|_, otg| otg.misuse());
    assert_eq!(misuse, Misuse::default());
    let status = rig.status().unwrap();
    assert_eq!((status.bad_requests, rig.with_host(|host, _| host.unsent())), (0, 0));
    let unserved = only_usb_touches_the_controller(&rig);
    assert!(unserved.is_empty(), "{unserved:?} touch the controller from above USB's priority");
}

/// Exceptions with a higher priority than the controller's interrupt that have touched it.
fn only_usb_touches_the_controller(rig: &Rig) -> Vec<String> {
    let cpu = rig.machine.cpu();
    let own = cpu.priority_of(OTG_FS_IRQ);
    let accessors: Vec<u16> = rig.machine.accessors(OTG_FS_IRQ).collect();
    assert!(accessors.contains(&(OTG_FS_IRQ + 16)), "nobody has touched it");
    let above =
        accessors.into_iter().filter(|exception| *exception >= 16 && cpu.priority_of(exception - 16) < own);
    above.map(|exception| rig.machine.exception_name(exception)).collect()
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_flood_of_questions_is_answered_without_taking_back_nak_early() {
    flood(
        |random| {
            if random.bool() { Command::Status } else { Command::Registers { channel: Channel::Can1 } }
        },
    );
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_flood_of_frames_is_taken_without_taking_back_nak_early() {
    let mut tag = 0;
    flood(|random| {
        let frame: Frame = "123#1122334455667788".parse().unwrap();
        let frames = (0..random.usize(1..12)).map(|_| {
            tag += 1;
            TxFrame { frame, tag, at_ticks: None }
        });
        Command::Send { channel: Channel::Can1, frames: frames.collect() }
    });
}
