//! Runs that end early: each says why, where, and from which calls.

use crate::assembly;
use crate::common;

use assembly::{EQ, Program, adds, cmp, ldr, movs, nop, str, udf, wfi};
use cantap_emu::memory_map::{CCM, FLASH, SRAM};
use cantap_emu::usb_host::Timing;
use cantap_emu::{ElfError, Image, Machine, Reason, Setup, Stopped};
use cantap_sim::CYCLES_PER_SECOND;
use cantap_sim::board::{self, CLOCK};
use cantap_sim::firmware::{self, FirmwareError};
use cantap_sim::rig::{Rig, RigError};
use cantap_wire::Command;

const SECOND: u64 = CYCLES_PER_SECOND;
/// Machine numbers in an ELF's header.
const ARM: u16 = 40;
const X86_64: u16 = 62;

fn stop(program: Program, setup: Setup) -> Stopped {
    Machine::new(program.image(), setup).run_until(SECOND).expect_err("the program ends the run")
}

#[test]
fn an_undefined_instruction_is_a_hard_fault_at_its_address() {
    let mut program = Program::new();
    program.handler(1);
    program.put(&[nop(), nop()]);
    let fault = program.here();
    program.put(&[udf()]);
    let stopped = stop(program, board::setup());
    assert!(matches!(stopped.reason, Reason::HardFault([cfsr, ..]) if cfsr & 1 << 16 != 0), "{stopped}");
    assert_eq!(stopped.pc, fault);
}

#[test]
fn an_access_to_nowhere_tells_its_address() {
    let mut program = Program::new();
    program.handler(1);
    program.load(0, CCM.end);
    program.put(&[str(0, 0, 0)]);
    let stopped = stop(program, board::setup());
    assert!(matches!(stopped.reason, Reason::HardFault([_, _, _, bfar]) if bfar == CCM.end), "{stopped}");
}

#[test]
fn an_unfed_watchdog_ends_the_run_or_restarts_the_firmware() {
    let program = || {
        let mut program = Program::new();
        program.handler(1);
        // Count the starts, start the watchdog with its reset values (512 ms), then sleep.
        program.load(0, SRAM.start);
        program.put(&[ldr(1, 0, 0), adds(1, 1), str(1, 0, 0)]);
        program.load(0, 0x4000_3000);
        program.load(1, 0xCCCC);
        program.put(&[str(1, 0, 0)]);
        let sleep = program.here();
        program.put(&[wfi()]);
        program.branch_to(sleep);
        program
    };
    let stopped = stop(program(), board::setup());
    assert_eq!(stopped.reason, Reason::Watchdog);
    // 4 × 4096 ticks of 32 kHz.
    assert_eq!(stopped.at / (SECOND / 1000), 512);
    let mut machine = Machine::new(program().image(), Setup { survive_watchdog: true, ..board::setup() });
    machine.run_until(2 * SECOND).unwrap();
    assert_eq!((machine.resets(), machine.cpu().word(SRAM.start)), (3, Some(4)));
}

#[test]
fn a_requested_reset_restarts_the_firmware_unless_told_otherwise() {
    let program = || {
        let mut program = Program::new();
        // The first two starts request a reset, the third sleeps.
        let sleep = program.here();
        program.put(&[wfi()]);
        program.branch_to(sleep);
        program.handler(1);
        program.load(0, SRAM.start);
        program.put(&[ldr(1, 0, 0), adds(1, 1), str(1, 0, 0), movs(2, 3), cmp(1, 2)]);
        program.branch_if(EQ, sleep);
        program.load(0, 0xE000_ED0C);
        program.load(1, 0x05FA_0004);
        program.put(&[str(1, 0, 0)]);
        let wait = program.here();
        program.branch_to(wait);
        program
    };
    assert_eq!(stop(program(), Setup { stop_on_reset: true, ..board::setup() }).reason, Reason::Reset);
    let mut machine = Machine::new(program().image(), board::setup());
    machine.run_until(SECOND).unwrap();
    assert_eq!((machine.resets(), machine.cpu().word(SRAM.start)), (2, Some(3)));
    assert!(machine.cpu().asleep());
}

