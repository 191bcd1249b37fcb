//! Silicon that answers late, wrongly or never, one fault at a time and from seeds: whatever it does, nothing is sent that nobody asked
//! for, no frame is lost uncounted, and no hang needs the watchdog.

use crate::common;

use cantap_emu::hostile::{CanFaults, Hostile, ReleaseInInit, Tardy, UsbFaults};
use cantap_emu::machine::Setup;
use cantap_emu::otg::Misuse;
use cantap_emu::soc::rcc::Crystal;
use cantap_emu::traffic::{Kind, Traffic};
use cantap_emu::usb_host::{Request, Timing};
use cantap_sim::board::CLOCK;
use cantap_sim::capture::Ledger;
use cantap_sim::hostile::{BACK_WITHIN, try_gateway, try_seed};
use cantap_sim::rig::{MS, Rig, timing};
use cantap_wire::message::{ChannelConfig, Mode, Periodic};
use cantap_wire::{Channel, Command, Refusal};

const MEGABIT: u32 = 1_000_000;
/// Load of both buses, from power-on.
const LOAD_PERCENT: f64 = 30.0;

/// A board with these faults, its buses busy from power-on.
fn board(hostile: Hostile) -> Rig {
    let setup = Setup { hostile: Some(hostile), ..common::setup() };
    let mut rig = Rig::new(common::firmware(), setup, Timing::hasty(CLOCK));
    for channel in Channel::ALL {
        let traffic = Traffic::new(Kind::Mix, channel.index() as u64, LOAD_PERCENT, 0, u64::MAX);
        rig.add_traffic(channel, MEGABIT, traffic);
    }
    rig
}

fn capture(rig: &mut Rig) {
    rig.greet().unwrap();
    for _ in 0..3 {
        for channel in Channel::ALL {
            rig.listen(channel, MEGABIT).unwrap();
        }
        rig.run_for(6 * MS).unwrap();
        for channel in Channel::ALL {
            rig.close(channel).unwrap();
        }
    }
}

/// What is true whatever the silicon does.
fn check(rig: &mut Rig) {
    assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
    assert_eq!(rig.session.corruptions(), []);
    assert_eq!(rig.machine.resets(), 0, "the firmware was restarted");
    assert_eq!(rig.machine.board().odd_accesses(), []);
    assert_eq!(rig.with_host(|_, otg| otg.misuse()), Misuse::default());
    for channel in Channel::ALL {
        assert_eq!(rig.dominant_bits(channel), 0, "a channel that only listens drove the bus");
    }
}

/// Captures, is reset by the host in the middle of a session, captures again, and saves.
fn lives_with(hostile: Hostile) -> Rig {
    let mut rig = board(hostile);
    rig.plug_in().unwrap();
    capture(&mut rig);
    rig.greet().unwrap();
    for channel in Channel::ALL {
        rig.listen(channel, MEGABIT).unwrap();
    }
    rig.run_for(3 * MS).unwrap();
    rig.with_host(cantap_emu::usb_host::UsbHost::reset);
    rig.run_for(8 * MS).unwrap();
    rig.cut();
    rig.wait_for_port().unwrap();
    capture(&mut rig);
    rig.ask(Command::SaveDefaults).unwrap();
    capture(&mut rig);
    check(&mut rig);
    rig
}

fn of_can(can: CanFaults) -> Hostile {
    Hostile { can, ..Hostile::default() }
}

fn of_usb(usb: UsbFaults) -> Hostile {
    Hostile { usb, ..Hostile::default() }
}

