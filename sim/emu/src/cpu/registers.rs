//! All registers that an instruction can see, and what they say about the next one.

use rsemu::cpu::arm::v7m::Regs;

/// R0 to R15 and xPSR.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Registers {
    /// R0 to R15; R15 is the address of the next instruction.
    pub r: [u32; 16],
    /// Flags, ITSTATE, the active exception.
    pub xpsr: u32,
}

impl Registers {
    /// ITSTATE (Armv7-M architecture reference manual, "ITSTATE").
    fn it_state(&self) -> u32 {
        self.xpsr >> 8 & 0xFC | self.xpsr >> 25 & 3
    }

    /// Whether the next instruction is in an IT block.
    pub fn is_in_it_block(&self) -> bool {
        self.it_state() != 0
    }

    /// Whether the next instruction is executed, rather than skipped by its IT block.
    pub fn executes(&self) -> bool {
        let it = self.it_state();
        if it == 0 {
            return true;
        }
        let flag = |bit: u32| self.xpsr >> bit & 1 != 0;
        let (negative, zero, carry, overflow) = (flag(31), flag(30), flag(29), flag(28));
        let holds = match it >> 5 {
            0 => zero,
            1 => carry,
            2 => negative,
            3 => overflow,
            4 => carry && !zero,
            5 => negative == overflow,
            6 => negative == overflow && !zero,
            _ => return true,
        };
        holds == (it >> 4 & 1 == 0)
    }

    /// Their bytes, little-endian.
    pub fn bytes(&self) -> Vec<u8> {
        self.r.iter().chain([&self.xpsr]).flat_map(|register| register.to_le_bytes()).collect()
    }
}

impl From<Regs> for Registers {
    fn from(regs: Regs) -> Self {
        Self { r: regs.r, xpsr: regs.xpsr }
    }
}
