//! The emulator itself must survive any input: files that are not quite ELFs, and programs that are not quite
//! programs.

use crate::common;

use std::sync::{Arc, Mutex};

use cantap_emu::memory_map::{FLASH, OTG_FS, OTG_FS_IRQ, SRAM};
use cantap_emu::usb::UsbPort;
use cantap_emu::usb_host::Timing;
use cantap_emu::{Image, Machine, Setup};
use cantap_sim::board::{self, CLOCK};
use cantap_sim::firmware;
use fastrand::Rng;

/// Random halfwords, with stores to random registers of known peripherals among them.
fn random_program(random: &mut Rng) -> Image {
    const BASES: [u32; 16] = [
        0x4000_0000,
        0x4000_1400,
        0x4000_3000,
        0x4000_6400,
        0x4000_6600,
        0x4000_6800,
        0x4001_2000,
        0x4002_0000,
        0x4002_3800,
        0x4002_3C00,
        0x5000_0000,
        0x5000_0800,
        0x5000_0900,
        0x5000_0B00,
        0x5000_1000,
        0xE000_E100,
    ];
    let mut code: Vec<u16> = Vec::new();
    let put_word = |code: &mut Vec<u16>, rd: u16, value: u32| {
        // MOVW and MOVT.
        for (high, half) in [(false, value as u16), (true, (value >> 16) as u16)] {
            let op = if high { 0xF2C0 } else { 0xF240 };
            code.push(op | (half >> 12) | (half >> 1 & 0x400));
            code.push((half >> 8 & 7) << 12 | rd << 8 | half & 0xFF);
        }
    };
    // All clocks on, so that the registers behind them can be reached.
    for register in [0x30, 0x34, 0x40, 0x44] {
        put_word(&mut code, 0, 0x4002_3800 + register);
        put_word(&mut code, 1, u32::MAX);
        code.push(0x6001);
    }
    for _ in 0..random.usize(20..400) {
        if random.u8(..4) == 0 {
            code.push(random.u16(..));
            continue;
        }
        let base = BASES[random.usize(..BASES.len())];
        put_word(&mut code, 0, base + 4 * random.u32(..0x80));
        let value = if random.bool() { random.u32(..) } else { 1 << random.u32(..32) };
        put_word(&mut code, 1, value);
        // STR, LDR, STRH or STRB r1, [r0].
        code.push([0x6001, 0x6801, 0x8001, 0x7001][random.usize(..4)]);
    }
    code.push(0xE7FE);
    let reset = FLASH.start + 0x200;
    let mut flash: Vec<u8> = (0..0x80).flat_map(|_| (reset | 1).to_le_bytes()).collect();
    flash[..4].copy_from_slice(&(SRAM.end - 16).to_le_bytes());
    flash.extend(code.into_iter().flat_map(u16::to_le_bytes));
    Image::raw(flash)
}

#[test]
fn no_program_brings_the_emulator_down() {
    let mut random = Rng::with_seed(4);
    let mut ended = 0;
    for _ in 0..2000 {
        let setup = Setup { survive_watchdog: true, joined: random.bool(), ..board::setup() };
        let mut machine = Machine::new(random_program(&mut random), setup);
        let mut usb = UsbPort::new(Timing::new(CLOCK));
        usb.host(0).0.plug();
        machine.attach(OTG_FS, OTG_FS_IRQ, Arc::new(Mutex::new(usb)));
        ended += u32::from(machine.run_until(30_000).is_err());
    }
    assert!(ended > 100, "random code faults now and then: {ended}");
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn no_damaged_elf_brings_the_loader_down() {
    let path = common::elf();
    let whole = std::fs::read(path).unwrap();
    let mut random = Rng::with_seed(5);
    let mut refused = 0;
    for _ in 0..300 {
        let mut bytes = whole.clone();
        if random.bool() {
            bytes.truncate(random.usize(..whole.len()));
        }
        for _ in 0..random.usize(..8) {
            // Mostly where headers are.
            let region = if random.bool() { 0x120 } else { bytes.len() };
            let at = random.usize(..region.max(1));
            if let Some(byte) = bytes.get_mut(at) {
                *byte = random.u8(..);
            }
        }
        match firmware::read(&bytes) {
            Ok(image) => {
                let mut machine = Machine::new(image, board::setup());
                let _ = machine.run_until(20_000);
            }
            Err(error) => {
                assert!(!error.to_string().contains('\n'));
                refused += 1;
            }
        }
    }
    assert!(refused > 50, "{refused}");
}
