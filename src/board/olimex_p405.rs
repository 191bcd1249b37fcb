//! Olimex STM32-P405: STM32F405RGT6 with a CAN transceiver (SN65HVD230) and a USB connector on board.
//!
//! Sources:
//! - Zephyr 4.3 `boards/olimex/stm32_p405` (`olimex_stm32_p405.dts` and `doc/index.rst`): crystal 8 MHz, CAN1 on
//!   PB8/PB9, LED on PC12, the pins of the GPIO row and of UEXT.
//! - The circuit board is the STM32-P103's, as the name of Olimex's schematic, `STM32-P103_P405_sch.pdf`, says. ChibiOS
//!   `os/hal/boards/OLIMEX_STM32_P103/board.h`: PC10 is the transceiver's mode pin, PC11 low connects a pull-up to the USB
//!   line, PB12 to PB15 go to the card socket. Zephyr's `doc/index.rst` lists PB12 in the GPIO row, too; on a card it is the
//!   select line, an input, so a card in the socket does not disturb it.
//! - Feaser LibMicroBLT `demos/ARMCM4_STM32F4_Olimex_STM32P405_CubeIDE/App/led.c`: PC12 low lights the LED. (Zephyr
//!   and RIOT say high; this demonstration was made for this board, and the P103's LED is lit by low, too.)
//! - stm32f4xx-hal 0.23 `src/gpio/alt/f4.rs`: AF9 is CAN1 on PB8/PB9 and CAN2 on PB12/PB6, AF10 is OTG_FS on PA11/PA12.
//! - AN2606, "STM32F40xxx/41xxx": the ROM bootloader listens on CAN2's other pins, PB5 and PB13. Channel 2 uses neither here, so
//!   bus traffic cannot draw the bootloader away from USB.
//! - SN65HVD230 data sheet (SLOS346), "RS": low selects the high-speed mode.

use stm32f4xx_hal::gpio::{GpioExt, PC12, PinState};
use stm32f4xx_hal::rcc::Rcc;

use super::{Connected, Led, Leds, Port, Ports, ReceivePin, TransmitPin};

/// Name of the board, as in `Hello`.
pub const NAME: &str = "olimex-p405";
/// Crystal, in MHz.
pub const HSE_MHZ: u32 = 8;

/// Each channel's RX.
pub const RECEIVE_PINS: [ReceivePin; 2] =
    [ReceivePin { port: Port::B, pin: 8 }, ReceivePin { port: Port::B, pin: 12 }];

/// Whether USB's VBUS is on PA9. Not stated by the sources; the board is powered by its USB connector.
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
    // Low selects the transceiver's high-speed mode; high would be standby.
    c.pc10.into_push_pull_output_in_state(PinState::Low);
    // The chip pulls the USB line up itself.
    c.pc11.into_push_pull_output_in_state(PinState::High);

    Connected {
        leds: led(c.pc12),
        transmit: [TransmitPin::B9(b.pb9.into_pull_up_input()), TransmitPin::B6(b.pb6.into_pull_up_input())],
    }
}

/// Connects the LED only.
pub fn leds(ports: Ports, rcc: &mut Rcc) -> Leds {
    led(ports.c.split(rcc).pc12)
}

fn led(pc12: PC12) -> Leds {
    let led = pc12.into_push_pull_output_in_state(PinState::High);
    Leds::One(Led::new(led.erase(), PinState::Low))
}
