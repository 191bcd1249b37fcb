//! The chip as the ROM bootloader leaves it when it starts a program (`dfu-util -s …:leave`).
//!
//! The bootloader undoes next to nothing: "the Jump to application works only if the user application sets the vector table
//! correctly" (AN3156). What it sets up is in AN2606, "STM32F40xxx/41xxx devices": HSE and PLL for USB, the pins of both USARTs,
//! CAN2 and USB, SysTick and a timer to measure the crystal. candleLight_fw's pull request 319 deals with the VTOR it leaves,
//! numworks/epsilon's 329 with the PLL it leaves running. The PLL's factors are not published: here they give USB its 48 MHz and
//! the core the 60 MHz that AN2606 gives. What a real chip leaves may be less than this.

use super::rcc::CRYSTAL_START_US;
use super::{Board, flash};
use crate::cpu::Cpu;
use crate::memory_map as map;
use crate::rom::SYSTEM_MEMORY;

const RCC: u32 = 0x4002_3800;
const CR: u32 = RCC;
const PLLCFGR: u32 = RCC + 0x04;
const CFGR: u32 = RCC + 0x08;
const AHB1ENR: u32 = RCC + 0x30;
const AHB2ENR: u32 = RCC + 0x34;
const APB1ENR: u32 = RCC + 0x40;
const APB2ENR: u32 = RCC + 0x44;
const FLASH_INTERFACE: u32 = 0x4002_3C00;
const GPIOA: u32 = 0x4002_0000;
const GPIOB: u32 = 0x4002_0400;
const GPIOC: u32 = 0x4002_0800;
const CAN2_MCR: u32 = 0x4000_6800;
const OTG_GCCFG: u32 = map::OTG_FS.start + 0x38;
const OTG_GAHBCFG: u32 = map::OTG_FS.start + 0x08;
const OTG_GINTMSK: u32 = map::OTG_FS.start + 0x18;
const OTG_DCTL: u32 = map::OTG_FS.start + 0x804;

impl Board {
    /// Does what the bootloader does, in the same way: by writing registers. Returns the least time that takes.
    fn run_bootloader(&mut self) -> u64 {
        self.boot_mode = SYSTEM_MEMORY;
        self.syscfg = super::board::syscfg(SYSTEM_MEMORY);
        let mhz = (self.crystal.hz / 1_000_000) as u32;
        let mut now = 0;
        // 1 MHz × 240 / 4 = 60 MHz, / 5 = 48 MHz.
        self.put(&mut now, PLLCFGR, mhz | 240 << 6 | 1 << 16 | 1 << 22 | 5 << 24, 0);
        // HSI, HSE and the PLL, watched by the clock security system.
        self.put(&mut now, CR, 0x83 | 1 << 16 | 1 << 19 | 1 << 24, 2 * self.clock().us(CRYSTAL_START_US));
        // One wait state, as 60 MHz require (RM0090 Rev 21, Table 11).
        self.put(&mut now, FLASH_INTERFACE, 1, 0);
        self.put(&mut now, CFGR, 2 | 4 << 10, 1);
        self.put(&mut now, AHB1ENR, 0x0010_0000 | 0b111, 0);
        self.put(&mut now, AHB2ENR, 1 << 7, 0);
        // CAN1, CAN2 and USART3; USART1, SYSCFG and TIM11.
        self.put(&mut now, APB1ENR, 1 << 18 | 1 << 25 | 1 << 26, 0);
        self.put(&mut now, APB2ENR, 1 << 4 | 1 << 14 | 1 << 18, 1);
        // PA9 and PA10, PA11 and PA12; PB5 and PB13, PB10 and PB11; PC10 and PC11: alternate functions.
        self.put(&mut now, GPIOA, 0xA800_0000 | 0b10_10_10_10 << 18, 0);
        self.put(&mut now, GPIOA + 0x24, 0x000A_A770, 0);
        self.put(&mut now, GPIOB, 0x280 | 0b10 << 10 | 0b10 << 26 | 0b10_10 << 20, 0);
        self.put(&mut now, GPIOB + 0x20, 0x0090_0000, 0);
        self.put(&mut now, GPIOB + 0x24, 0x0090_7700, 0);
        self.put(&mut now, GPIOC, 0b10_10 << 20, 0);
        self.put(&mut now, GPIOC + 0x24, 0x7700, 0);
        // CAN2 out of sleep, on its way to the bus.
        self.put(&mut now, CAN2_MCR, 1 << 6, 0);
        // USB with its pull-up, and its interrupts on.
        self.put(&mut now, OTG_GCCFG, 1 << 16 | 1 << 21, 0);
        self.put(&mut now, OTG_DCTL, 0, 0);
        self.put(&mut now, OTG_GAHBCFG, 1, 0);
        self.put(&mut now, OTG_GINTMSK, 1 << 3 | 1 << 12 | 1 << 13, 0);
        for key in flash::KEYS {
            self.put(&mut now, FLASH_INTERFACE + 0x04, key, 0);
        }
        self.flash.leave_error(flash::PGSERR | flash::PGPERR);
        now
    }

    fn put(&mut self, now: &mut u64, address: u32, value: u32, then_wait: u64) {
        self.write(address, 4, value, *now);
        self.barrier();
        *now += then_wait;
    }
}

/// Brings board and core to the point at which the bootloader starts the program in flash.
pub fn leave(board: &mut Board, cpu: &mut Cpu) {
    let took = board.run_bootloader();
    cpu.leave_bootloader();
    cpu.pass(took);
    cpu.show_at_zero(true);
}
