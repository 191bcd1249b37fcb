//! Which revision of the chip this is, as far as the firmware must know.

/// DBGMCU_IDCODE of revision A: the device number of an STM32F2, by mistake (ES0182, "MCU device ID is incorrect").
const IDCODE_A: u32 = 0x2000_6411;
/// DBGMCU_IDCODE of revision A, if it had the device number of an STM32F405 (RM0090, DBGMCU_IDCODE: revision 0x1000 is A).
const IDCODE_A_CORRECT: u32 = 0x1000_6413;
/// CPUID of the Cortex-M4 r0p1 in an STM32F405, which an STM32F2 does not have.
const CPUID: u32 = 0x410F_C241;

/// Whether flash must be read without caches and prefetch, because the chip is of revision A, as on early STM32F4DISCOVERY boards. Such chips
/// crash at random with them: ChibiOS (`os/hal/ports/STM32/STM32F4xx/hal_lld.c`) compares the same two registers and leaves the caches off,
/// and ST's drivers leave the prefetch off.
pub const fn reads_flash_uncached(idcode: u32, cpuid: u32) -> bool {
    cpuid == CPUID && (idcode == IDCODE_A || idcode == IDCODE_A_CORRECT)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_revision_a_goes_without_caches() {
        assert!(reads_flash_uncached(0x2000_6411, 0x410F_C241));
        assert!(reads_flash_uncached(0x1000_6413, 0x410F_C241));
        // Revisions Z, 1 and 2 (RM0090, DBGMCU_IDCODE), an STM32F2, and a chip that says nothing.
        for idcode in [0x1001_6413, 0x1003_6413, 0x1007_6413, 0] {
            assert!(!reads_flash_uncached(idcode, 0x410F_C241), "{idcode:08X}");
        }
        assert!(!reads_flash_uncached(0x2000_6411, 0x412F_C230));
    }
}
