//! The boards: one file each, chosen by a feature. A board file says what is connected where, with
//! the source of each statement; what is done with it is `hw`'s business.

#[cfg(feature = "feather-f405")]
mod feather_f405;
#[cfg(feature = "olimex-p405")]
mod olimex_p405;
#[cfg(feature = "stm32f4-discovery")]
mod stm32f4_discovery;

#[cfg(feature = "feather-f405")]
pub use feather_f405::{HSE_MHZ, NAME, RECEIVE_PINS, SENSES_VBUS, connect, leds};
#[cfg(feature = "olimex-p405")]
pub use olimex_p405::{HSE_MHZ, NAME, RECEIVE_PINS, SENSES_VBUS, connect, leds};
#[cfg(feature = "stm32f4-discovery")]
pub use stm32f4_discovery::{HSE_MHZ, NAME, RECEIVE_PINS, SENSES_VBUS, connect, leds};

#[cfg(not(any(feature = "olimex-p405", feature = "feather-f405", feature = "stm32f4-discovery")))]
compile_error!("choose a board: --features olimex-p405, feather-f405 or stm32f4-discovery");

use stm32f4xx_hal::gpio::{self, AnyPin, Output, PinSpeed, PinState, Speed};
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

/// The port of a receive pin, by its number among EXTI's sources (RM0090, SYSCFG_EXTICR1).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Port {
    /// Port B.
    B = 1,
    /// Port D.
    #[cfg(feature = "stm32f4-discovery")]
    D = 3,
}

/// A CAN controller's RX pin. The two channels' pins have different numbers, because an EXTI line serves one pin number of all
/// ports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReceivePin {
    /// The port.
    pub port: Port,
    /// 0 to 15.
    pub pin: u8,
}

/// A CAN controller's TX pin that is not connected to it yet: an input with a pull-up, which the transceiver reads as recessive.
///
/// On a live bus, what a controller does while it is reset or has no clock must not reach the pin. On an STM32F107, TX was seen to be stuck
/// dominant after about one in ten resets by RCC in silent mode (libcyphal, pull request 69).
pub enum TransmitPin {
    /// PB6.
    #[cfg(feature = "olimex-p405")]
    B6(gpio::PB6),
    /// PB9.
    #[cfg(any(feature = "olimex-p405", feature = "feather-f405"))]
    B9(gpio::PB9),
    /// PB13.
    #[cfg(any(feature = "feather-f405", feature = "stm32f4-discovery"))]
    B13(gpio::PB13),
    /// PD1.
    #[cfg(feature = "stm32f4-discovery")]
    D1(gpio::PD1),
}

impl TransmitPin {
    /// Connects it to its controller, which must be in initialisation mode: TX is recessive then (RM0090, "Initialization mode").
    pub fn connect(self) {
        match self {
            #[cfg(feature = "olimex-p405")]
            Self::B6(pin) => {
                fast(pin.into_alternate::<9>());
            }
            #[cfg(any(feature = "olimex-p405", feature = "feather-f405"))]
            Self::B9(pin) => {
                fast(pin.into_alternate::<9>());
            }
            #[cfg(any(feature = "feather-f405", feature = "stm32f4-discovery"))]
            Self::B13(pin) => {
                fast(pin.into_alternate::<9>());
            }
            #[cfg(feature = "stm32f4-discovery")]
            Self::D1(pin) => {
                fast(pin.into_alternate::<9>());
            }
        }
    }
}

/// The edges of a TX pin must take next to nothing of the shortest bit, 1 µs: at the lowest speed, the default after a reset, an
/// edge may take 100 ns (STM32F405 data sheet, "I/O AC characteristics"), and rising and falling edges differ.
fn fast<P: PinSpeed>(pin: P) -> P {
    pin.speed(Speed::High)
}

/// What a board's pins lead to.
pub struct Connected {
    /// The LEDs.
    pub leds: Leds,
    /// Each channel's TX.
    pub transmit: [TransmitPin; 2],
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

    /// Switches it on or off.
    pub fn set(&mut self, lit: bool) {
        self.pin.set_state(if lit { self.on } else { !self.on });
    }
}

/// The board's LEDs that the analyser uses.
pub enum Leds {
    /// One, which must show everything.
    One(Led),
    /// One for each thing to show.
    Three {
        /// There is power and a host.
        power: Led,
        /// Frames pass.
        traffic: Led,
        /// Something is wrong.
        error: Led,
    },
}

/// A TX pin that is an output of TIM4, too (STM32F405 data sheet, "Alternate function mapping", AF2).
#[cfg(feature = "disturb")]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PulsePin {
    /// Channel 1.
    B6,
    /// Channel 4.
    B9,
}

/// Each channel's TX, if it is one. PD1 is no timer's; PB13 is a complementary output of TIM1, which this firmware does not use.
#[cfg(feature = "disturb")]
pub const PULSE_PINS: [Option<PulsePin>; 2] = if cfg!(feature = "olimex-p405") {
    [Some(PulsePin::B9), Some(PulsePin::B6)]
} else if cfg!(feature = "feather-f405") {
    [Some(PulsePin::B9), None]
} else {
    [None, None]
};