/// The bench itself: nothing of this fails on prompt and true silicon.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn prompt_silicon_loses_nothing_and_is_driven_by_the_book() {
    let rig = lives_with(Hostile::default());
    for channel in Channel::ALL {
        assert_eq!(rig.ledger.losses(channel).total(), 0);
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_release_that_takes_long_neither_doubles_nor_loses_a_frame_uncounted() {
    let rig = lives_with(of_can(CanFaults { release: Tardy::always(60), ..CanFaults::default() }));
    for channel in Channel::ALL {
        assert!(rig.ledger.delivered_count(channel) > 20);
    }
}

/// The frames that cannot be taken out are in the way of those that follow, which are counted lost; the device goes on.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_release_that_never_ends_costs_counted_frames_and_not_the_device() {
    let mut rig = board(of_can(CanFaults { release: Tardy::NEVER, ..CanFaults::default() }));
    rig.plug_in().unwrap();
    rig.greet().unwrap();
    for channel in Channel::ALL {
        rig.listen(channel, MEGABIT).unwrap();
    }
    rig.run_for(20 * MS).unwrap();
    rig.be_patient_for(BACK_WITHIN);
    rig.status().unwrap();
    for channel in Channel::ALL {
        rig.close(channel).unwrap();
        assert!(rig.ledger.losses(channel).controller > 0);
    }
    rig.calm();
    capture(&mut rig);
    check(&mut rig);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn no_release_is_needed_in_initialisation_mode() {
    for release_in_init in [ReleaseInInit::Waits, ReleaseInInit::Ignored] {
        for initialisation in [Tardy::PROMPT, Tardy::always(2_000)] {
            lives_with(of_can(CanFaults { release_in_init, initialisation, ..CanFaults::default() }));
        }
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_controller_may_take_its_time_to_leave_its_bus() {
    lives_with(of_can(CanFaults { initialisation: Tardy::always(30_000), ..CanFaults::default() }));
}

/// It is made to leave, by a reset that is late as well.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_controller_that_never_leaves_its_bus_is_reset() {
    let faults = CanFaults {
        initialisation: Tardy { percent: 50, longest_us: 1_000, never_percent: 100 },
        master_reset: Tardy::always(5_000),
        ..CanFaults::default()
    };
    let mut rig = board(of_can(faults));
    rig.plug_in().unwrap();
    rig.be_patient_for(BACK_WITHIN);
    rig.greet().unwrap();
    for _ in 0..4 {
        for channel in Channel::ALL {
            // Not through the books: a controller that does not leave its bus is a refusal, and then it is still open.
            drop(rig.request(Command::Open {
                channel,
                config: Some(ChannelConfig::listen_only(timing(MEGABIT).unwrap())),
            }));
        }
        rig.run_for(2 * MS).unwrap();
        for channel in Channel::ALL {
            drop(rig.request(Command::Close { channel }).unwrap());
        }
    }
    rig.calm();
    rig.ledger = Ledger::new();
    capture(&mut rig);
    check(&mut rig);
}

/// Pins are connected to controllers that have a clock and are stopped, and no connected controller is reset by the clock controller: not
/// at power-on, and not when the firmware starts again after a reset, the buses being busy.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn starting_and_restarting_never_hold_a_live_bus() {
    let faults = CanFaults { reset_sticks_percent: 100, unclocked_is_dominant: true, ..CanFaults::default() };
    let mut rig = lives_with(of_can(faults));
    rig.greet().unwrap();
    rig.ask(Command::Reset).unwrap();
    rig.run_for(100 * MS).unwrap();
    assert_eq!(rig.machine.resets(), 1);
    for channel in Channel::ALL {
        assert_eq!(rig.dominant_bits(channel), 0);
    }
}

/// A reset in the middle of a frame of ours would be an error on the bus.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_reset_that_was_asked_for_cuts_no_frame() {
    for command in [Command::Reset, Command::Bootloader] {
        let mut rig = board(Hostile::default());
        rig.plug_in().unwrap();
        rig.greet().unwrap();
        let config =
            ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing(MEGABIT).unwrap()) };
        for channel in Channel::ALL {
            rig.open(channel, config).unwrap();
            let frame = "7FF#FFFFFFFFFFFFFFFF".parse().unwrap();
            // On the bus for two thirds of the time.
            let entry =
                Periodic { frame, period_ticks: 200 * 12, count: 0, modifiers: [].into_iter().collect() };
            rig.ask(Command::SetPeriodic { channel, slot: 0, entry: Some(entry) }).unwrap();
        }
        rig.ask(command).unwrap();
        // The bootloader itself is not emulated, and ends the run.
        drop(rig.run_for(60 * MS));
        assert_eq!(rig.machine.board().frames_cut(), 0);
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_flush_takes_its_time_and_what_is_written_meanwhile_is_not_lost() {
    lives_with(of_usb(UsbFaults { flush: Tardy::always(150), ..UsbFaults::default() }));
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_core_reset_takes_its_time() {
    lives_with(of_usb(UsbFaults { core_reset: Tardy::always(150), ..UsbFaults::default() }));
}

/// What is written to a core that is still being reset is lost, so that no host would ever see the device.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_core_reset_that_does_not_end_is_asked_for_again() {
    let mut rig = board(of_usb(UsbFaults { core_reset: Tardy::NEVER, ..UsbFaults::default() }));
    rig.run_for(50 * MS).unwrap();
    rig.calm();
    rig.plug_in().unwrap();
    capture(&mut rig);
    check(&mut rig);
}

