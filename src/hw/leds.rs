//! The board's LEDs, driven by the patterns of [`cantap_firmware::lights`].

use cantap_firmware::lights::Lit;

use crate::board::Leds;

impl Leds {
    /// Shows it.
    pub fn show(&mut self, lit: Lit) {
        match self {
            Leds::One(led) => led.set(lit.single()),
            Leds::Three { power, traffic, error } => {
                power.set(lit.power);
                traffic.set(lit.traffic);
                error.set(lit.error);
            }
        }
    }
}
