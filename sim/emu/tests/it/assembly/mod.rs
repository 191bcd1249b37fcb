#![allow(dead_code, reason = "each test uses its part")]
//! A few hand-assembled Thumb instructions, for programs too small to need a compiler.

use cantap_emu::memory_map::{FLASH, SRAM};
use cantap_emu::{Image, Peripheral};

/// The condition EQ.
pub const EQ: u16 = 0;
/// The condition NE.
pub const NE: u16 = 1;

/// A program under construction: a vector table of 128 entries, then code.
pub struct Program {
    vectors: Vec<u32>,
    code: Vec<u16>,
    literals: Vec<(usize, u32)>,
}

impl Program {
    /// No code yet; every exception but reset leads to an endless loop.
    pub fn new() -> Self {
        let mut program = Self { vectors: vec![0; 128], code: Vec::new(), literals: Vec::new() };
        let endless = program.here();
        program.branch_to(endless);
        program.vectors.fill(endless | 1);
        program.vectors[0] = SRAM.end;
        program
    }

    /// The next instruction's address.
    pub fn here(&self) -> u32 {
        FLASH.start + 4 * self.vectors.len() as u32 + 2 * self.code.len() as u32
    }

    /// The code that follows handles exception `number`; 1 is reset, 16 + n interrupt n.
    pub fn handler(&mut self, number: usize) {
        self.vectors[number] = self.here() | 1;
    }

    /// Appends instructions.
    pub fn put(&mut self, instructions: &[u16]) {
        self.code.extend(instructions);
    }

    /// `LDR rd, =value`.
    pub fn load(&mut self, rd: u16, value: u32) {
        self.literals.push((self.code.len(), value));
        self.put(&[0x4800 | rd << 8]);
    }

    /// An unconditional branch back.
    pub fn branch_to(&mut self, target: u32) {
        self.put(&[0xE000 | self.halfwords_to(target) & 0x7FF]);
    }

    /// A conditional branch back.
    pub fn branch_if(&mut self, condition: u16, target: u32) {
        self.put(&[0xD000 | condition << 8 | self.halfwords_to(target) & 0xFF]);
    }

    fn halfwords_to(&self, target: u32) -> u16 {
        ((target.wrapping_sub(self.here() + 4) as i32) / 2) as u16
    }

    /// The finished program.
    pub fn image(mut self) -> Image {
        if self.code.len() % 2 == 1 {
            self.put(&[nop()]);
        }
        let base = self.code.len();
        for (n, (at, value)) in std::mem::take(&mut self.literals).into_iter().enumerate() {
            // Relative to the instruction's address plus 4, rounded down to a word.
            let from = (at + 2) & !1;
            let words = (base + 2 * n - from) / 2;
            self.code[at] |= words as u16;
            self.code.extend([value as u16, (value >> 16) as u16]);
        }
        let vectors = self.vectors.iter().flat_map(|word| word.to_le_bytes());
        let code = self.code.iter().flat_map(|half| half.to_le_bytes());
        Image::raw(vectors.chain(code).collect())
    }
}

/// `MOVS rd, #value`.
pub const fn movs(rd: u16, value: u16) -> u16 {
    0x2000 | rd << 8 | value
}

/// `ADDS rd, #value`; in an IT block `ADD` without flags.
pub const fn adds(rd: u16, value: u16) -> u16 {
    0x3000 | rd << 8 | value
}

/// `ANDS rd, rm`.
pub const fn ands(rd: u16, rm: u16) -> u16 {
    0x4000 | rm << 3 | rd
}

/// `EORS rd, rm`; in an IT block `EOR` without flags.
pub const fn eors(rd: u16, rm: u16) -> u16 {
    0x4040 | rm << 3 | rd
}

/// `LSLS rd, rm, #count`; in an IT block without flags.
pub const fn lsls(rd: u16, rm: u16, count: u16) -> u16 {
    count << 6 | rm << 3 | rd
}

/// `CMP rn, rm`.
pub const fn cmp(rn: u16, rm: u16) -> u16 {
    0x4280 | rm << 3 | rn
}

/// `STR rt, [rn, #4 * word]`.
pub const fn str(rt: u16, rn: u16, word: u16) -> u16 {
    0x6000 | word << 6 | rn << 3 | rt
}

/// `LDR rt, [rn, #4 * word]`.
pub const fn ldr(rt: u16, rn: u16, word: u16) -> u16 {
    0x6800 | word << 6 | rn << 3 | rt
}

/// An IT instruction for `condition` with ARM's mask bits.
pub const fn it(condition: u16, mask: u16) -> u16 {
    0xBF00 | condition << 4 | mask
}

/// `BX LR`.
pub const fn bx_lr() -> u16 {
    0x4770
}

/// `WFI`.
pub const fn wfi() -> u16 {
    0xBF30
}

/// `NOP`.
pub const fn nop() -> u16 {
    0xBF00
}

/// `UDF #0`.
pub const fn udf() -> u16 {
    0xDE00
}

/// A device that asserts its interrupt from a certain cycle until it is written to.
pub struct Alarm {
    at: Option<u64>,
    asserted: bool,
}

impl Alarm {
    /// A device that asserts it at core cycle `at`, or never.
    pub fn new(at: Option<u64>) -> Self {
        Self { at, asserted: false }
    }
}

impl Peripheral for Alarm {
    fn read(&mut self, _offset: u32, _size: u8, _now: u64) -> u32 {
        0
    }

    fn write(&mut self, _offset: u32, _size: u8, _value: u32, _now: u64) {
        self.asserted = false;
    }

    fn irq(&self) -> bool {
        self.asserted
    }

    fn next_event(&self) -> Option<u64> {
        self.at
    }

    fn advance(&mut self, now: u64) {
        if self.at.is_some_and(|at| at <= now) {
            self.at = None;
            self.asserted = true;
        }
    }
}
