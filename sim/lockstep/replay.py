"""Executes again on a second core, Unicorn's Cortex-M4, what the emulated one executed, and compares.

    replay.py FIRMWARE.elf RECORDING

The recording is `cargo run -p cantap-sim --example lockstep`'s (its format: sim/emu/src/recording.rs). What peripherals answered comes from
the recording, and so does what neither core can know by itself: where an exception, sleep or a reset goes on. Everything else is
compared: after each stretch of instructions all registers and flags, every access to a peripheral in its order, with its size and, if it
is a store, its value; and after each million instructions SRAM, CCM and the last sector of flash, byte by byte. Prints the first
difference, or what was compared. Exit code 0: no difference; 1: a difference; 2: wrong command line.
"""

import collections
import struct
import sys

from elftools.elf.elffile import ELFFile
from unicorn import UC_ARCH_ARM, UC_HOOK_BLOCK, UC_MODE_MCLASS, UC_MODE_THUMB, Uc, UcError
from unicorn import arm_const as arm

FLASH, FLASH_BYTES = 0x0800_0000, 0x10_0000
SRAM, SRAM_BYTES = 0x2000_0000, 0x2_0000
CCM, CCM_BYTES = 0x1000_0000, 0x1_0000
SECTOR, SECTOR_BYTES = 0x080E_0000, 0x2_0000
# What the recording has accesses of: the factory values, the peripherals, the debug component.
RECORDED = ((0x1FFF_0000, 0x1_0000), (0x4000_0000, 0x10_0000), (0x5000_0000, 0x4_0000), (0xE004_2000, 0x1000))
# The aliases of the peripherals' bits: each access is one, or two, of the word.
BITS, BITS_BYTES = 0x4200_0000, 0x200_0000
# The core's own registers, which the recording does not have: storage, apart from CPUID and AIRCR as they are after a reset.
SYSTEM, SYSTEM_BYTES = 0xE000_0000, 0x4_0000
AFTER_RESET = {0xE000_ED00: 0x410F_C241, 0xE000_ED0C: 0xFA05_0000}
# N, Z, C, V, Q and GE.
FLAGS = 0xF80F_0000
REGISTERS = [
    arm.UC_ARM_REG_R0, arm.UC_ARM_REG_R1, arm.UC_ARM_REG_R2, arm.UC_ARM_REG_R3, arm.UC_ARM_REG_R4, arm.UC_ARM_REG_R5,
    arm.UC_ARM_REG_R6, arm.UC_ARM_REG_R7, arm.UC_ARM_REG_R8, arm.UC_ARM_REG_R9, arm.UC_ARM_REG_R10, arm.UC_ARM_REG_R11,
    arm.UC_ARM_REG_R12, arm.UC_ARM_REG_SP, arm.UC_ARM_REG_LR, arm.UC_ARM_REG_PC, arm.UC_ARM_REG_XPSR,
]
NAMES = [*(f"r{n}" for n in range(13)), "sp", "lr", "pc", "xpsr"]


class Difference(Exception):
    """The two cores do not agree."""


