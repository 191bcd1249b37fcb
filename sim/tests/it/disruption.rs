//! A host that misbehaves at any instant: resets, suspends, dies, pulls the cable, closes the port. Whatever it
//! does, the channels fall silent while it is away, the device comes back, captures again, and the books
//! balance.

use crate::common;

use cantap_emu::otg::Misuse;
use cantap_emu::traffic::{Kind, Traffic};
use cantap_emu::usb_host::{Status, Timing, UsbHost};
use cantap_sim::board::CLOCK;
use cantap_sim::rig::{MS, Rig};
use cantap_wire::message::EndReason;
use cantap_wire::{Channel, Command};

/// Random instants in the test; each costs about a tenth of a second.
const INSTANTS: u64 = 200;
/// Instants that one board goes through before the next begins at power-on: a fault in one does not hide the rest.
const INSTANTS_PER_BOARD: u64 = 25;
const MEGABIT: u32 = 1_000_000;
/// Load that the test can afford.
const LOAD_PERCENT: f64 = 30.0;
/// The device may need this long to notice that nobody is there: 3 ms of silence on the bus, and a tick.
const GRACE: u64 = 8 * MS;
/// A capture after the device came back.
const AGAIN: u64 = 4 * MS;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Disruption {
    Reset,
    Suspend,
    Death,
    Unplug,
    ClosePort,
    StopReading,
}

const DISRUPTIONS: [Disruption; 6] = [
    Disruption::Reset,
    Disruption::Suspend,
    Disruption::Death,
    Disruption::Unplug,
    Disruption::ClosePort,
    Disruption::StopReading,
];

impl Disruption {
    fn strike(self, rig: &mut Rig) {
        rig.with_host(|host, otg| match self {
            Self::Reset => host.reset(otg),
            Self::Suspend => host.suspend(),
            Self::Death => host.die(),
            Self::Unplug => host.unplug(),
            Self::ClosePort => host.close_port(),
            Self::StopReading => host.read(false),
        });
    }

    fn mend(self, rig: &mut Rig) {
        rig.with_host(|host, otg| match self {
            Self::Reset | Self::ClosePort => {}
            Self::Suspend => host.resume(otg),
            Self::Death => host.boot(),
            Self::Unplug => host.plug(),
            Self::StopReading => host.read(true),
        });
    }

    /// Whether the device can notice that nobody is there.
    fn ends_the_session(self) -> bool {
        self != Self::StopReading
    }
}

/// A board on a host that resets a new device twice or once.
fn board(second_reset: bool) -> Rig {
    let timing = Timing { second_reset, ..Timing::hasty(CLOCK) };
    let mut rig = Rig::new(common::firmware(), common::setup(), timing);
    rig.plug_in().unwrap();
    let from = rig.now();
    for channel in Channel::ALL {
        let traffic = Traffic::new(Kind::Mix, channel.index() as u64, LOAD_PERCENT, from, u64::MAX);
        rig.add_traffic(channel, MEGABIT, traffic);
    }
    rig
}

