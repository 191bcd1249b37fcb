//! The board's side of the firmware: implements the logic's traits with stm32f4xx-hal and the chip's
//! registers. The only place with `unsafe`. This code decides how things are done; the logic decides what is
//! done.

pub mod access;
pub mod can;
pub mod chip;
mod clocks;
mod copy;
pub mod crc;
#[cfg(feature = "disturb")]
pub mod disturb;
pub mod edges;
mod entry;
mod failure;
mod flash;
mod leds;
mod message;
mod restart;
mod sensors;
pub mod sof;
pub mod stamp;
pub mod tick;
pub mod usb;
pub mod watchdog;

use core::sync::atomic::AtomicU32;

use cantap_firmware::lights;
use cantap_firmware::port::command::Identity;
use cantap_wire::CHANNELS;
use cantap_wire::image::ImageInfo;
use stm32f4xx_hal::pac;
use stm32f4xx_hal::prelude::*;

use crate::board::{self, Leds, Ports};

/// The protocol version, for programs that load the ELF ([`cantap_wire::PROTOCOL_SYMBOL`]).
// SAFETY: no other symbol has this name. `used`, because nothing in the firmware reads it.
#[used]
#[unsafe(no_mangle)]
static CANTAP_PROTOCOL_VERSION: u16 = cantap_wire::PROTOCOL_VERSION;

/// The buses' receive pins, for programs that load the ELF ([`cantap_wire::RECEIVE_PINS_SYMBOL`]).
// SAFETY: as above.
#[used]
#[unsafe(no_mangle)]
static CANTAP_RECEIVE_PINS: [[u8; 2]; CHANNELS] = {
    let [one, two] = board::RECEIVE_PINS;
    [[one.port as u8, one.pin], [two.port as u8, two.pin]]
};

/// What the image says about itself, for the command that writes it ([`cantap_wire::image`]).
// SAFETY: as above.
#[used]
#[unsafe(no_mangle)]
static CANTAP_IMAGE: ImageInfo = ImageInfo::new(board::NAME, cantap_firmware::port::command::VERSION);

/// Everything that the tasks need, set up and running; both controllers are off the bus.
pub struct Hardware {
    /// Both CAN controllers.
    pub can: can::Controllers,
    /// The stamp timer with its alarm.
    pub alarm: stamp::StampAlarm,
    /// What drives a TX pin in place of its controller.
    #[cfg(feature = "disturb")]
    pub pulse: disturb::BusPulse,
    /// Its latch of USB's start of frame.
    pub sof: sof::SofLatch,
    /// The millisecond tick.
    pub tick: tick::Tick,
    /// The CRC unit.
    pub crc: crc::CrcUnit,
    /// The meter for the receive pins.
    pub meter: edges::PinMeter,
    /// Its half for the pins' interrupts.
    pub catcher: edges::EdgeCatcher,
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

/// How long USB stays disconnected if it is found connected at the start, in ms. 2.5 µs are enough for a hub to notice (USB
/// 2.0 §7.1.7.3), but a host's software may need longer.
const DISCONNECTED_MS: u32 = 10;

/// Sets the board up. Call it once, before anything else. `sent_at` is where the transmit interrupts leave their stamps.
pub fn start(
    device: pac::Peripherals,
    usb_memory: &'static mut usb::Memory,
    sent_at: &'static [AtomicU32; CHANNELS],
) -> Hardware {
    let restarted_after_failure = restart::begin(&device.RCC, &device.SYSCFG);
    let found = entry::restore(&device.RCC, &device.SYSCFG, &device.FLASH);
    restart::forget_reset_cause(&device.RCC);
    let mut watchdog = watchdog::Watchdog::start(device.IWDG, &device.DBGMCU);
    let ports = Ports { a: device.GPIOA, b: device.GPIOB, c: device.GPIOC, d: device.GPIOD };
    let mut rcc = device.RCC.constrain();
    if !clocks::start_crystal(&rcc) {
        show_no_crystal(&mut board::leds(ports, &mut rcc), &mut watchdog);
    }
    let mut rcc = clocks::run(rcc);
    if found.usb_was_connected {
        clocks::wait_ms(DISCONNECTED_MS, clocks::SYSCLK_HZ);
    }
    let board::Connected { leds, transmit } = board::connect(ports, &mut rcc);
    let usb = (device.OTG_FS_GLOBAL, device.OTG_FS_DEVICE, device.OTG_FS_PWRCLK);
    let serial = chip::serial_number();
    let sensors = sensors::Sensors::start(device.ADC1, &device.ADC_COMMON, &mut rcc);
    stay_in_reach_of_a_debugger(&device.DBGMCU);
    let alarm = stamp::StampTimer::start(device.TIM2, &mut rcc);
    let timer = alarm.timer();
    let (meter, catcher) = edges::PinMeter::new(device.EXTI, device.SYSCFG, timer, &mut rcc);
    Hardware {
        can: can::Controllers::new((device.CAN1, device.CAN2), transmit, &mut rcc, sent_at),
        sof: sof::SofLatch::start(timer),
        #[cfg(feature = "disturb")]
        pulse: disturb::BusPulse::start(device.TIM4, timer, &mut rcc),
        alarm,
        tick: tick::Tick::start(device.TIM7, &mut rcc),
        crc: crc::CrcUnit::start(device.CRC, &mut rcc),
        meter,
        catcher,
        usb: usb::UsbPort::new(usb, timer, &mut rcc, &serial, usb_memory),
        chip: chip::BoardChip::new(sensors, flash::LastSector::new(device.FLASH, timer), leds),
        watchdog,
        identity: Identity { board: board::NAME, serial },
        restarted_after_failure,
    }
}

/// Running from HSI, shows on the LED for one period of the pattern that the crystal does not start; then restarts the firmware,
/// which tries again. So a board without a crystal blinks for ever, and one whose crystal starts late still comes up.
fn show_no_crystal(leds: &mut Leds, watchdog: &mut watchdog::Watchdog) -> ! {
    failure::record(format_args!("the {} MHz crystal did not start", board::HSE_MHZ));
    for at_ms in 0..lights::NO_CLOCK_MS {
        leds.show(lights::no_clock(at_ms));
        watchdog.feed();
        clocks::wait_ms(1, clocks::HSI_HZ);
    }
    failure::restart()
}

/// Keeps the processor's clock running for a debugger while the processor sleeps (RM0090, DBGMCU_CR, DBG_SLEEP). It costs some
/// of the current that sleep saves. Some ST chips have been seen to execute garbage when they wake from WFI like this with
/// interrupts disabled. So nothing here sleeps with interrupts disabled, and `idle` has a barrier after its WFI.
fn stay_in_reach_of_a_debugger(debug: &pac::DBGMCU) {
    debug.cr().modify(|_, w| w.dbg_sleep().set_bit());
}