/// Runs the firmware with one exception's vector redirected to `target`, until it ends there.
fn bend(number: u32, target: impl Fn(&Image) -> u32) -> (Image, Stopped) {
    let image = common::firmware();
    let mut rig = Rig::new(image.clone(), common::setup(), Timing::new(CLOCK));
    rig.connect().unwrap();
    let vector = FLASH.start + 4 * number;
    let bent = (target(&image) | 1).to_le_bytes();
    assert!(rig.machine.cpu().memory(vector).is_some_and(|flash| flash.write(vector, &bent)));
    match rig.run_for(SECOND / 10) {
        Err(RigError::Stopped(stopped)) => (image, stopped),
        other => panic!("the firmware must end: {other:?}"),
    }
}

/// TIM7 makes the firmware's millisecond.
const TIM7: u32 = 16 + 55;

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_panic_ends_the_run_where_it_began() {
    let panic = |image: &Image| image.address_of("__rustc::rust_begin_unwind").expect("the panic handler");
    let (_, stopped) = bend(TIM7, panic);
    assert_eq!((stopped.reason, &stopped.stack[0][..]), (Reason::Panic, "__rustc::rust_begin_unwind"));
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_fault_in_the_firmware_names_the_function_and_its_callers() {
    // No code: the next instruction is fetched from erased flash.
    let (image, stopped) = bend(TIM7, |_| FLASH.end - 16);
    assert!(matches!(stopped.reason, Reason::HardFault(_)), "{stopped}");
    assert!(FLASH.contains(&stopped.pc) && image.function_at(stopped.pc).is_none());
    assert!(stopped.stack.iter().any(|function| function.starts_with("main")), "{stopped}");
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn entering_the_rom_bootloader_ends_the_run() {
    let image = common::firmware();
    let mut rig = Rig::new(image, common::setup(), Timing::new(CLOCK));
    rig.connect().unwrap();
    let (_, bytes) = rig.session.request(Command::Bootloader);
    rig.with_host(|host, _| host.send(&bytes));
    match rig.run_for(SECOND / 5) {
        Err(RigError::Stopped(stopped)) => assert_eq!(stopped.reason, Reason::Bootloader, "{stopped}"),
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_file_that_cannot_run_is_refused_in_one_line() {
    let elf = |machine: u16, address: u32| {
        let mut bytes = Vec::new();
        bytes.extend([0x7F, b'E', b'L', b'F', 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
        for half in [2, machine] {
            bytes.extend(u16::to_le_bytes(half));
        }
        for word in [1, address | 1, 52, 0, 0] {
            bytes.extend(u32::to_le_bytes(word));
        }
        for half in [52u16, 32, 1, 40, 0, 0] {
            bytes.extend(half.to_le_bytes());
        }
        // One segment of 8 bytes: stack and reset vector.
        for word in [1, 84, address, address, 8, 8, 5, 4, SRAM.end, address + 9] {
            bytes.extend(u32::to_le_bytes(word));
        }
        bytes
    };
    assert!(matches!(firmware::read(b"#!/bin/sh\n"), Err(FirmwareError::Elf { source: ElfError::NotElf })));
    assert!(matches!(
        firmware::read(&elf(X86_64, FLASH.start)),
        Err(FirmwareError::Elf { source: ElfError::OtherMachine { .. } })
    ));
    assert!(matches!(
        firmware::read(&elf(ARM, 0x1_0000)),
        Err(FirmwareError::Elf { source: ElfError::OtherMemoryMap { .. } })
    ));
    assert!(matches!(firmware::read(&elf(ARM, FLASH.start)), Err(FirmwareError::NoProtocolVersion)));
    for bytes in [b"#!/bin/sh\n".to_vec(), elf(X86_64, FLASH.start), elf(ARM, 0), elf(ARM, FLASH.start)] {
        let message = firmware::read(&bytes).unwrap_err().to_string();
        assert!(!message.contains('\n') && message.len() > 20, "{message}");
    }
    let newer = FirmwareError::ProtocolMismatch { firmware: cantap_wire::PROTOCOL_VERSION + 1 };
    assert!(newer.to_string().ends_with("update the emulator"));
}
