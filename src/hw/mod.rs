//! The board's side of the firmware: the logic's traits over stm32f4xx-hal and the chip's registers. The only
//! place with `unsafe`. What is decided here is how, never what: that is the logic's.

pub mod access;
pub mod can;
pub mod chip;
mod flash;
mod leds;
mod restart;
mod sensors;
pub mod stamp;
pub mod tick;
pub mod usb;
pub mod watchdog;

use cantap_firmware::CAN_CLOCK_HZ;
use cantap_firmware::command::Identity;
use stm32f4xx_hal::pac;
use stm32f4xx_hal::prelude::*;
use stm32f4xx_hal::rcc::{Config, Rcc};

use crate::board::{self, Ports};

/// The protocol's version, for those who load the ELF ([`cantap_wire::PROTOCOL_SYMBOL`]).
// SAFETY: no other symbol has this name. `used`, because nothing in the firmware reads it.
#[used]
#[unsafe(no_mangle)]
static CANTAP_PROTOCOL_VERSION: u16 = cantap_wire::PROTOCOL_VERSION;

/// Everything that the tasks need, set up and running; both controllers are off the bus.
pub struct Hardware {
    /// Both CAN controllers.
    pub can: can::Controllers,
    /// The stamp timer.
    pub stamp: stamp::StampTimer,
    /// The millisecond tick.
    pub tick: tick::Tick,
    /// The virtual COM port.
    pub usb: usb::UsbPort,
    /// The chip.
    pub chip: chip::BoardChip,
    /// The watchdog.
    pub watchdog: watchdog::Watchdog,
    /// Who the device is.
    pub identity: Identity,
    /// Whether the last run ended by a panic, a fault or the watchdog.
    pub restarted_after_failure: bool,
}

/// Sets the board up. To be called once, first of all.
pub fn start(device: pac::Peripherals, usb_memory: &'static mut usb::Memory) -> Hardware {
    let restarted_after_failure = restart::begin(&device.RCC, &device.SYSCFG);
    let watchdog = watchdog::Watchdog::start(device.IWDG, &device.DBGMCU);
    let mut rcc = clocks(device.RCC);
    let ports = Ports { a: device.GPIOA, b: device.GPIOB, c: device.GPIOC, d: device.GPIOD };
    let usb = (device.OTG_FS_GLOBAL, device.OTG_FS_DEVICE, device.OTG_FS_PWRCLK);
    let connected = board::connect(ports, usb, &mut rcc);
    let serial = chip::serial_number();
    let sensors = sensors::Sensors::start(device.ADC1, &device.ADC_COMMON, &mut rcc);
    Hardware {
        can: can::Controllers::new(device.CAN1, device.CAN2, &mut rcc),
        stamp: stamp::StampTimer::start(device.TIM2, &mut rcc),
        tick: tick::Tick::start(device.TIM7, &mut rcc),
        usb: usb::UsbPort::new(connected.usb, &serial, usb_memory),
        chip: chip::BoardChip::new(sensors, flash::LastSector::new(device.FLASH), connected.leds),
        watchdog,
        identity: Identity { board: board::NAME, serial },
        restarted_after_failure,
    }
}

/// 144 MHz for the processor, a quarter of it for CAN, 48 MHz for USB: from a crystal of 8 or 12 MHz by a PLL at
/// 288 MHz, divided by 2 and by 6.
fn clocks(rcc: pac::RCC) -> Rcc {
    let config = Config::hse(board::HSE_MHZ.MHz())
        .sysclk(144.MHz())
        .pclk1(CAN_CLOCK_HZ.Hz())
        .pclk2(72.MHz())
        .require_pll48clk();
    let rcc = rcc.freeze(config);
    // Wrong clocks would give wrong bit rates. Holds for every board above, whatever the HAL's search finds first.
    assert!(rcc.clocks.pclk1().raw() == CAN_CLOCK_HZ && rcc.clocks.is_pll48clk_valid(), "clocks");
    rcc
}