/// A transmit FIFO is flushed only while the bus is idle (AHBIDL). Until that has happened, what is left in it must not get in front of what
/// is sent next. Of these resets half do not end, and after half of the others the bus does not become idle.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn what_could_not_be_flushed_is_not_sent() {
    let core_reset = Tardy { percent: 50, longest_us: 1, never_percent: 100 };
    for seed in 0..12 {
        let mut rig = board(Hostile { seed, ..of_usb(UsbFaults { core_reset, ..UsbFaults::default() }) });
        rig.be_patient_for(BACK_WITHIN);
        rig.plug_in().unwrap();
        for _ in 0..4 {
            rig.greet().unwrap();
            for channel in Channel::ALL {
                rig.listen(channel, MEGABIT).unwrap();
            }
            rig.with_host(|host, _| host.read(false));
            rig.run_for(3 * MS).unwrap();
            rig.with_host(cantap_emu::usb_host::UsbHost::reset);
            rig.with_host(|host, _| host.read(true));
            rig.run_for(8 * MS).unwrap();
            rig.cut();
            rig.wait_for_port().unwrap();
        }
        check(&mut rig);
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn nak_and_disable_take_their_time() {
    let faults = UsbFaults { nak: Tardy::always(400), disable: Tardy::always(400), ..UsbFaults::default() };
    lives_with(of_usb(faults));
    lives_with(of_usb(UsbFaults { silent_nak: true, ..faults }));
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn an_out_endpoint_is_disabled_under_global_out_nak_or_left_alone() {
    lives_with(of_usb(UsbFaults { out_needs_global_nak: true, ..UsbFaults::default() }));
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn an_impossible_status_is_dropped() {
    for bogus_status_percent in [20, 100] {
        lives_with(of_usb(UsbFaults { bogus_status_percent, ..UsbFaults::default() }));
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn the_end_of_a_setup_stage_comes_with_the_next_token_and_disarms() {
    for (late_setup_complete, setup_complete_disarms) in [(true, false), (false, true), (true, true)] {
        lives_with(of_usb(UsbFaults { late_setup_complete, setup_complete_disarms, ..UsbFaults::default() }));
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn the_flag_of_a_setup_stage_is_cleared() {
    lives_with(of_usb(UsbFaults { stup_blocks: true, ..UsbFaults::default() }));
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_transfer_has_completed_when_its_endpoint_says_so() {
    let mut rig = lives_with(of_usb(UsbFaults { daint_shows_all: true, ..UsbFaults::default() }));
    rig.greet().unwrap();
    rig.listen(Channel::Can1, MEGABIT).unwrap();
    // Control requests complete while a transfer of data is under way.
    rig.with_host(|host, _| host.read(false));
    for _ in 0..20 {
        rig.with_host(|host, _| host.control(Request::endpoint_status(0)));
        rig.run_for(MS).unwrap();
    }
    rig.with_host(|host, _| host.read(true));
    rig.close(Channel::Can1).unwrap();
    check(&mut rig);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn device_mode_is_waited_for() {
    lives_with(of_usb(UsbFaults { device_mode: Tardy::always(25_000), ..UsbFaults::default() }));
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_flash_that_is_busy_for_long_is_waited_for() {
    lives_with(Hostile { flash_busy: Tardy::always(2_000), ..Hostile::default() });
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_flash_that_stays_busy_is_given_up() {
    let mut rig = board(Hostile { flash_busy: Tardy::NEVER, ..Hostile::default() });
    rig.plug_in().unwrap();
    capture(&mut rig);
    // The longest that erasing may take, and a little more.
    rig.be_patient_for(3_000 * MS);
    let response = rig.request(Command::SaveDefaults).unwrap();
    assert_eq!(response.result, Err(Refusal::Hardware));
    capture(&mut rig);
    check(&mut rig);
}

/// The watchdog has its own oscillator: the chip restarts without a crystal, waits for it, and is back. A frame of ours that was on the
/// bus is cut off, and its last bit stays there until then.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_board_whose_crystal_stops_is_back_when_it_starts_again() {
    let setup = Setup { survive_watchdog: true, ..common::setup() };
    let mut rig = Rig::new(common::firmware(), setup, Timing::hasty(CLOCK));
    rig.connect().unwrap();
    let config = ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing(MEGABIT).unwrap()) };
    rig.open(Channel::Can1, config).unwrap();
    rig.set_crystal(Crystal { start_us: None, ..setup.crystal });
    let restarted = rig.run_while(6_000 * MS, |rig| rig.machine.resets() == 0).unwrap();
    assert!(restarted);
    let driven = rig.dominant_bits(Channel::Can1);
    rig.set_crystal(setup.crystal);
    rig.cut();
    rig.wait_for_port().unwrap();
    for channel in Channel::ALL {
        let traffic = Traffic::new(Kind::Mix, 1, LOAD_PERCENT, rig.now(), u64::MAX);
        rig.add_traffic(channel, MEGABIT, traffic);
    }
    capture(&mut rig);
    assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
    assert_eq!(rig.dominant_bits(Channel::Can1), driven);
}

/// Everything at once, decided by seeds. `cantap-sim run FIRMWARE.elf --hostile SEED` tells what happened in one.
fn after_any_storm_the_device_is_back(seeds: std::ops::Range<u64>) {
    let image = common::firmware();
    for seed in seeds {
        let trial = try_seed(image.clone(), seed);
        assert!(trial.faults.is_empty(), "seed {seed}: {:#?}\n{:#?}", trial.faults, trial.story);
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn after_any_storm_a_gateway_is_silent_and_has_counted_every_frame() {
    let image = common::firmware();
    for seed in 0..50 {
        let trial = try_gateway(image.clone(), seed);
        assert!(trial.faults.is_empty(), "seed {seed}: {:#?}\n{:#?}", trial.faults, trial.story);
    }
}

// Two hundred seeds, in parts, so that every core has some.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn after_any_storm_the_device_is_back_and_has_counted_every_frame() {
    after_any_storm_the_device_is_back(0..50);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn after_fifty_other_storms_too() {
    after_any_storm_the_device_is_back(50..100);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn and_after_fifty_more() {
    after_any_storm_the_device_is_back(100..150);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn and_after_the_last_fifty() {
    after_any_storm_the_device_is_back(150..200);
}

/// In 13415, a word before SET_CONFIGURATION's says that 32 bytes for the data endpoint follow, which is not in use yet.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_storm_that_once_won_does_not_again() {
    after_any_storm_the_device_is_back(13_415..13_416);
}
