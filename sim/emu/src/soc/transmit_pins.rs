//! The pins on which the CAN controllers send, as far as they can drive a bus although no controller sends: a controller that is stuck, a
//! pin that a program has made an output, and a pin that is connected to a timer instead.

use super::rcc::Rcc;
use super::small::Gpio;
use super::timer::Timer;
use crate::Clock;
use crate::hostile::{CanFaults, Dice, Hostile};

/// The alternate function of CAN (DS8626, "Alternate function mapping").
const CAN: u32 = 9;
/// Every pin that can be each controller's TX: port (0 for A) and pin (DS8626, as above).
const TX: [&[(usize, u32)]; 2] = [&[(0, 12), (1, 9), (3, 1), (7, 13)], &[(1, 6), (1, 13)]];
/// The alternate function of TIM4, and its channels among the TX pins: controller, port, pin and channel from 0 (DS8626, as above).
const TIM4: u32 = 2;
const TIM4_TX: [(usize, usize, u32, usize); 2] = [(0, 1, 9, 3), (1, 1, 6, 0)];
/// The enable register on APB1, and the bit of each controller.
const ENABLE: (u32, [u32; 2]) = (0x40, [25, 26]);

/// What they may do, and which of them do.
#[derive(Debug, Default)]
pub struct TransmitPins {
    faults: CanFaults,
    dice: Dice,
    is_hostile: bool,
    /// Held dominant since a reset of the controller.
    stuck: [bool; 2],
    /// Held dominant.
    held: [bool; 2],
}

/// What the pins of a controller do to its bus.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Driven {
    /// A pin that is not the controller's drives it dominant.
    pub dominant: bool,
    /// The controller's pin is a timer's.
    pub cut: bool,
}

/// What the pins do that are outputs, or `timer`'s, which is TIM4.
pub fn driven(ports: &[Gpio], timer: &Timer) -> [Driven; 2] {
    [0, 1].map(|controller| {
        let is_low = |(port, pin): &(usize, u32)| ports[*port].output(*pin) == Some(false);
        let is_output_low = TX[controller].iter().any(is_low);
        let of_timer = TIM4_TX
            .iter()
            .find(|(of, port, pin, _)| *of == controller && ports[*port].is_connected(*pin, TIM4));
        // An output that is not enabled is no level: the transceiver reads recessive.
        let is_timer_low = of_timer.is_some_and(|(.., channel)| timer.output_level(*channel) == Some(false));
        Driven {
            dominant: is_output_low || is_timer_low,
            cut: (is_output_low || of_timer.is_some()) && !is_connected(controller, ports),
        }
    })
}

fn is_connected(controller: usize, ports: &[Gpio]) -> bool {
    TX[controller].iter().any(|(port, pin)| ports[*port].is_connected(*pin, CAN))
}

impl TransmitPins {
    /// Makes them as `hostile` has them.
    pub fn set_hostile(&mut self, hostile: &Hostile, clock: Clock) {
        self.faults = hostile.can;
        self.dice = Dice::new(hostile.seed, 4, clock);
        self.is_hostile = true;
    }

    /// Ends that: see [`Dice::calm`].
    pub fn calm(&mut self) {
        self.faults = CanFaults::default();
        self.stuck = [false; 2];
        self.dice.calm();
    }

    /// The clock controller resets a controller.
    pub fn controller_reset(&mut self, controller: usize, ports: &[Gpio]) {
        self.stuck[controller] |=
            is_connected(controller, ports) && self.dice.hits(self.faults.reset_sticks_percent);
    }

    /// A controller's clock stops in the middle of a frame of its own: whatever bit is on the pin stays there. Here it is a dominant one.
    pub fn clock_stops(&mut self, controller: usize) {
        self.is_hostile = true;
        self.stuck[controller] = true;
    }

    /// Follows a change of the pins, the clocks or the controllers. Returns which controllers' buses are now held, or released.
    pub fn follow(&mut self, ports: &[Gpio], rcc: &Rcc) -> [Option<bool>; 2] {
        if !self.is_hostile {
            return [None; 2];
        }
        [0, 1].map(|controller| {
            let connected = is_connected(controller, ports);
            self.stuck[controller] &= connected;
            let clocked = rcc.enabled(ENABLE.0, ENABLE.1[controller]);
            let held = self.stuck[controller] || connected && !clocked && self.faults.unclocked_is_dominant;
            (held != std::mem::replace(&mut self.held[controller], held)).then_some(held)
        })
    }
}
