//! The firmware's dealings with the chip itself, on the ELF: memory, LEDs, restarts.

use crate::common;

use cantap_emu::machine::Setup;
use cantap_emu::traffic::{Kind, Traffic};
use cantap_emu::usb_host::Timing;
use cantap_sim::CYCLES_PER_SECOND;
use cantap_sim::board::CLOCK;
use cantap_sim::rig::{MS, Rig, RigError};
use cantap_wire::message::{Filter, FrameKind, MAX_FILTERS};
use cantap_wire::{Channel, Command};

/// The stack's region in `memory.x`, at the start of the core-coupled memory.
const STACK: u32 = 0x1000_0000;
const STACK_LEN: usize = 24 * 1024;
/// The reset vector of the ROM bootloader, as the emulator has it.
const ROM_ENTRY: u32 = 0x1FFF_3DA5;

fn connected(setup: Setup) -> Rig {
    let mut rig = Rig::new(common::firmware(), setup, Timing::hasty(CLOCK));
    rig.connect().unwrap();
    rig
}

/// PC12 of the Olimex STM32-P405, low when lit.
fn led_is_lit(rig: &Rig) -> bool {
    rig.machine.board().output_pin(2, 12) == Some(false)
}

/// How often the LED changes in this many milliseconds.
fn led_changes(rig: &mut Rig, ms: u64) -> usize {
    let mut lit = Vec::new();
    for _ in 0..ms {
        rig.run_for(MS).unwrap();
        lit.push(led_is_lit(rig));
    }
    lit.windows(2).filter(|pair| pair[0] != pair[1]).count()
}

/// An overflow would fault, so a quarter of the stack is kept in reserve for what these tests do not reach.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn the_stack_is_never_used_beyond_three_quarters() {
    let mut rig = connected(common::setup());
    let filters: Vec<Filter> = (0..MAX_FILTERS as u32)
        .map(|id| Filter { extended: false, kind: FrameKind::Data, id, mask: 0x7FF })
        .collect();
    let filters = filters.into_iter().collect();
    rig.ask(Command::SetFilters { channel: Channel::Can2, filters }).unwrap();
    for channel in Channel::ALL {
        rig.listen(channel, 1_000_000).unwrap();
        let from = rig.now() + MS;
        rig.add_traffic(channel, 1_000_000, Traffic::new(Kind::Mix, 7, 100.0, from, from + 20 * MS));
    }
    rig.run_for(30 * MS).unwrap();
    rig.ask(Command::Status).unwrap();
    rig.ask(Command::Registers { channel: Channel::Can1 }).unwrap();
    for channel in Channel::ALL {
        rig.close(channel).unwrap();
    }
    rig.ask(Command::SaveDefaults).unwrap();
    rig.ask(Command::Defaults { channel: Channel::Can2 }).unwrap();
    rig.ask(Command::Open { channel: Channel::Can2, config: None }).unwrap();
    let mut stack = vec![0; STACK_LEN];
    assert!(rig.machine.cpu().memory(STACK).unwrap().read(STACK, &mut stack));
    // Memory is zero at power-on, and the deepest word ever pushed is not.
    let untouched = stack.iter().take_while(|&&byte| byte == 0).count();
    let used = STACK_LEN - untouched;
    println!("deepest use of the stack: {used} of {STACK_LEN} bytes");
    assert!(used > 0 && used <= STACK_LEN * 3 / 4, "{used} bytes");
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_quiet_device_shows_a_steady_light_and_blinks_when_asked() {
    let mut rig = connected(common::setup());
    assert_eq!(led_changes(&mut rig, 300), 0);
    assert!(led_is_lit(&rig));
    rig.ask(Command::Identify { seconds: 1 }).unwrap();
    // 120 ms a period.
    assert!((7..=10).contains(&led_changes(&mut rig, 500)));
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn traffic_and_errors_show_on_the_light() {
    let mut rig = connected(common::setup());
    rig.listen(Channel::Can1, 1_000_000).unwrap();
    let from = rig.now() + MS;
    rig.add_traffic(Channel::Can1, 1_000_000, Traffic::new(Kind::Std8, 3, 10.0, from, from + 400 * MS));
    // It flickers at 10 Hz.
    assert!((6..=9).contains(&led_changes(&mut rig, 400)));
}

/// What follows is ST's ROM, of which the emulator has only the vectors: the run ends at its first instruction.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn the_bootloader_is_entered_after_the_answer_is_sent() {
    let mut rig = connected(common::setup());
    rig.ask(Command::Bootloader).unwrap();
    let Err(RigError::Stopped(stopped)) = rig.run_for(CYCLES_PER_SECOND) else { panic!("it went on") };
    assert_eq!((stopped.pc | 1, rig.machine.resets()), (ROM_ENTRY, 1));
}
