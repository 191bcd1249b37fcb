//! The processor: a thin module over rsemu's Cortex-M4F, the only one that knows its API, so that the
//! core can be exchanged. It counts the cycles, owns flash and RAM, and mends two defects of rsemu 0.0.7
//! around IT blocks (`docs/upstream-rsemu.md`).
//!
//! The core's cycles are a lower bound of a real one's: one per instruction, one more per data access,
//! two per taken branch, 12 and 10 for exception entry and return; no flash wait states, no bus delays.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use rsemu::core::error::BusError;
use rsemu::core::space::{
    AccessConstraints, AddressSpace, DispatchPolicy, Mapping, MemAttrs, MemOps, MemResult, Perms, RamStore,
    Region,
};
use rsemu::cpu::arm::v7m::sys::Exception;
use rsemu::cpu::arm::v7m::{ArmV7m, Config, Regs, xpsr};

use crate::memory_map as map;

/// A table of 64 KiB pages finds memories and peripherals faster than a search; the few above it are
/// searched for.
const PAGES: DispatchPolicy = DispatchPolicy::Dense { page_bits: 16, cover: map::PERIPHERALS.end as u64 };

/// Everything the core reaches that is not memory. The addresses are absolute.
pub trait Bus: Send + Sync {
    /// Reads 1, 2 or 4 bytes; `None` is a bus fault.
    fn read(&self, address: u32, size: u8, now: u64) -> Option<u32>;
    /// Writes 1, 2 or 4 bytes; `None` is a bus fault.
    fn write(&self, address: u32, size: u8, value: u32, now: u64) -> Option<()>;
}

/// A window of the address space that goes to the [`Bus`].
struct Window {
    base: u32,
    bus: Arc<dyn Bus>,
    clock: Arc<AtomicU64>,
    touched: Arc<AtomicBool>,
}

impl fmt::Debug for Window {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Window({:#010x})", self.base)
    }
}

impl Window {
    /// The access is to be followed by a look at the interrupt lines.
    fn enter(&self) -> u64 {
        self.touched.store(true, Ordering::Relaxed);
        self.clock.load(Ordering::Relaxed)
    }
}

impl MemOps for Window {
    fn read(&self, offset: u64, dst: &mut [u8], attrs: MemAttrs) -> MemResult {
        if attrs.debug {
            return Err(BusError::BadAccess);
        }
        let now = self.enter();
        let size = dst.len() as u8;
        let value = self.bus.read(self.base + offset as u32, size, now).ok_or(BusError::Unassigned)?;
        dst.copy_from_slice(&value.to_le_bytes()[..dst.len()]);
        Ok(())
    }

    fn write(&self, offset: u64, src: &[u8], attrs: MemAttrs) -> MemResult {
        if attrs.debug {
            return Err(BusError::BadAccess);
        }
        let now = self.enter();
        let mut bytes = [0; 4];
        bytes[..src.len()].copy_from_slice(src);
        let value = u32::from_le_bytes(bytes);
        self.bus.write(self.base + offset as u32, src.len() as u8, value, now).ok_or(BusError::Unassigned)
    }

    fn constraints(&self) -> AccessConstraints {
        AccessConstraints::IO.with_widths(rsemu::core::value::Width::U8, rsemu::core::value::Width::U32)
    }
}

/// The processor's registers, as far as anything outside needs them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct State {
    /// R15: address of the next instruction.
    pub pc: u32,
    /// R14.
    pub lr: u32,
    /// R13.
    pub sp: u32,
    /// Program status; bits 8..0 are the exception number.
    pub xpsr: u32,
    /// PRIMASK: everything but NMI and HardFault is held off.
    pub primask: bool,
    /// BASEPRI: interrupts of this priority value and above are held off; 0 for none.
    pub basepri: u8,
    /// FAULTMASK.
    pub faultmask: bool,
}

impl State {
    /// The active exception's number: 0 in thread mode, 3 HardFault, 16 + n external interrupt n.
    pub fn exception(&self) -> u16 {
        (self.xpsr & xpsr::EXCEPTION) as u16
    }

    fn in_it_block(&self) -> bool {
        self.xpsr & xpsr::IT_MASK != 0
    }
}

impl From<Regs> for State {
    fn from(regs: Regs) -> Self {
        Self {
            pc: regs.r[15],
            lr: regs.r[14],
            sp: regs.r[13],
            xpsr: regs.xpsr,
            primask: regs.primask,
            basepri: regs.basepri,
            faultmask: regs.faultmask,
        }
    }
}

/// The processor with its memories.
pub struct Cpu {
    core: ArmV7m,
    clock: Arc<AtomicU64>,
    touched: Arc<AtomicBool>,
    now: u64,
    state: State,
    asleep: bool,
    /// The levels of the external interrupt lines, as last set.
    lines: u128,
    flash: Memory,
    sram: Memory,
    ccm: Memory,
}

