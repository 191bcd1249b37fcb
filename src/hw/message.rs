//! A message from one run of the firmware to the next: a word of RAM that startup does not touch and that survives every reset
//! except a loss of power.

use core::mem::MaybeUninit;
use core::ptr::{addr_of, addr_of_mut};

/// The next run is to enter the ROM bootloader. This and [`FAILED`] are numbers that RAM is unlikely to hold by chance.
pub const ENTER_BOOTLOADER: u32 = 0xB007_10AD;
/// The run failed, and recorded why.
pub const FAILED: u32 = 0x0BAD_C0DE;

#[unsafe(link_section = ".uninit.cantap_restart")]
static mut MESSAGE: MaybeUninit<u32> = MaybeUninit::uninit();

/// Leaves a message for the next run.
pub fn leave(message: u32) {
    // SAFETY: a plain word, written whole and volatile; nothing holds a reference to it.
    unsafe { addr_of_mut!(MESSAGE).cast::<u32>().write_volatile(message) }
}

/// Takes the last run's message.
pub fn take() -> u32 {
    // SAFETY: as in `leave`. Never initialised, but every value of a word is valid, and a volatile read takes
    // what is there.
    let message = unsafe { addr_of!(MESSAGE).cast::<u32>().read_volatile() };
    leave(0);
    message
}
