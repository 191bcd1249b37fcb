//! Marks of USB's start of frame: what the ELF reports for each, compared with what the host really did.

use crate::common;

use cantap_emu::traffic::{Kind, Traffic as Load};
use cantap_emu::usb_host::{Timing, UsbHost};
use cantap_sim::board::{self, CLOCK};
use cantap_sim::rig::{MS, Rig};
use cantap_wire::{Channel, Event};

const MEGABIT: u32 = 1_000_000;
/// Core cycles of a tick.
const TICK: u64 = 12;

fn connected(timing: Timing) -> Rig {
    let mut rig = Rig::new(common::firmware(), board::setup(), timing);
    rig.connect().unwrap();
    rig
}

/// The marks so far: device time, frame number, and how often SOFs came twice.
fn marks(rig: &Rig) -> Vec<(u64, u16, u16)> {
    let mark = |(ticks, event): &(u64, Event)| match event {
        Event::SofMark { frame, doubled } => Some((*ticks, *frame, *doubled)),
        _ => None,
    };
    rig.events().iter().filter_map(mark).collect()
}

/// Every mark is exactly the tick in which the host began the frame of that number.
fn check(rig: &mut Rig, timing: &Timing, least: usize) {
    let origin = rig.clock_origin();
    let marks = marks(rig);
    assert!(marks.len() >= least, "{marks:?}");
    for (ticks, number, _) in marks {
        let cycle = origin + ticks * TICK;
        let frame = timing.frame_after(cycle.saturating_sub(timing.sof_jitter + TICK));
        assert_eq!(frame as u16 & 0x7FF, number, "the frame at cycle {cycle}");
        assert_eq!((timing.frame_start(frame) - origin) / TICK, ticks, "the start of frame {frame}");
    }
}

/// Across the wrap of the frame number, with a board that is 80 ppm fast and a host whose frames jitter by 500
/// ns.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn an_idle_session_has_exact_marks_once_a_second() {
    let timing = Timing { board_ppm: 80.0, sof_jitter: 72, ..Timing::hasty(CLOCK) };
    let mut rig = connected(timing);
    rig.run_for(3_200 * MS).unwrap();
    check(&mut rig, &timing, 4);
    let marks = marks(&rig);
    assert!(marks.iter().any(|(_, frame, _)| *frame < 400), "no wrap of the frame number: {marks:?}");
    assert!(marks.windows(2).all(|pair| (11_988_000..12_120_000).contains(&(pair[1].0 - pair[0].0))));
    // The board's millisecond slides past the host's by 80 ns each time: for a dozen of them, a jitter of 500 ns either way decides on which
    // side a start of frame falls, and every other may come with the one before.
    assert!(marks.iter().all(|(_, _, doubled)| *doubled < 7), "{marks:?}");
    assert_eq!(rig.machine.board().odd_accesses(), []);
}

/// Both buses full, and as much as possible to do for the millisecond tick.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn marks_are_exact_beside_two_full_buses() {
    let timing = Timing { board_ppm: -80.0, sof_jitter: 72, ..Timing::hasty(CLOCK) };
    let mut rig = connected(timing);
    rig.run_for(940 * MS).unwrap();
    for channel in Channel::ALL {
        let now = rig.now();
        rig.add_traffic(
            channel,
            MEGABIT,
            Load::new(Kind::Std0, channel.index() as u64, 100.0, now, u64::MAX),
        );
        rig.listen(channel, MEGABIT).unwrap();
    }
    rig.run_for(100 * MS).unwrap();
    for channel in Channel::ALL {
        rig.close(channel).unwrap();
        assert_eq!(rig.ledger.losses(channel).total(), 0);
    }
    assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
    check(&mut rig, &timing, 2);
}

/// A suspended bus has no frames. The session after it begins with a new mark.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_suspended_bus_makes_no_marks() {
    let timing = Timing::hasty(CLOCK);
    let mut rig = connected(timing);
    rig.run_for(100 * MS).unwrap();
    rig.with_host(|host, _| host.suspend());
    rig.run_for(1_500 * MS).unwrap();
    assert_eq!(marks(&rig).len(), 1, "{:?}", marks(&rig));
    rig.with_host(UsbHost::resume);
    rig.wait_for_port().unwrap();
    rig.greet().unwrap();
    rig.run_for(50 * MS).unwrap();
    check(&mut rig, &timing, 2);
}