fn begin(rig: &mut Rig) {
    rig.greet().unwrap();
    for channel in Channel::ALL {
        rig.listen(channel, MEGABIT).unwrap();
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn the_device_survives_a_host_that_goes_away_at_any_instant() {
    let mut random = fastrand::Rng::with_seed(20_261);
    let mut captured = 0;
    for number in 0..INSTANTS / INSTANTS_PER_BOARD {
        let mut rig = board(number % 2 == 0);
        for _ in 0..INSTANTS_PER_BOARD {
            let disruption = DISRUPTIONS[random.usize(..DISRUPTIONS.len())];
            begin(&mut rig);
            let before = rig.ledger.delivered_count(Channel::Can1);
            // Anywhere in a frame, a packet, an interrupt.
            rig.run_for(random.u64(MS..4 * MS)).unwrap();
            disruption.strike(&mut rig);
            rig.run_for(GRACE).unwrap();
            if disruption.ends_the_session() {
                for channel in Channel::ALL {
                    assert!(
                        !rig.takes_part(channel),
                        "{disruption:?}: {channel:?} still listens with nobody there"
                    );
                }
            }
            rig.run_for(random.u64(..10 * MS)).unwrap();
            disruption.mend(&mut rig);
            if disruption.ends_the_session() {
                rig.cut();
                rig.wait_for_port().unwrap_or_else(|error| panic!("after {disruption:?}: {error}"));
                begin(&mut rig);
            }
            rig.run_for(AGAIN).unwrap();
            for channel in Channel::ALL {
                rig.close(channel).unwrap();
            }
            assert!(rig.ledger.holds(), "after {disruption:?}: {:?}", rig.ledger.faults());
            assert!(
                rig.ledger.delivered_count(Channel::Can1) > before,
                "nothing was captured after {disruption:?}"
            );
        }
        captured += rig.ledger.delivered_count(Channel::Can1) + rig.ledger.delivered_count(Channel::Can2);
        assert_eq!(rig.machine.resets(), 0, "the firmware was restarted");
        assert_eq!(rig.machine.board().odd_accesses(), []);
        assert_eq!(rig.with_host(|_, otg| otg.misuse()), Misuse::default());
        for channel in Channel::ALL {
            assert_eq!(rig.dominant_bits(channel), 0, "a channel that only listens drove the bus");
        }
    }
    println!("{captured} frames captured around {INSTANTS} disruptions");
}

/// A host that dies in the middle of an enumeration finds the device again.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn an_enumeration_may_be_cut_off_anywhere() {
    let image = common::firmware();
    let mut random = fastrand::Rng::with_seed(7);
    let mut rig = Rig::new(image, common::setup(), Timing::hasty(CLOCK));
    rig.with_host(|host, _| host.plug());
    for _ in 0..30 {
        rig.run_for(random.u64(..60 * MS)).unwrap();
        rig.with_host(|host, otg| {
            if random.bool() {
                host.unplug();
                host.plug();
            } else {
                host.reset(otg);
            }
        });
    }
    rig.wait_for_port().unwrap();
    rig.greet().unwrap();
}

/// Handshakes get lost on real cables: the device sends the packet again, and the host drops the copy.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_lost_handshake_neither_loses_nor_doubles_a_frame() {
    let mut rig = board(true);
    rig.with_host(|host, _| host.drop_handshake_every(Some(7)));
    begin(&mut rig);
    rig.run_for(100 * MS).unwrap();
    for channel in Channel::ALL {
        rig.close(channel).unwrap();
        assert_eq!(rig.ledger.losses(channel).total(), 0);
    }
    let counters = rig.with_host(|host, _| host.counters());
    assert!(counters.repeated > 10, "{counters:?}");
    assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
}

/// Suspended and woken without losing the configuration, as when a laptop is closed and opened: the session is
/// over, and a new one begins without an enumeration.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn resume_needs_no_enumeration() {
    let mut rig = board(true);
    begin(&mut rig);
    rig.run_for(5 * MS).unwrap();
    rig.with_host(|host, _| host.suspend());
    rig.run_for(50 * MS).unwrap();
    assert_eq!(rig.with_host(|host, _| host.status()), Status::Suspended);
    rig.cut();
    rig.with_host(UsbHost::resume);
    rig.run_for(40 * MS).unwrap();
    begin(&mut rig);
    rig.run_for(10 * MS).unwrap();
    assert!(rig.ledger.delivered_count(Channel::Can1) > 20);
    assert_eq!(rig.with_host(|host, _| host.counters().enumerations), 1);
    rig.ask(Command::Status).unwrap();
}

/// A laptop that sleeps and wakes with the port open: everything captured until then is delivered, and the device says that and
/// when the session ended. Nothing is missing, and nobody waits for frames that will not come.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_host_that_wakes_is_told_that_the_session_has_ended_and_misses_nothing() {
    let mut rig = board(true);
    for (round, stalled) in [(1, false), (2, true), (3, false)] {
        begin(&mut rig);
        rig.run_for(5 * MS + round * MS / 3).unwrap();
        // A stalled reader leaves frames in the queue, the endpoint and the batch.
        rig.with_host(|host, _| host.read(!stalled));
        rig.run_for(4 * MS).unwrap();
        rig.with_host(|host, _| host.suspend());
        let asleep_at = rig.now();
        rig.run_for(50 * MS).unwrap();
        for channel in Channel::ALL {
            assert!(!rig.takes_part(channel), "{channel:?} still listens with nobody there");
        }
        assert_eq!(rig.session_end(), None);
        rig.with_host(UsbHost::resume);
        rig.with_host(|host, _| host.read(true));
        let told = rig.run_while(100 * MS, |rig| rig.session_end().is_none()).unwrap();
        assert!(told, "round {round}: nobody said that the session has ended");
        let Some((ticks, EndReason::Suspended)) = rig.session_end() else { panic!() };
        let ended_at = rig.clock_origin() + ticks * 12;
        assert!((asleep_at..asleep_at + GRACE).contains(&ended_at), "ended {ended_at}, asleep {asleep_at}");
        rig.follow_session_end();
        for channel in Channel::ALL {
            assert_eq!(rig.ledger.losses(channel).total(), 0, "round {round}");
        }
        assert!(rig.ledger.holds(), "round {round}: {:?}", rig.ledger.faults());
    }
    assert_eq!(rig.with_host(|host, _| host.counters().enumerations), 1);
}
