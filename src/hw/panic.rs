//! What happens after a panic: the watchdog restarts the chip.

use core::panic::PanicInfo;

/// Stops. The error LED stays as it is; the watchdog resets the chip after its period.
#[panic_handler]
fn panic(_: &PanicInfo) -> ! {
    cortex_m::interrupt::disable();
    loop {
        cortex_m::asm::nop();
    }
}
