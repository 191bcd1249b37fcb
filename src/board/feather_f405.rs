//! Adafruit Feather STM32F405 Express: STM32F405RGT6. Both channels need a transceiver (3.3 V) outside.
//!
//! Sources:
//! - MicroPython `ports/stm32/boards/ADAFRUIT_F405_EXPRESS` (`mpconfigboard.h`, `pins.csv`): crystal 12 MHz, CAN1 on
//!   D9/D10 (PB8/PB9), LED on PC1 lit by high, USB on PA11/PA12, SD_DETECT on PB12, SCK on PB13, the flash chip's
//!   MOSI on PB5.
//! - Zephyr 4.3 `boards/adafruit/feather_stm32f405`: the same crystal, LED and USB pins.
//! - stm32f4xx-hal 0.23 `src/gpio/alt/f4.rs`: CAN2's RX is PB5 or PB12, its TX PB6 or PB13, all as AF9. Neither RX
//!   pin is on the headers; PB12 goes to the card socket's detect switch, which is open without a card (MicroPython
//!   reads it with a pull-up, low for a card).
//! - AN2606, "STM32F40xxx/41xxx": the ROM bootloader has CAN2's RX on PB5, which has no bus here, and TX on PB13, which is
//!   channel 2's TX here, too.

use stm32f4xx_hal::gpio::{GpioExt, PC1, PinState};
use stm32f4xx_hal::rcc::Rcc;

use super::{Connected, Led, Leds, Port, Ports, ReceivePin, TransmitPin};

/// Name of the board, as in `Hello`.
pub const NAME: &str = "feather-f405";
/// Crystal, in MHz.
pub const HSE_MHZ: u32 = 12;

/// Each channel's RX.
pub const RECEIVE_PINS: [ReceivePin; 2] =
    [ReceivePin { port: Port::B, pin: 8 }, ReceivePin { port: Port::B, pin: 12 }];

/// Whether USB's VBUS is on PA9, according to the sources: no.
pub const SENSES_VBUS: bool = false;

/// Connects pins and peripherals. Each channel's TX is left to its controller.
pub fn connect(ports: Ports, rcc: &mut Rcc) -> Connected {
    let a = ports.a.split(rcc);
    let b = ports.b.split(rcc);
    let c = ports.c.split(rcc);

    a.pa11.into_alternate::<10>();
    a.pa12.into_alternate::<10>();
    // The pull-ups make an input without a transceiver read recessive.
    b.pb8.into_alternate::<9>().internal_pull_up(true);
    b.pb12.into_alternate::<9>().internal_pull_up(true);

    Connected {
        leds: led(c.pc1),
        transmit: [
            TransmitPin::B9(b.pb9.into_pull_up_input()),
            TransmitPin::B13(b.pb13.into_pull_up_input()),
        ],
    }
}

/// Connects the LED only.
pub fn leds(ports: Ports, rcc: &mut Rcc) -> Leds {
    led(ports.c.split(rcc).pc1)
}

fn led(pc1: PC1) -> Leds {
    let led = pc1.into_push_pull_output_in_state(PinState::Low);
    Leds::One(Led::new(led.erase(), PinState::High))
}