/// A memory of the chip, shared with whoever must change it behind the core's back.
#[derive(Clone, Debug)]
pub struct Memory {
    base: u32,
    store: Arc<RamStore>,
}

impl Memory {
    fn new(base: u32, len: u32) -> Self {
        Self { base, store: Arc::new(RamStore::new(len.into())) }
    }

    /// Copies bytes out; false if the range is not within the memory.
    pub fn read(&self, address: u32, into: &mut [u8]) -> bool {
        self.offset(address).is_some_and(|offset| self.store.read_at(offset, into).is_ok())
    }

    /// Copies bytes in; false if the range is not within the memory.
    pub fn write(&self, address: u32, bytes: &[u8]) -> bool {
        self.offset(address).is_some_and(|offset| self.store.write_at(offset, bytes).is_ok())
    }

    /// The little-endian word at `address`, if that is within the memory.
    pub fn word(&self, address: u32) -> Option<u32> {
        let mut bytes = [0; 4];
        self.read(address, &mut bytes).then(|| u32::from_le_bytes(bytes))
    }

    fn offset(&self, address: u32) -> Option<u64> {
        Some(address.checked_sub(self.base)?.into())
    }
}

/// The chip's memories, empty: flash reads as erased.
#[derive(Clone, Debug)]
pub struct Memories {
    /// Flash at 0x0800_0000.
    pub flash: Memory,
    /// SRAM at 0x2000_0000.
    pub sram: Memory,
    /// Core-coupled memory at 0x1000_0000.
    pub ccm: Memory,
}

impl Memories {
    /// All of an STM32F405's memory.
    pub fn new() -> Self {
        let flash = Memory::new(map::FLASH.start, map::FLASH.len() as u32);
        flash.write(map::FLASH.start, &vec![0xFF; map::FLASH.len()]);
        Self {
            flash,
            sram: Memory::new(map::SRAM.start, map::SRAM.len() as u32),
            ccm: Memory::new(map::CCM.start, map::CCM.len() as u32),
        }
    }
}

impl Default for Memories {
    fn default() -> Self {
        Self::new()
    }
}

impl Cpu {
    /// A core about to leave reset. Flash is also visible at address 0, where it boots from.
    pub fn new(memories: Memories, bus: &Arc<dyn Bus>) -> Self {
        let clock = Arc::new(AtomicU64::new(0));
        let touched = Arc::new(AtomicBool::new(false));
        let space = AddressSpace::new("stm32f405", 32).with_dispatch(PAGES);
        {
            let mut topology = space.topology();
            let mut put = |region: Region, base: u32, perms: Perms, priority: i32| {
                let mapping = Mapping::new(region, base.into()).with_perms(perms).with_priority(priority);
                topology.map_with(mapping).expect("the regions of the fixed memory map do not overlap");
            };
            let ram = |name: &str, memory: &Memory| Region::ram(name, Arc::clone(&memory.store));
            // Reads of flash take the short way to memory; writes go to the flash controller.
            put(ram("flash", &memories.flash), map::FLASH.start, Perms::RX, 1);
            put(ram("boot alias", &memories.flash), 0, Perms::RX, 1);
            put(ram("sram", &memories.sram), map::SRAM.start, Perms::RWX, 1);
            put(ram("ccm", &memories.ccm), map::CCM.start, Perms::RW, 1);
            for (range, perms) in [
                (map::FLASH, Perms::WRITE),
                (map::SYSTEM_MEMORY, Perms::RW),
                (map::PERIPHERALS, Perms::RW),
                (map::DBGMCU, Perms::RW),
            ] {
                let window = Window {
                    base: range.start,
                    bus: Arc::clone(bus),
                    clock: Arc::clone(&clock),
                    touched: Arc::clone(&touched),
                };
                let region = Region::io("bus", range.len() as u64, Arc::new(window));
                put(region, range.start, perms, 0);
            }
        }
        // Four priority bits: PM0214 Rev 10 §4.3.7 (rsemu assumes three).
        let core = ArmV7m::new(Config::CORTEX_M4F.with_priority_bits(4));
        core.attach_space(Arc::new(space));
        let state = core.regs().into();
        let Memories { flash, sram, ccm } = memories;
        Self { core, clock, touched, now: 0, state, asleep: false, lines: 0, flash, sram, ccm }
    }

    /// Cycles since the machine was made.
    pub fn now(&self) -> u64 {
        self.now
    }

    /// The registers before the next step.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Whether the core sleeps in WFI or WFE. It may be found out a cycle late.
    pub fn asleep(&self) -> bool {
        self.asleep
    }

    /// Whether the core locked up: a fault in a fault handler.
    pub fn locked_up(&self) -> bool {
        self.core.is_locked_up()
    }

