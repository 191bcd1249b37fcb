//! How the firmware starts: after power-on, after the ROM bootloader, with a crystal that is slow or broken, and after a
//! failed run.

use crate::assembly;
use crate::common;

use assembly::{Program, ldr, movs, str};
use cantap_emu::can::Mode;
use cantap_emu::machine::{Machine, Setup};
use cantap_emu::memory_map::{FLASH, SRAM};
use cantap_emu::rom::{self, Start};
use cantap_emu::soc::rcc::{CRYSTAL_START_US, Crystal};
use cantap_emu::stop::Reason;
use cantap_emu::usb_host::Timing;
use cantap_sim::CYCLES_PER_US;
use cantap_sim::board::{self, CLOCK};
use cantap_sim::rig::{MS, Rig, RigError};
use cantap_wire::message::{ChannelConfig, Failures};
use cantap_wire::{Channel, Command, Reply};

/// GPIO registers.
const MODER: u32 = 0x00;
const OSPEEDR: u32 = 0x08;
const PUPDR: u32 = 0x0C;
/// Their values.
const INPUT: u32 = 0b00;
const ALTERNATE: u32 = 0b10;
const PULL_UP: u32 = 0b01;
const AFRL: u32 = 0x20;
/// The alternate function of the CAN controllers.
const AF_CAN: u32 = 9;

fn crystal(hz: u64) -> Crystal {
    Crystal { hz, start_us: Some(CRYSTAL_START_US) }
}

fn behind_the_bootloader(hz: u64) -> Setup {
    Setup { start: Start::Bootloader, crystal: crystal(hz), ..board::setup() }
}

/// A rig whose firmware is running and has been greeted.
fn connected(name: &str, setup: Setup) -> Rig {
    let mut rig = Rig::new(common::board(name), setup, Timing::hasty(CLOCK));
    rig.connect().unwrap_or_else(|error| panic!("{name}: {error}"));
    rig
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn every_board_starts_behind_the_rom_bootloader() {
    for (name, hz, _) in common::boards() {
        let rig = connected(name, behind_the_bootloader(hz));
        let board = rig.machine.board();
        let clocks = board.rcc.clocks();
        assert_eq!((clocks.sysclk_hz, clocks.pclk1_hz, clocks.usb_hz), (144_000_000, 36_000_000, 48_000_000));
        assert_eq!((rig.machine.cpu().vector_table(), board.memory_at_zero()), (FLASH.start, rom::FLASH));
        assert_eq!(board.odd_accesses(), [], "{name}");
    }
}

/// A host must see the bootloader's device disconnect, or it goes on talking to it.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn the_bootloaders_usb_device_goes_before_ours_comes() {
    let image = common::firmware();
    let mut rig = Rig::new(image, behind_the_bootloader(8_000_000), Timing::hasty(CLOCK));
    rig.with_host(|host, _| host.plug());
    rig.machine.run_until(1).unwrap();
    assert!(rig.with_host(|_, otg| otg.pulled_up(true)), "the bootloader's device is there");
    let step = 100 * CYCLES_PER_US;
    let mut gone = 0;
    let mut back = false;
    while !back && rig.now() < 200 * MS {
        rig.machine.run_until(rig.now() + step).unwrap();
        let here = rig.with_host(|_, otg| otg.pulled_up(true));
        gone += u64::from(!here) * step;
        back = gone > 0 && here;
    }
    assert!(back && gone >= 10 * MS, "gone for {} us", gone / CYCLES_PER_US);
}

/// The bootloader leaves the flash interface open, with uncleared errors.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn defaults_are_saved_behind_the_bootloader() {
    save_defaults(behind_the_bootloader(8_000_000), |_| {});
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn defaults_are_saved_whatever_error_the_flash_shows() {
    save_defaults(board::setup(), |rig| rig.machine.board().leave_flash_error());
}

