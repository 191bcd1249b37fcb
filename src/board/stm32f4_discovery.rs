//! ST STM32F4DISCOVERY: STM32F407VGT6. Both channels need a transceiver (3.3 V) outside.
//!
//! Sources:
//! - Zephyr 4.3 `boards/st/stm32f4_disco/stm32f4_disco.dts`: crystal 8 MHz; LEDs on PD12 (green), PD13 (orange), PD14
//!   (red), PD15 (blue), lit by high; USB on PA11/PA12; CAN2's TX on PB13; PB6/PB9 belong to the audio codec, so CAN1
//!   is not on PB8/PB9.
//! - NuttX `boards/arm/stm32/stm32f4discovery/README.txt`, "UART/USART PINS", which takes this from the board's user guide: PB12
//!   and PB13 have no function on the board.
//! - AN2606, "STM32F40xxx/41xxx": the ROM bootloader has CAN2's RX on PB5, which has no bus here, and TX on PB13, which is
//!   channel 2's TX here, too.
//! - NuttX `boards/arm/stm32/stm32f4discovery/src/stm32f4discovery.h`: PC0 switches on 5 V to the USB connector, for
//!   use as a host; ST's generated code for the board sets it high, which is off.
//! - MicroPython `ports/stm32/boards/STM32F4DISC/mpconfigboard.h`: PA9 detects USB's VBUS.
//! - stm32f4xx-hal 0.23 `src/gpio/alt/f4.rs`: AF9 is CAN1 on PD0/PD1 and CAN2 on PB12/PB13.

use stm32f4xx_hal::gpio::{GpioExt, PD12, PD13, PD14, PinState};
use stm32f4xx_hal::rcc::Rcc;

use super::{Connected, Led, Leds, Port, Ports, ReceivePin, TransmitPin};

/// Name of the board, as in `Hello`.
pub const NAME: &str = "stm32f4-discovery";
/// Crystal, in MHz.
pub const HSE_MHZ: u32 = 8;

/// Each channel's RX.
pub const RECEIVE_PINS: [ReceivePin; 2] =
    [ReceivePin { port: Port::D, pin: 0 }, ReceivePin { port: Port::B, pin: 12 }];

/// Whether USB's VBUS is on PA9, which is left an input as after a reset: yes, and it is sensed. The board is powered by its other connector, the debugger's: without
/// sensing it would pull the USB line up with no host there (USB 2.0, 7.1.5: not before VBUS is present).
pub const SENSES_VBUS: bool = true;

/// Connects pins and peripherals. Each channel's TX is left to its controller.
pub fn connect(ports: Ports, rcc: &mut Rcc) -> Connected {
    let a = ports.a.split(rcc);
    let b = ports.b.split(rcc);
    let c = ports.c.split(rcc);
    let d = ports.d.split(rcc);

    a.pa11.into_alternate::<10>();
    a.pa12.into_alternate::<10>();
    // The pull-ups make an input without a transceiver read recessive.
    d.pd0.into_alternate::<9>().internal_pull_up(true);
    b.pb12.into_alternate::<9>().internal_pull_up(true);
    // The host powers the board, not the other way round.
    c.pc0.into_push_pull_output_in_state(PinState::High);

    Connected {
        leds: three(d.pd12, d.pd13, d.pd14),
        transmit: [
            TransmitPin::D1(d.pd1.into_pull_up_input()),
            TransmitPin::B13(b.pb13.into_pull_up_input()),
        ],
    }
}

/// Connects the LEDs only.
pub fn leds(ports: Ports, rcc: &mut Rcc) -> Leds {
    let d = ports.d.split(rcc);
    three(d.pd12, d.pd13, d.pd14)
}

fn three(pd12: PD12, pd13: PD13, pd14: PD14) -> Leds {
    let power = pd12.into_push_pull_output_in_state(PinState::Low);
    let traffic = pd13.into_push_pull_output_in_state(PinState::Low);
    let error = pd14.into_push_pull_output_in_state(PinState::Low);
    Leds::Three {
        power: Led::new(power.erase(), PinState::High),
        traffic: Led::new(traffic.erase(), PinState::High),
        error: Led::new(error.erase(), PinState::High),
    }
}
