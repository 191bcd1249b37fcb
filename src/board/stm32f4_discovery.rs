//! ST STM32F4DISCOVERY: STM32F407VGT6. Both channels need a transceiver (3.3 V) outside.
//!
//! Sources:
//! - Zephyr 4.3 `boards/st/stm32f4_disco/stm32f4_disco.dts`: crystal 8 MHz; LEDs on PD12 (green), PD13 (orange), PD14
//!   (red), PD15 (blue), lit by high; USB on PA11/PA12; CAN2 on PB5/PB13; PB6/PB9 belong to the audio codec, so CAN1
//!   is not on PB8/PB9.
//! - NuttX `boards/arm/stm32/stm32f4discovery/src/stm32f4discovery.h`: PC0 switches 5 V to the USB connector on, for
//!   when the board is the host; ST's generated code for the board sets it high, which is off.
//! - stm32f4xx-hal 0.23 `src/gpio/alt/f4.rs`: AF9 is CAN1 on PD0/PD1 and CAN2 on PB5/PB13.

use stm32f4xx_hal::gpio::{GpioExt, PinState};
use stm32f4xx_hal::otg_fs::USB;
use stm32f4xx_hal::rcc::Rcc;

use super::{Connected, Led, Leds, Ports, UsbRegisters};

/// Name of the board, as in `Hello`.
pub const NAME: &str = "stm32f4-discovery";
/// Crystal, in MHz.
pub const HSE_MHZ: u32 = 8;

/// Connects pins and peripherals.
pub fn connect(ports: Ports, usb: UsbRegisters, rcc: &mut Rcc) -> Connected {
    let a = ports.a.split(rcc);
    let b = ports.b.split(rcc);
    let c = ports.c.split(rcc);
    let d = ports.d.split(rcc);

    // The pull-ups make an input without a transceiver read recessive.
    d.pd0.into_alternate::<9>().internal_pull_up(true);
    d.pd1.into_alternate::<9>();
    b.pb5.into_alternate::<9>().internal_pull_up(true);
    b.pb13.into_alternate::<9>();
    // The host feeds the board, not the board the host.
    c.pc0.into_push_pull_output_in_state(PinState::High);

    let power = d.pd12.into_push_pull_output_in_state(PinState::Low);
    let traffic = d.pd13.into_push_pull_output_in_state(PinState::Low);
    let error = d.pd14.into_push_pull_output_in_state(PinState::Low);
    Connected {
        usb: USB::new(usb, (a.pa11, a.pa12), &rcc.clocks),
        leds: Leds::Three {
            power: Led::new(power.erase(), PinState::High),
            traffic: Led::new(traffic.erase(), PinState::High),
            error: Led::new(error.erase(), PinState::High),
        },
    }
}