fn save_defaults(setup: Setup, before: fn(&mut Rig)) {
    let mut rig = connected("olimex-p405", setup);
    for (channel, bitrate_bps) in [(Channel::Can1, 125_000), (Channel::Can2, 500_000)] {
        before(&mut rig);
        let config = ChannelConfig::listen_only(cantap_sim::rig::timing(bitrate_bps).unwrap());
        rig.ask(Command::Configure { channel, config }).unwrap();
        assert_eq!(rig.ask(Command::SaveDefaults).unwrap(), Reply::Done);
        let Reply::Defaults(saved) = rig.ask(Command::Defaults { channel }).unwrap() else { panic!() };
        assert_eq!(saved.config, config);
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn the_rom_bootloader_finds_its_memory_at_zero_and_its_vectors_there() {
    let mut rig = connected("olimex-p405", board::setup());
    rig.ask(Command::Bootloader).unwrap();
    let Err(RigError::Stopped(stopped)) = rig.run_for(100 * MS) else { panic!("it goes on") };
    assert_eq!(stopped.reason, Reason::Bootloader);
    let board = rig.machine.board();
    assert_eq!((board.memory_at_zero(), rig.machine.cpu().vector_table()), (rom::SYSTEM_MEMORY, 0));
    assert_eq!(board.odd_accesses(), []);
}

/// What the chip's errata sheet says about a peripheral whose clock was just switched on, in the emulator: a store directly
/// afterwards is lost, one after a barrier is not.
#[test]
fn a_peripheral_is_there_only_some_cycles_after_its_clock_was_switched_on() {
    let mode = |barrier: &[u16]| {
        let mut program = Program::new();
        program.handler(1);
        // RCC_APB2ENR, SYSCFGEN; SYSCFG_MEMRMP.
        program.load(0, 0x4002_3844);
        program.load(1, 1 << 14);
        program.load(2, 0x4001_3800);
        program.put(&[movs(3, 1), str(1, 0, 0)]);
        program.put(barrier);
        program.put(&[str(3, 2, 0)]);
        let end = program.here();
        program.branch_to(end);
        let mut machine = Machine::new(program.image(), board::setup());
        machine.run_until(100).unwrap();
        let board = machine.board();
        (board.memory_at_zero(), board.odd_accesses().len())
    };
    assert_eq!(mode(&[]), (rom::FLASH, 1));
    // DSB.
    assert_eq!(mode(&[0xF3BF, 0x8F4F]), (rom::SYSTEM_MEMORY, 0));
    // LDR r1, [r0]: the register read back.
    assert_eq!(mode(&[ldr(1, 0, 0)]), (rom::SYSTEM_MEMORY, 0));
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn edges_of_the_can_tx_pins_are_fast_on_every_board() {
    for (name, hz, pins) in common::boards() {
        let setup = Setup { crystal: crystal(hz), ..board::setup() };
        let mut rig = connected(name, setup);
        for channel in Channel::ALL {
            rig.listen(channel, 500_000).unwrap();
        }
        for (port, pin) in pins {
            let board = rig.machine.board();
            let gpio = board.port(port).unwrap();
            let function = gpio.read(AFRL + 4 * (pin / 8)).unwrap() >> (4 * (pin % 8)) & 0xF;
            let speed = gpio.read(OSPEEDR).unwrap() >> (2 * pin) & 3;
            assert_eq!((function, speed), (AF_CAN, 0b10), "{name}, port {port}, pin {pin}");
        }
    }
}

/// On a live bus, TX must not show what a controller does while it is reset or has no clock. Until it is connected, a pull-up keeps it
/// recessive.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_tx_pin_is_connected_only_to_a_controller_that_has_been_stopped() {
    for (name, hz, pins) in common::boards() {
        let mut rig = connected(name, Setup { crystal: crystal(hz), ..board::setup() });
        // Mode, pull resistor, and whether the controller's clock and initialisation mode are on.
        let look = |rig: &Rig, channel: Channel| {
            let (port, pin) = pins[channel.index()];
            let board = rig.machine.board();
            let gpio = board.port(port).unwrap();
            let two_bits = |register: u32| gpio.read(register).unwrap() >> (2 * pin) & 3;
            (two_bits(MODER), two_bits(PUPDR), board.can.controllers[channel.index()].mode())
        };
        for channel in Channel::ALL {
            let (mode, pull, _) = look(&rig, channel);
            assert_eq!((mode, pull), (INPUT, PULL_UP), "{name}, {channel:?}");
        }
        let config = ChannelConfig::listen_only(cantap_sim::rig::timing(500_000).unwrap());
        let (_, open) = rig.session.request(Command::Open { channel: Channel::Can1, config: Some(config) });
        rig.with_host(|host, _| host.send(&open));
        let connected = |rig: &Rig| look(rig, Channel::Can1).0 == ALTERNATE;
        let came = (0..20_000).find(|_| {
            rig.run_for(CYCLES_PER_US / 8).unwrap();
            connected(&rig)
        });
        assert!(came.is_some(), "{name}");
        let (_, _, mode) = look(&rig, Channel::Can1);
        assert!(
            matches!(mode, Mode::Initialisation | Mode::Synchronising { .. }),
            "{name}: connected while the controller was in {mode:?}"
        );
        assert_eq!(look(&rig, Channel::Can2).0, INPUT, "{name}: the other channel was not asked for");
    }
}

/// Powered by its other connector, a board that pulls the USB line up with no host there feeds a host that is off.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_board_that_can_sense_vbus_shows_itself_only_when_it_is_there() {
    for (name, hz, _) in common::boards() {
        let mut rig = connected(name, Setup { crystal: crystal(hz), ..board::setup() });
        let shown = rig.with_host(|_, otg| [true, false].map(|vbus| otg.pulled_up(vbus)));
        assert_eq!(shown, [true, name != "stm32f4-discovery"], "{name}");
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_debugger_keeps_its_connection_while_the_processor_sleeps() {
    let rig = connected("olimex-p405", board::setup());
    assert_eq!(rig.machine.board().debug_control() & 1, 1);
}

/// The firmware waits 100 ms at HSI's frequency; the emulator's time passes at 144 MHz, where that takes 15 ms.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_crystal_that_is_slow_is_waited_for() {
    let slow = Crystal { hz: 8_000_000, start_us: Some(5 * CRYSTAL_START_US) };
    connected("olimex-p405", Setup { crystal: slow, ..board::setup() });
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_crystal_that_does_not_start_is_told_by_the_led_and_tried_again() {
    let image = common::firmware();
    let broken = Crystal { hz: 8_000_000, start_us: None };
    let mut rig = Rig::new(image, Setup { crystal: broken, ..board::setup() }, Timing::hasty(CLOCK));
    // A millisecond of the firmware, which runs from HSI: 16 000 cycles, of which its delay loop takes a third more here.
    let ms = 21_333;
    // How long it was dark before each flash.
    let mut dark_ms = Vec::new();
    let mut dark_since = Some(0);
    while dark_ms.len() < 6 && rig.now() < 4_000 * ms {
        rig.machine.run_until(rig.now() + ms).unwrap();
        // PC12 of the Olimex STM32-P405, low when lit.
        let lit = rig.machine.board().output_pin(2, 12) == Some(false);
        match (lit, dark_since) {
            (true, Some(since)) => {
                dark_ms.push((rig.now() - since) / ms);
                dark_since = None;
            }
            (false, None) => dark_since = Some(rig.now()),
            _ => {}
        }
    }
    // Three flashes, and three more after it has started again.
    let long: Vec<bool> = dark_ms.iter().map(|dark_ms| *dark_ms > 900).collect();
    assert_eq!(
        (rig.machine.resets(), &long[..]),
        (1, &[false, false, false, true, false, false][..]),
        "{dark_ms:?}"
    );
}

fn failures(rig: &mut Rig) -> Failures {
    match rig.ask(Command::Failures).unwrap() {
        Reply::Failures(failures) => failures,
        other => panic!("{other:?}"),
    }
}

/// TIM7 makes the firmware's millisecond.
const TIM7: u32 = 55;

/// What the panic in the test says.
const PANIC: &str = "panicked at src/a.rs:7:5: index out of bounds: the len is 3 but the index is 5";

fn words(words: &[u32]) -> Vec<u8> {
    words.iter().flat_map(|word| word.to_le_bytes()).collect()
}

/// Redirects TIM7's vector to `target`, lets the firmware fail there, and restores it, so that the next run does not fail.
fn fail_once(rig: &mut Rig, target: u32) {
    let vector = FLASH.start + 4 * (16 + TIM7);
    let flash = rig.machine.cpu().memory(vector).unwrap().clone();
    let right = flash.word(vector).unwrap();
    assert!(flash.write(vector, &(target | 1).to_le_bytes()));
    let resets = rig.machine.resets();
    assert!(rig.run_while(100 * MS, |rig| rig.machine.resets() == resets).unwrap(), "it did not restart");
    rig.cut();
    assert!(flash.write(vector, &right.to_le_bytes()));
    // The host sees the device disconnect at its next frame.
    rig.run_for(5 * MS).unwrap();
    rig.wait_for_port().unwrap();
    rig.greet().unwrap();
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn the_last_failure_outlives_the_restart_and_can_be_asked_for() {
    let setup = Setup { survive_failures: true, survive_watchdog: true, ..board::setup() };
    let mut rig = connected("olimex-p405", setup);
    assert_eq!(failures(&mut rig), Failures::default());

    // A panic as caused by an index out of range in line 7 of `src/a.rs`: index, length and location in registers.
    let panic =
        rig.machine.image().address_of("core::panicking::panic_bounds_check").expect("slices are indexed");
    let ram = rig.machine.cpu().memory(SRAM.start).unwrap().clone();
    let [file, location] = [SRAM.end - 48, SRAM.end - 32];
    assert!(ram.write(file, b"src/a.rs\0") && ram.write(location, &words(&[file, 8, 7, 5])));
    // LDR r0, r1, r2, r3 from after the code; BX r3.
    let halves: [u16; 6] = [0x4802, 0x4903, 0x4A03, 0x4B04, 0x4718, 0xBF00];
    let bytes = [halves.map(u16::to_le_bytes).concat(), words(&[5, 3, location, panic | 1])].concat();
    let code = FLASH.start + 0xC_0000;
    assert!(rig.machine.cpu().memory(code).unwrap().clone().write(code, &bytes));
    fail_once(&mut rig, code);
    let told = failures(&mut rig);
    assert_eq!((told.count, told.last.as_str()), (1, PANIC));

    // No code: the next instruction is fetched from erased flash.
    fail_once(&mut rig, FLASH.end - 16);
    let told = failures(&mut rig);
    assert_eq!(told.count, 2);
    assert!(
        told.last.starts_with("HardFault at PC 080F") && told.last.contains("HFSR 40000000"),
        "{}",
        told.last
    );

    // A tick that never comes.
    rig.with_host(|host, _| host.unplug());
    rig.machine.hold_lines(1 << TIM7);
    assert!(rig.run_while(6_000 * MS, |rig| rig.machine.resets() < 3).unwrap());
    rig.machine.hold_lines(0);
    rig.cut();
    rig.connect().unwrap();
    let told = failures(&mut rig);
    assert_eq!(told.count, 3);
    assert!(told.last.starts_with("watchdog"), "{}", told.last);
    // Asking does not clear it.
    assert_eq!(failures(&mut rig), told);
}
