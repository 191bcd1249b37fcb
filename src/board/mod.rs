//! The boards: one file each, chosen by a feature. A board file says where things are connected, with
//! the source of each statement; what is done with them is `hw`'s business.

#[cfg(feature = "feather-f405")]
mod feather_f405;
#[cfg(feature = "olimex-p405")]
mod olimex_p405;
#[cfg(feature = "stm32f4-discovery")]
mod stm32f4_discovery;

#[cfg(feature = "feather-f405")]
pub use feather_f405::{HSE_MHZ, NAME, connect};
#[cfg(feature = "olimex-p405")]
pub use olimex_p405::{HSE_MHZ, NAME, connect};
#[cfg(feature = "stm32f4-discovery")]
pub use stm32f4_discovery::{HSE_MHZ, NAME, connect};

#[cfg(not(any(feature = "olimex-p405", feature = "feather-f405", feature = "stm32f4-discovery")))]
compile_error!("choose a board: --features olimex-p405, feather-f405 or stm32f4-discovery");

use stm32f4xx_hal::gpio::{AnyPin, Output, PinState};
use stm32f4xx_hal::otg_fs::USB;
use stm32f4xx_hal::pac;

/// The chip's ports that boards use.
#[cfg_attr(not(feature = "stm32f4-discovery"), expect(dead_code, reason = "this board needs no port D"))]
pub struct Ports {
    /// Port A: USB.
    pub a: pac::GPIOA,
    /// Port B.
    pub b: pac::GPIOB,
    /// Port C.
    pub c: pac::GPIOC,
    /// Port D.
    pub d: pac::GPIOD,
}

/// The USB peripheral, to be connected to its pins.
pub type UsbRegisters = (pac::OTG_FS_GLOBAL, pac::OTG_FS_DEVICE, pac::OTG_FS_PWRCLK);

/// What a board's file makes of the pins. The CAN pins need nothing more once they are connected.
pub struct Connected {
    /// USB on its pins.
    pub usb: USB,
    /// The LEDs.
    pub leds: Leds,
}

/// An LED and the level that lights it.
pub struct Led {
    pin: AnyPin<Output>,
    on: PinState,
}

impl Led {
    /// An LED that is lit by `on`.
    pub fn new(pin: impl Into<AnyPin<Output>>, on: PinState) -> Self {
        Self { pin: pin.into(), on }
    }

    /// Lights it or puts it out.
    pub fn set(&mut self, lit: bool) {
        self.pin.set_state(if lit { self.on } else { !self.on });
    }
}

/// The LEDs that a board has for the analyser.
pub enum Leds {
    /// One, which must tell everything.
    One(Led),
    /// One for each thing to tell.
    Three {
        /// There is power and a host.
        power: Led,
        /// Frames pass.
        traffic: Led,
        /// Something is wrong.
        error: Led,
    },
}
