//! The firmware's RTIC application: which interrupt does what, at which priority.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(not(target_os = "none"))]
fn main() {
    eprintln!("this program is for the board; build it with `cargo fw`, and use the library on the host");
}

#[cfg(target_os = "none")]
mod hw;

/// The protocol's version, for those who load the ELF ([`cantap_wire::PROTOCOL_SYMBOL`]).
// SAFETY: no other symbol has this name.
#[cfg(target_os = "none")]
#[unsafe(no_mangle)]
static CANTAP_PROTOCOL_VERSION: u16 = cantap_wire::PROTOCOL_VERSION;

#[cfg(target_os = "none")]
#[rtic::app(device = stm32f4xx_hal::pac, peripherals = true)]
mod app {
    use stm32f4xx_hal::prelude::*;
    use stm32f4xx_hal::rcc::Config;

    #[shared]
    struct Shared {}

    #[local]
    struct Local {}

    #[init]
    fn init(cx: init::Context) -> (Shared, Local) {
        let clocks = Config::hse(8.MHz()).sysclk(144.MHz()).pclk1(36.MHz()).require_pll48clk();
        let _rcc = cx.device.RCC.freeze(clocks);
        (Shared {}, Local {})
    }

    #[idle]
    fn idle(_: idle::Context) -> ! {
        loop {
            cortex_m::asm::wfi();
        }
    }
}