    /// Whether the last steps reached beyond memory; asking clears it.
    pub fn take_touched(&self) -> bool {
        // One thread only; a swap would cost a bus lock in every step.
        let touched = self.touched.load(Ordering::Relaxed);
        if touched {
            self.touched.store(false, Ordering::Relaxed);
        }
        touched
    }

    /// Whether the firmware asked for a system reset (AIRCR.SYSRESETREQ).
    pub fn reset_requested(&self) -> bool {
        self.core.reset_requested()
    }

    /// A system reset: registers and interrupt controller as after power-on; memories and time stay.
    pub fn reset(&mut self) {
        self.core.with_sys(|sys| {
            let (cpuid, bits, regions, mvfr) = (sys.cpuid, sys.priority_bits, sys.mpu_regions, sys.mvfr);
            *sys = rsemu::cpu::arm::v7m::sys::Sys::new(cpuid, bits, regions).with_fp(mvfr);
        });
        self.core.request_reset();
        self.set_lines(0);
        self.asleep = false;
        self.state = self.core.regs().into();
    }

    /// Sets the levels of all external interrupt lines; bit n is interrupt n.
    pub fn set_lines(&mut self, lines: u128) {
        let mut changed = self.lines ^ lines;
        self.lines = lines;
        while changed != 0 {
            let line = changed.trailing_zeros();
            changed &= changed - 1;
            self.core.set_irq(line as u16, lines >> line & 1 != 0);
        }
        if lines != 0 {
            self.asleep = false;
        }
    }

    /// The priority value of external interrupt `irq`, as in NVIC_IPR (the upper four bits count).
    pub fn priority_of(&self, irq: u16) -> u8 {
        self.core.with_sys(|sys| sys.priority[usize::from(irq) + 16])
    }

    /// The fault status registers: CFSR, HFSR, MMFAR, BFAR.
    pub fn fault_status(&self) -> [u32; 4] {
        self.core.with_sys(|sys| [sys.cfsr, sys.hfsr, sys.mmfar, sys.bfar])
    }

    /// One exception entry or one instruction. Returns its cycles.
    pub fn step(&mut self) -> u64 {
        self.clock.store(self.now, Ordering::Relaxed);
        let before = self.state;
        let cycles = if before.in_it_block() { self.step_in_it_block(before) } else { self.core.step() };
        self.now += cycles;
        self.state = self.core.regs().into();
        if cycles == 1 && self.state.pc == before.pc {
            self.asleep = self.core.is_asleep();
        }
        cycles
    }

    /// rsemu does not stack ITSTATE when an exception comes, so the rest of the block would run
    /// unconditionally afterwards: exceptions wait until the block's end, at most four instructions.
    /// And an exception return that is itself in a block leaves ITSTATE advanced once too often.
    fn step_in_it_block(&mut self, before: State) -> u64 {
        let could_be_taken =
            self.lines != 0 || self.core.with_sys(|sys| sys.pending.iter().any(|word| *word != 0));
        if !could_be_taken || before.primask {
            let cycles = self.core.step();
            self.mend_conditional_return(before);
            return cycles;
        }
        self.core.set_regs(Regs { primask: true, ..self.core.regs() });
        let cycles = self.core.step();
        self.core.set_regs(Regs { primask: false, ..self.core.regs() });
        self.mend_conditional_return(before);
        cycles
    }

    fn mend_conditional_return(&mut self, before: State) {
        let after = self.core.xpsr();
        if (after & xpsr::EXCEPTION) as u16 != before.exception() {
            self.core.set_xpsr(after & !xpsr::IT_MASK);
        }
    }

    /// Lets a sleeping core's time pass until `until`, or until its own SysTick is due if that is
    /// sooner.
    pub fn advance_idle(&mut self, until: u64) {
        let mut span = until.saturating_sub(self.now).max(1);
        self.core.with_sys(|sys| {
            if sys.syst_csr & 1 != 0 && sys.syst_rvr != 0 {
                let left = if sys.syst_cvr == 0 { sys.syst_rvr + 1 } else { sys.syst_cvr };
                span = span.min(left.into());
            }
            sys.tick_cyccnt(span);
            if sys.tick_systick(span) && sys.syst_csr & 2 != 0 {
                sys.set_pending(Exception::SYSTICK, true);
                self.asleep = false;
            }
        });
        self.now += span;
    }

    /// The memory that holds `address`, if one does.
    pub fn memory(&self, address: u32) -> Option<&Memory> {
        if map::FLASH.contains(&address) {
            Some(&self.flash)
        } else if map::SRAM.contains(&address) {
            Some(&self.sram)
        } else if map::CCM.contains(&address) {
            Some(&self.ccm)
        } else {
            None
        }
    }

    /// The word at `address`, if it is in a memory.
    pub fn word(&self, address: u32) -> Option<u32> {
        self.memory(address)?.word(address)
    }
}