class Replay:
    def __init__(self, elf):
        self.uc = uc = Uc(UC_ARCH_ARM, UC_MODE_THUMB | UC_MODE_MCLASS)
        uc.ctl_set_cpu_model(arm.UC_CPU_ARM_CORTEX_M4)
        for base, size in ((FLASH, FLASH_BYTES), (SRAM, SRAM_BYTES), (CCM, CCM_BYTES), (SYSTEM, SYSTEM_BYTES)):
            uc.mem_map(base, size)
        uc.mem_write(FLASH, b"\xff" * FLASH_BYTES)
        for segment in elf.iter_segments():
            if segment["p_type"] == "PT_LOAD" and segment["p_filesz"] and FLASH <= segment["p_paddr"] < FLASH + FLASH_BYTES:
                uc.mem_write(segment["p_paddr"], segment.data())
        for address, value in AFTER_RESET.items():
            uc.mem_write(address, struct.pack("<I", value))
        for base, size in RECORDED:
            uc.mmio_map(base, size, self.read, base, self.write, base)
        uc.mmio_map(BITS, BITS_BYTES, self.read_bit, None, self.write_bit, None)
        uc.hook_add(UC_HOOK_BLOCK, self.block)
        self.accesses, self.at = (), 0
        self.problem = None
        self.blocks = set()
        self.counts = collections.Counter()

    def block(self, uc, address, size, _):
        self.blocks.add((address, size))

    def take(self, kind, address, size):
        """The next recorded access, which must be this one."""
        if self.at < len(self.accesses):
            access = self.accesses[self.at]
            self.at += 1
            if access[0] == kind and access[2] == address and access[1] == size:
                return access[3]
            other = f"{chr(access[0])} of {access[1]} bytes at {access[2]:08X}"
        else:
            other = "none"
        self.problem = self.problem or f"access {chr(kind)} of {size} bytes at {address:08X}; recorded: {other}"
        self.uc.emu_stop()
        return 0

    def store(self, address, size, value):
        recorded = self.take(ord("W"), address, size)
        value &= (1 << 8 * size) - 1
        self.counts["stores to peripherals"] += 1
        if recorded != value and not self.problem:
            self.problem = f"{value:08X} is stored at {address:08X}; recorded: {recorded:08X}"
            self.uc.emu_stop()

    def read(self, uc, offset, size, base):
        self.counts["reads of peripherals"] += 1
        return self.take(ord("R"), base + offset, size)

    def write(self, uc, offset, size, value, base):
        self.store(base + offset, size, value)

    def read_bit(self, uc, offset, size, _):
        return self.take(ord("R"), 0x4000_0000 + (offset >> 7 << 2), 4) >> (offset >> 2 & 31) & 1

    def write_bit(self, uc, offset, size, value, _):
        address, bit = 0x4000_0000 + (offset >> 7 << 2), offset >> 2 & 31
        word = self.take(ord("R"), address, 4)
        self.store(address, 4, word & ~(1 << bit) | (value & 1) << bit)

    def jump(self, registers, frame):
        for name, value in zip(REGISTERS[:16], registers):
            self.uc.reg_write(name, value | 1 if name == arm.UC_ARM_REG_PC else value)
        flags = self.uc.reg_read(arm.UC_ARM_REG_XPSR) & ~FLAGS | registers[16] & FLAGS
        self.uc.reg_write(arm.UC_ARM_REG_XPSR, flags)
        if frame:
            self.uc.mem_write(registers[13], frame)
            self.counts["exceptions"] += 1
        self.counts["jumps"] += 1

    def stretch(self, count, accesses, registers):
        uc = self.uc
        self.accesses, self.at = accesses, 0
        start = uc.reg_read(arm.UC_ARM_REG_PC)
        try:
            uc.emu_start(start | 1, 0xFFFF_FFFE, count=count)
        except UcError as error:
            self.problem = self.problem or f"Unicorn: {error} at {uc.reg_read(arm.UC_ARM_REG_PC):08X}"
        own = [uc.reg_read(name) for name in REGISTERS]
        own[16] &= FLAGS
        theirs = [*registers[:16], registers[16] & FLAGS]
        if not self.problem and self.at != len(accesses):
            self.problem = f"{len(accesses) - self.at} accesses are missing"
        if not self.problem and own != theirs:
            differing = [
                f"{name} {mine:08X}, recorded {other:08X}" for name, mine, other in zip(NAMES, own, theirs) if mine != other
            ]
            self.problem = "; ".join(differing)
        self.counts["instructions"] += count
        self.counts["stretches"] += 1
        if self.problem:
            raise Difference(f"in {count} instructions from {start:08X}: {self.problem}")

    def picture(self, memories, first):
        for (base, name), theirs in zip(((SRAM, "SRAM"), (CCM, "CCM"), (SECTOR, "flash")), memories):
            own = bytes(self.uc.mem_read(base, len(theirs)))
            if own != theirs and not first and base != SECTOR:
                at = next(n for n in range(0, len(own), 4) if own[n : n + 4] != theirs[n : n + 4])
                mine, other = own[at : at + 4][::-1].hex(), theirs[at : at + 4][::-1].hex()
                raise Difference(f"{name} at {base + at:08X} holds {mine}, recorded: {other}")
            if own != theirs:
                # What starts undefined, and what the flash interface erased by itself.
                self.uc.mem_write(base, theirs)
                self.counts["sectors erased"] += base == SECTOR and not first
        self.counts["pictures of the memories"] += 1


def pieces(file):
    def numbers(count):
        return struct.unpack(f"<{count}I", file.read(4 * count))

    while kind := file.read(1):
        if kind == b"M":
            yield kind, [file.read(size) for size in (SRAM_BYTES, CCM_BYTES, SECTOR_BYTES)]
        elif kind == b"J":
            registers = numbers(17)
            yield kind, (registers, file.read(32) if file.read(1) == b"\1" else None)
        elif kind == b"S":
            count, size = numbers(2)
            accesses = list(struct.iter_unpack("<BBxxII", file.read(12 * size)))
            yield kind, (count, accesses, numbers(17))
        else:
            raise SystemExit(f"replay.py: {file.name} is not a recording of this version")


def main():
    if len(sys.argv) != 3:
        print(__doc__.split("\n\n")[1].strip(), file=sys.stderr)
        return 2
    with open(sys.argv[1], "rb") as elf_file, open(sys.argv[2], "rb") as file:
        elf = ELFFile(elf_file)
        replay = Replay(elf)
        difference, first = None, True
        try:
            for kind, piece in pieces(file):
                if kind == b"M":
                    replay.picture(piece, first)
                    first = False
                elif kind == b"J":
                    replay.jump(*piece)
                else:
                    replay.stretch(*piece)
        except Difference as found:
            difference = found
        code = sum(s["p_filesz"] for s in elf.iter_segments() if s["p_type"] == "PT_LOAD" and s["p_flags"] & 1)
        covered = len({byte for address, size in replay.blocks for byte in range(address, address + size)})
        print(", ".join(f"{count} {what}" for what, count in replay.counts.items()))
        print(f"{covered} of {code} bytes of code were executed ({100 * covered / max(code, 1):.1f} %)")
        print(f"DIFFERENCE {difference}" if difference else "no difference")
        return 1 if difference else 0


if __name__ == "__main__":
    sys.exit(main())
