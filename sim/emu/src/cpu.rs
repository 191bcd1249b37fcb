//! The processor: a thin module over rsemu's Cortex-M4F, and the only module that knows its API, so that
//! the core can be replaced. It counts the cycles, owns flash and RAM, and works around two defects of
//! rsemu 0.0.7 with IT blocks (`docs/upstream-rsemu.md`).
//!
//! By itself the core takes one cycle per instruction, one more per data access, two per taken branch, 12
//! and 10 for exception entry and return; [`crate::timing`] adds what it waits for.

mod bus;
mod memory;
mod registers;
mod window;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use rsemu::core::space::{AddressSpace, DispatchPolicy, Mapping, MappingId, Perms, Region};
use rsemu::cpu::arm::v7m::sys::Exception;
use rsemu::cpu::arm::v7m::{ArmV7m, Config, Regs, xpsr};

use crate::memory_map as map;
use crate::timing::{Bound, Delays, Waits};
pub use bus::Bus;
pub use memory::{Memories, Memory};
pub use registers::Registers;
use window::{Shared, Window};

/// A table of 64 KiB pages finds memories and peripherals faster than a search; only the few above
/// it are searched for.
const PAGES: DispatchPolicy = DispatchPolicy::Dense { page_bits: 16, cover: map::PERIPHERALS.end as u64 };

/// rsemu charges each word of a stack frame in addition to the 12 and 10 cycles of exception entry and return,
/// which already include them (ARM DDI 0439D §3.9.1).
const FRAME: u64 = 8;
/// More than any tail-chained return takes in rsemu, which is six cycles plus one for each register popped; a return that
/// unstacks takes at least 19.
const TAIL_CHAIN: u64 = 18;

/// The processor's registers, as far as they are needed outside.
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
    shared: Shared,
    /// What the last step waited for, and how long.
    waits: Waits,
    now: u64,
    state: State,
    asleep: bool,
    /// The levels of the external interrupt lines, as last set.
    lines: u128,
    flash: Memory,
    sram: Memory,
    ccm: Memory,
    bootloader: Memory,
    space: Arc<AddressSpace>,
    /// What is mapped at address 0, and whether that is the bootloader.
    at_zero: (MappingId, bool),
}

impl Cpu {
    /// A core about to leave reset. Flash is also visible at address 0, where it boots from.
    pub fn new(memories: Memories, bus: &Arc<dyn Bus>, bound: Bound) -> Self {
        let shared = Shared {
            bus: Arc::clone(bus),
            clock: Arc::new(AtomicU64::new(0)),
            touched: Arc::new(AtomicBool::new(false)),
            delays: (bound == Bound::Worst).then(Arc::default),
        };
        let space = AddressSpace::new("stm32f405", 32).with_dispatch(PAGES);
        let at_zero = {
            let mut topology = space.topology();
            let mut put = |region: Region, base: u32, perms: Perms, priority: i32| {
                let mapping = Mapping::new(region, base.into()).with_perms(perms).with_priority(priority);
                topology.map_with(mapping).expect("the regions of the fixed memory map do not overlap")
            };
            let delays = shared.delays.as_ref();
            // Reads of flash go directly to memory; writes go to the flash controller.
            put(window::memory("flash", &memories.flash, delays), map::FLASH.start, Perms::RX, 1);
            let at_zero = put(window::memory("boot alias", &memories.flash, delays), 0, Perms::RX, 1);
            put(
                window::memory("bootloader", &memories.bootloader, None),
                map::BOOTLOADER.start,
                Perms::RX,
                1,
            );
            put(window::memory("sram", &memories.sram, delays), map::SRAM.start, Perms::RWX, 1);
            // On the D-bus, without wait states (RM0090 Rev 21 §2.3.1).
            put(window::memory("ccm", &memories.ccm, None), map::CCM.start, Perms::RW, 1);
            for (range, perms) in [
                (map::FLASH, Perms::WRITE),
                (map::SYSTEM_MEMORY, Perms::RW),
                (map::PERIPHERALS, Perms::RW),
                (map::DBGMCU, Perms::RW),
            ] {
                let window = Window { base: range.start, shared: shared.clone() };
                let region = Region::io("bus", range.len() as u64, Arc::new(window));
                put(region, range.start, perms, 0);
            }
            at_zero
        };
        // Four priority bits: PM0214 Rev 10 §4.3.7 (rsemu assumes three).
        let core = ArmV7m::new(Config::CORTEX_M4F.with_priority_bits(4));
        let space = Arc::new(space);
        core.attach_space(Arc::clone(&space));
        let state = core.regs().into();
        let Memories { flash, sram, ccm, bootloader } = memories;
        let at_zero = (at_zero, false);
        Self {
            core,
            shared,
            waits: Waits::default(),
            now: 0,
            state,
            asleep: false,
            lines: 0,
            flash,
            sram,
            ccm,
            bootloader,
            space,
            at_zero,
        }
    }

    /// Maps the bootloader, or else flash, at address 0.
    pub fn show_at_zero(&mut self, bootloader: bool) {
        if self.at_zero.1 == bootloader {
            return;
        }
        let region = if bootloader {
            window::memory("boot alias", &self.bootloader, None)
        } else {
            window::memory("boot alias", &self.flash, self.shared.delays.as_ref())
        };
        let mapping = Mapping::new(region, 0).with_perms(Perms::RX).with_priority(1);
        let mut topology = self.space.topology();
        topology.unmap(self.at_zero.0).expect("it is mapped");
        let id = topology.map_with(mapping).expect("there is nothing else at address 0");
        self.at_zero = (id, bootloader);
    }

