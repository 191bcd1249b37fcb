//! Where everything is (RM0090 Rev 21 §2.3, DS8626 Rev 10 Table 10).

use std::ops::Range;

/// Main flash, 1 MiB.
pub const FLASH: Range<u32> = 0x0800_0000..0x0810_0000;
/// Core-coupled memory, 64 KiB: data only, not reachable by peripherals.
pub const CCM: Range<u32> = 0x1000_0000..0x1001_0000;
/// SRAM1 (112 KiB) and SRAM2 (16 KiB), contiguous.
pub const SRAM: Range<u32> = 0x2000_0000..0x2002_0000;
/// ROM bootloader, OTP area, unique ID, flash size, calibration values, option bytes.
pub const SYSTEM_MEMORY: Range<u32> = 0x1FFF_0000..0x2000_0000;
/// The ROM bootloader's part of it.
pub const BOOTLOADER: Range<u32> = 0x1FFF_0000..0x1FFF_7800;
/// Every peripheral of APB1, APB2, AHB1 and AHB2.
pub const PERIPHERALS: Range<u32> = 0x4000_0000..0x6000_0000;
/// The registers of RCC and of the flash interface, which set the speed of everything.
pub const CLOCKS_AND_FLASH: Range<u32> = 0x4002_3800..0x4002_4000;
/// The MCU's debug component, in the vendor part of the private peripheral bus.
pub const DBGMCU: Range<u32> = 0xE004_2000..0xE004_2400;

/// OTG_FS: base address, and bytes of its register and FIFO windows.
pub const OTG_FS: Range<u32> = 0x5000_0000..0x5004_0000;
/// OTG_FS's interrupt number.
pub const OTG_FS_IRQ: u16 = 67;
