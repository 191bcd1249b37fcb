//! The firmware's RTIC application: which interrupt does what, at which priority.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod board;
#[cfg(target_os = "none")]
mod hw;

#[cfg(not(target_os = "none"))]
fn main() {
    eprintln!("this program is for the board; build it with `cargo fw`, and use the library on the host");
}

#[cfg(target_os = "none")]
#[rtic::app(device = stm32f4xx_hal::pac, peripherals = true)]
mod app {
    use cantap_firmware::lights::Activity;
    use cantap_firmware::ports::Port;

    use crate::hw;

    #[shared]
    struct Shared {}

    #[local]
    struct Local {
        hw: hw::Hardware,
    }

    #[init(local = [usb_memory: hw::usb::Memory = hw::usb::Memory::new()])]
    fn init(cx: init::Context) -> (Shared, Local) {
        let hw = hw::start(cx.device, cx.local.usb_memory);
        (Shared {}, Local { hw })
    }

    #[task(binds = TIM7, local = [hw])]
    fn tim7(cx: tim7::Context) {
        let hw = cx.local.hw;
        hw.tick.acknowledge();
        hw.watchdog.feed();
        hw.chip.tick(Activity::default());
        hw.usb.poll();
        let mut packet = [0; 64];
        while hw.usb.read(&mut packet).is_some() {}
    }

    #[idle]
    fn idle(_: idle::Context) -> ! {
        loop {
            cortex_m::asm::wfi();
        }
    }
}
