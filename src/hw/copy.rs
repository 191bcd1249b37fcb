//! Copies memory, in place of the compiler's runtime library.
//!
//! The library's version is made for cores that cannot read a word across a word boundary: it assembles such words from two, in some 22
//! cycles for four bytes, and copies fewer than 16 bytes one by one. Records have any length, so hardly anything copied here is aligned. A
//! Cortex-M4's LDR and STR accept unaligned words in memory, at a small cost in speed (Cortex-M4 devices generic user guide, ARM DUI 0553A,
//! 3.3.5); CCR.UNALIGN_TRP, which would make them fault, is off after a reset. Registers are never copied like this.

use core::arch::global_asm;

global_asm!(
    ".section .text.memcpy, \"ax\", %progbits",
    ".global memcpy, __aeabi_memcpy, __aeabi_memcpy4, __aeabi_memcpy8",
    ".type memcpy, %function",
    ".type __aeabi_memcpy, %function",
    ".type __aeabi_memcpy4, %function",
    ".type __aeabi_memcpy8, %function",
    ".balign 16",
    ".thumb_func",
    "memcpy:",
    ".thumb_func",
    "__aeabi_memcpy:",
    ".thumb_func",
    "__aeabi_memcpy4:",
    ".thumb_func",
    "__aeabi_memcpy8:",
    // The destination, r0, is what memcpy returns.
    "    mov   r12, r0",
    "    subs  r2, #16",
    "    blo   2f",
    "1:  ldr   r3, [r1], #4",
    "    str   r3, [r12], #4",
    "    ldr   r3, [r1], #4",
    "    str   r3, [r12], #4",
    "    ldr   r3, [r1], #4",
    "    str   r3, [r12], #4",
    "    ldr   r3, [r1], #4",
    "    str   r3, [r12], #4",
    "    subs  r2, #16",
    "    bhs   1b",
    // 0 to 15 bytes are left: r2 is that number minus 16, then minus 4.
    "2:  adds  r2, #12",
    "    bmi   4f",
    "3:  ldr   r3, [r1], #4",
    "    str   r3, [r12], #4",
    "    subs  r2, #4",
    "    bpl   3b",
    "4:  adds  r2, #4",
    "    beq   6f",
    "5:  ldrb  r3, [r1], #1",
    "    strb  r3, [r12], #1",
    "    subs  r2, #1",
    "    bne   5b",
    "6:  bx    lr",
    ".size memcpy, . - memcpy",
    ".size __aeabi_memcpy, . - memcpy",
    ".size __aeabi_memcpy4, . - memcpy",
    ".size __aeabi_memcpy8, . - memcpy",
);