    /// Puts the core into the state in which the ROM bootloader leaves it, about to execute the program's first
    /// instruction: the program's stack and entry, the bootloader's vectors, SysTick running, the USB interrupt enabled
    /// and pending.
    pub fn leave_bootloader(&mut self) {
        // The reset sequence, which takes stack and entry from flash.
        self.core.step();
        self.core.with_sys(|sys| {
            sys.vtor = map::BOOTLOADER.start;
            sys.syst_rvr = 10_000;
            sys.syst_csr = 0b111;
            let usb = Exception(map::OTG_FS_IRQ + 16);
            sys.set_enable(usb, true);
            sys.set_pending(usb, true);
        });
        self.state = self.core.regs().into();
    }

    /// Lets time pass before the first instruction.
    pub fn pass(&mut self, cycles: u64) {
        self.now += cycles;
    }

    /// Whether the next instruction is DSB.
    pub fn at_barrier(&self) -> bool {
        // DSB SY: F3BF 8F4F.
        self.word(self.state.pc) == Some(0x8F4F_F3BF)
    }

    /// VTOR: where the vector table is.
    pub fn vector_table(&self) -> u32 {
        self.core.vtor()
    }

    /// Cycles since the machine was made.
    pub fn now(&self) -> u64 {
        self.now
    }

    /// The registers before the next step.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// All registers before the next step.
    pub fn registers(&self) -> Registers {
        self.core.regs().into()
    }

    /// Whether the core sleeps in WFI or WFE. This may be noticed a cycle late.
    pub fn asleep(&self) -> bool {
        self.asleep
    }

    /// Whether the core locked up: a fault in a fault handler.
    pub fn locked_up(&self) -> bool {
        self.core.is_locked_up()
    }

    /// Whether the last steps accessed anything but memory; reading this clears it.
    pub fn take_touched(&self) -> bool {
        // There is only one thread; a swap would cost a bus lock in every step.
        let touched = self.shared.touched.load(Ordering::Relaxed);
        if touched {
            self.shared.touched.store(false, Ordering::Relaxed);
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
        if let Some(mut delays) = self.shared.delays() {
            *delays = Delays::default();
        }
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
        self.shared.clock.store(self.now, Ordering::Relaxed);
        let before = self.state;
        if let Some(mut delays) = self.shared.delays() {
            delays.begin(self.now);
        }
        let mut own = if before.in_it_block() { self.step_in_it_block(before) } else { self.core.step() };
        self.state = self.core.regs().into();
        if before.exception() != self.state.exception() && own > TAIL_CHAIN {
            own -= FRAME;
            self.core.with_sys(|sys| sys.tick_cyccnt(FRAME.wrapping_neg()));
        }
        let cycles = own + self.wait();
        self.now += cycles;
        if own == 1 && self.state.pc == before.pc {
            self.asleep = self.core.is_asleep();
        }
        self.complete_write_by(self.now);
        cycles
    }

    /// What the last step waited for.
    pub fn waits(&self) -> Waits {
        self.waits
    }

    /// The cycles that the step waited; the core's own counters go on meanwhile.
    fn wait(&mut self) -> u64 {
        let Some(delays) = self.shared.delays() else { return 0 };
        self.waits = delays.end();
        drop(delays);
        let cycles = self.waits.total();
        if cycles > 0 {
            self.tick(cycles);
        }
        cycles
    }

    /// Makes a write that has reached its peripheral by `now`.
    fn complete_write_by(&self, now: u64) {
        let due = self.shared.delays().and_then(|delays| delays.posted_at()).is_some_and(|at| at <= now);
        if due {
            self.shared.complete_write();
        }
    }

    /// SysTick and CYCCNT count on. Whether SysTick now wants its exception.
    fn tick(&self, cycles: u64) -> bool {
        self.core.with_sys(|sys| {
            sys.tick_cyccnt(cycles);
            let pends = sys.tick_systick(cycles) && sys.syst_csr & 2 != 0;
            if pends {
                sys.set_pending(Exception::SYSTICK, true);
            }
            pends
        })
    }

    /// When an exception comes, rsemu does not stack ITSTATE, so the rest of an IT block would run
    /// unconditionally afterwards. Exceptions therefore wait for the block's end, at most four
    /// instructions. And an exception return that is itself in a block leaves ITSTATE advanced once
    /// too often.
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

    /// Lets a sleeping core's time pass until `until`, or until its SysTick is due or a write reaches its
    /// peripheral, whichever comes first.
    pub fn advance_idle(&mut self, until: u64) {
        let posted_at = self.shared.delays().and_then(|delays| delays.posted_at());
        let mut span = until.min(posted_at.unwrap_or(until)).saturating_sub(self.now).max(1);
        self.core.with_sys(|sys| {
            if sys.syst_csr & 1 != 0 && sys.syst_rvr != 0 {
                let left = if sys.syst_cvr == 0 { sys.syst_rvr + 1 } else { sys.syst_cvr };
                span = span.min(left.into());
            }
        });
        if self.tick(span) {
            self.asleep = false;
        }
        self.now += span;
        self.complete_write_by(self.now);
    }

    /// The memory that holds `address`, if one does.
    pub fn memory(&self, address: u32) -> Option<&Memory> {
        if map::FLASH.contains(&address) {
            Some(&self.flash)
        } else if map::SRAM.contains(&address) {
            Some(&self.sram)
        } else if map::CCM.contains(&address) {
            Some(&self.ccm)
        } else if map::BOOTLOADER.contains(&address) {
            Some(&self.bootloader)
        } else {
            None
        }
    }

    /// The word at `address`, if it is in a memory.
    pub fn word(&self, address: u32) -> Option<u32> {
        self.memory(address)?.word(address)
    }
}
