//! A recording of everything that the core executed, for a second core to execute again (`sim/lockstep`).
//!
//! The stream is a sequence of pieces, all numbers little-endian:
//!
//! - `M`: SRAM, CCM and the last sector of flash as they are now;
//! - `J`: the 17 registers (R0 to R15, xPSR) that execution goes on with, and a byte that says whether the eight words of an exception
//!   frame follow, which are at the stack pointer;
//! - `S`: a stretch of instructions. How many were executed (those skipped in an IT block do not count), how many accesses to anything
//!   but memory they made, each of these (`R` or `W`, its size, two bytes of nothing, address, value), and the registers afterwards.
//!
//! A stretch ends where something other than the instructions decides how to go on: an exception, sleep, a reset.

use std::io::{self, Write};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::cpu::{Bus, Cpu, Registers};
use crate::memory_map as map;
use crate::timing::Speeds;

/// Steps from one picture of the memories to the next.
const PICTURE_EVERY: u64 = 1_000_000;
/// The last sector of flash, which programs use for storage (RM0090 Rev 21 Table 5).
const LAST_SECTOR: std::ops::Range<u32> = 0x080E_0000..0x0810_0000;
/// The flash interface's control register, and the bit that begins to erase.
const FLASH_CR: u32 = 0x4002_3C10;
const FLASH_START: u32 = 1 << 16;
/// xPSR: the active exception.
const EXCEPTION: u32 = 0x1FF;
/// The least of the values that the link register has in a handler.
const EXC_RETURN: u32 = 0xFFFF_FFE0;
const WFE: u16 = 0xBF20;
const WFI: u16 = 0xBF30;

/// An access to anything but memory.
#[derive(Clone, Copy, Debug)]
struct Access {
    writes: bool,
    size: u8,
    address: u32,
    value: u32,
}

/// The accesses since the stretch began.
type Accesses = Arc<Mutex<Vec<Access>>>;

/// A bus whose accesses are recorded.
struct RecordedBus {
    bus: Arc<dyn Bus>,
    accesses: Accesses,
}

fn lock(accesses: &Accesses) -> MutexGuard<'_, Vec<Access>> {
    accesses.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The first instruction of an exception's handler.
fn handler(cpu: &Cpu, exception: u32) -> u32 {
    cpu.word(cpu.vector_table() + 4 * exception).unwrap_or(0) & !1
}

impl Bus for RecordedBus {
    fn read(&self, address: u32, size: u8, now: u64) -> Option<u32> {
        let value = self.bus.read(address, size, now)?;
        lock(&self.accesses).push(Access { writes: false, size, address, value });
        Some(value)
    }

    fn write(&self, address: u32, size: u8, value: u32, now: u64) -> Option<()> {
        if !map::FLASH.contains(&address) {
            lock(&self.accesses).push(Access { writes: true, size, address, value });
        }
        self.bus.write(address, size, value, now)
    }

    fn speeds(&self) -> Speeds {
        self.bus.speeds()
    }
}

/// A recording under way.
pub struct Recording {
    out: Box<dyn Write + Send>,
    accesses: Accesses,
    /// The registers after the last step.
    last: Registers,
    executed: u32,
    /// The next step is the reset sequence, not an instruction.
    resets: bool,
    /// Nothing has been recorded yet.
    is_new: bool,
    steps: u64,
    picture_due: bool,
    /// What went wrong with the output.
    error: Option<io::Error>,
}

impl Recording {
    /// Writes to `out`; the core must use the bus that comes with it.
    pub fn new(out: Box<dyn Write + Send>, bus: Arc<dyn Bus>) -> (Self, Arc<dyn Bus>) {
        let accesses = Accesses::default();
        let recorded = Arc::new(RecordedBus { bus, accesses: Arc::clone(&accesses) });
        let recording = Self {
            out,
            accesses,
            last: Registers::default(),
            executed: 0,
            resets: true,
            is_new: true,
            steps: 0,
            picture_due: true,
            error: None,
        };
        (recording, recorded)
    }

    /// The core was reset between two steps.
    pub fn reset(&mut self) {
        self.resets = true;
    }

    /// Steps recorded.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Ends the recording.
    pub fn finish(mut self) -> io::Result<()> {
        self.end_stretch();
        if let Some(error) = self.error.take() {
            return Err(error);
        }
        self.out.flush()
    }

    /// The core has made a step.
    pub fn step(&mut self, cpu: &Cpu) {
        self.steps += 1;
        let before = std::mem::replace(&mut self.last, cpu.registers());
        if cpu.asleep() && before == self.last && !self.resets {
            // It was asleep already.
            return;
        }
        let exception = self.last.xpsr & EXCEPTION;
        // An exception may follow itself without a return in between.
        let begins_anew =
            exception != 0 && self.last.r[14] >= EXC_RETURN && self.last.r[15] == handler(cpu, exception);
        let jumped = (before.xpsr ^ self.last.xpsr) & EXCEPTION != 0 || begins_anew;
        let sleeps = || {
            let address = before.r[15];
            let word = cpu.word(address & !3).unwrap_or(0);
            matches!((word >> (8 * (address & 2))) as u16, WFE | WFI)
        };
        if self.resets || jumped || sleeps() {
            let after = std::mem::replace(&mut self.last, before);
            self.end_stretch();
            self.last = after;
            let entered = jumped && exception != 0 && self.last.r[14] >= EXC_RETURN;
            self.jump(cpu, entered && self.last.r[13] < before.r[13]);
            self.resets = false;
            return;
        }
        self.executed += u32::from(before.executes());
        let erases = lock(&self.accesses)
            .last()
            .is_some_and(|last| last.writes && last.address == FLASH_CR && last.value & FLASH_START != 0);
        self.picture_due |= self.steps.is_multiple_of(PICTURE_EVERY) || erases;
        if self.picture_due && !self.last.is_in_it_block() {
            self.end_stretch();
            self.jump(cpu, false);
        }
    }

    fn end_stretch(&mut self) {
        let accesses = std::mem::take(&mut *lock(&self.accesses));
        if std::mem::take(&mut self.is_new) || self.executed == 0 && accesses.is_empty() {
            return;
        }
        let mut piece = vec![b'S'];
        piece.extend(std::mem::take(&mut self.executed).to_le_bytes());
        piece.extend((accesses.len() as u32).to_le_bytes());
        for access in accesses {
            piece.extend([if access.writes { b'W' } else { b'R' }, access.size, 0, 0]);
            piece.extend(access.address.to_le_bytes());
            piece.extend(access.value.to_le_bytes());
        }
        piece.extend(self.last.bytes());
        self.put(&piece);
    }

    fn jump(&mut self, cpu: &Cpu, with_frame: bool) {
        if std::mem::take(&mut self.picture_due) {
            self.put(b"M");
            for range in [map::SRAM, map::CCM, LAST_SECTOR] {
                let mut bytes = vec![0; range.len()];
                if let Some(memory) = cpu.memory(range.start) {
                    memory.read(range.start, &mut bytes);
                }
                self.put(&bytes);
            }
        }
        let mut piece = vec![b'J'];
        piece.extend(self.last.bytes());
        piece.push(with_frame.into());
        if with_frame {
            for n in 0..8 {
                piece.extend(cpu.word(self.last.r[13] + 4 * n).unwrap_or(0).to_le_bytes());
            }
        }
        self.put(&piece);
    }

    fn put(&mut self, bytes: &[u8]) {
        if self.error.is_none() {
            self.error = self.out.write_all(bytes).err();
        }
    }
}
