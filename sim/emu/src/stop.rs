//! Why a run ended early, in words that help somebody act on it.

use std::fmt;

use crate::Clock;
use crate::cpu::Cpu;
use crate::elf::Image;
use crate::memory_map as map;

/// Most frames of a call stack to look for.
const MAX_DEPTH: usize = 32;
/// Bytes of stack to search for them.
const MAX_STACK: u32 = 8 * 1024;

/// Why the firmware cannot continue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reason {
    /// A fault, with CFSR, HFSR, MMFAR and BFAR.
    HardFault([u32; 4]),
    /// A fault while handling a fault.
    LockUp,
    /// The watchdog was not fed in time.
    Watchdog,
    /// It panicked.
    Panic,
    /// It requested a reset, and the run was set up to end there.
    Reset,
    /// It jumped to the ROM bootloader, which is not emulated.
    Bootloader,
}

/// The end of a run.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub struct Stopped {
    /// Why.
    pub reason: Reason,
    /// Core cycle.
    pub at: u64,
    /// How long a cycle is.
    pub clock: Clock,
    /// The instruction it happened at.
    pub pc: u32,
    /// Functions on the stack, the innermost first. Found by searching the stack for return addresses,
    /// so there may be stale ones among them.
    pub stack: Vec<String>,
}

impl fmt::Display for Stopped {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.reason {
            Reason::HardFault([cfsr, hfsr, mmfar, bfar]) => write!(
                f,
                "HardFault (CFSR {cfsr:#010x}, HFSR {hfsr:#010x}, MMFAR {mmfar:#010x}, BFAR {bfar:#010x})"
            )?,
            Reason::LockUp => f.write_str("the core locked up")?,
            Reason::Watchdog => f.write_str("the watchdog was not fed")?,
            Reason::Panic => f.write_str("the firmware panicked")?,
            Reason::Reset => f.write_str("the firmware asked for a reset")?,
            Reason::Bootloader => f.write_str("the firmware entered the ROM bootloader")?,
        }
        write!(f, " at {} us, PC {:#010x}", self.at / self.clock.us(1), self.pc)?;
        for function in &self.stack {
            write!(f, "\n    {function}")?;
        }
        Ok(())
    }
}

impl Stopped {
    /// Describes where the core is now. In a fault handler, that is where the fault came from.
    pub(crate) fn here(reason: Reason, clock: Clock, cpu: &Cpu, image: &Image) -> Self {
        let state = cpu.state();
        let [mut pc, mut lr, mut sp] = [state.pc, state.lr, state.sp];
        if matches!(reason, Reason::HardFault(_) | Reason::LockUp) {
            // The frame the fault pushed: R0 to R3, R12, LR, PC, xPSR.
            pc = cpu.word(sp.wrapping_add(24)).unwrap_or(pc);
            lr = cpu.word(sp.wrapping_add(20)).unwrap_or(lr);
            sp = sp.wrapping_add(32);
        }
        let mut stack = vec![image.describe(pc)];
        // The link register, then the stack; each word with the address above it.
        let words = (0..MAX_STACK / 4).map(|word| sp.wrapping_add(4 * word));
        let words = words.map_while(|at| Some((cpu.word(at)?, at.wrapping_add(4))));
        for (word, above) in std::iter::once((lr, sp)).chain(words) {
            let caller = if is_exception_return(word) {
                // A handler's return value is directly below the frame of what it interrupted.
                cpu.word(above.wrapping_add(24)).filter(|pc| map::FLASH.contains(pc))
            } else {
                is_return_address(word, cpu).then_some(word & !1)
            };
            let Some(name) = caller.map(|address| image.describe(address)) else { continue };
            if stack.len() < MAX_DEPTH && stack.last() != Some(&name) {
                stack.push(name);
            }
        }
        Self { reason, at: cpu.now(), clock, pc, stack }
    }
}

/// Whether a word is an exception return value, as a handler finds it in its link register.
fn is_exception_return(word: u32) -> bool {
    matches!(word | 0x10, 0xFFFF_FFF1 | 0xFFFF_FFF9 | 0xFFFF_FFFD)
}

/// Whether a word is the address after a call: odd, in flash, and preceded by BL or BLX.
fn is_return_address(word: u32, cpu: &Cpu) -> bool {
    let address = word & !1;
    if word & 1 == 0 || !map::FLASH.contains(&address) {
        return false;
    }
    let Some(before) = cpu.word(address.wrapping_sub(4)) else { return false };
    let (first, second) = (before as u16, (before >> 16) as u16);
    let long_call = first & 0xF800 == 0xF000 && second & 0xD000 == 0xD000;
    let register_call = second & 0xFF80 == 0x4780;
    long_call || register_call
}
