//! The chip itself: its identity, temperature and voltage, what it stores, and how it restarts.

use core::fmt::Write;

use cantap_firmware::lights::{Activity, Lights};
use cantap_firmware::oddities::Oddities;
use cantap_firmware::ports::Chip;
use cantap_firmware::saved;
use cantap_wire::message::Failures;
use heapless::String;

use super::flash::LastSector;
use super::sensors::Sensors;
use super::{failure, restart};
use crate::board::Leds;

/// The 96-bit unique ID (RM0090, "Unique device ID register").
const UNIQUE_ID: *const [u32; 3] = 0x1FFF_7A10 as *const [u32; 3];

/// The unique ID in hexadecimal.
pub fn serial_number() -> String<24> {
    // SAFETY: readable at any time, aligned, and never changing.
    let words = unsafe { UNIQUE_ID.read() };
    let mut serial = String::new();
    for word in words {
        // Cannot fail: three times eight digits fit.
        let _ = write!(serial, "{word:08X}");
    }
    serial
}

/// The chip, with the LEDs.
pub struct BoardChip {
    sensors: Sensors,
    sector: LastSector,
    leds: Leds,
    lights: Lights,
}

impl BoardChip {
    /// Assembles it from its parts.
    pub const fn new(sensors: Sensors, sector: LastSector, leds: Leds) -> Self {
        Self { sensors, sector, leds, lights: Lights::new() }
    }

    /// Shows what happened on the LEDs. Call once a millisecond.
    pub fn tick(&mut self, activity: Activity) {
        let lit = self.lights.tick(activity);
        self.leds.show(lit);
    }

    /// Records among the failures what the hardware did.
    #[expect(
        clippy::unused_self,
        reason = "the chip's owner is the only one who records while the firmware runs"
    )]
    pub fn record(&mut self, oddities: &Oddities) {
        failure::record(format_args!("{oddities}"));
    }
}

impl Chip for BoardChip {
    fn temperature_decicelsius(&mut self) -> Option<i16> {
        self.sensors.temperature_decicelsius()
    }

    fn supply_millivolts(&mut self) -> Option<u16> {
        self.sensors.supply_millivolts()
    }

    fn failures(&mut self) -> Failures {
        failure::failures()
    }

    fn identify(&mut self, seconds: u8) {
        self.lights.identify(seconds);
    }

    fn reset(&mut self) {
        restart::restart()
    }

    fn bootloader(&mut self) -> bool {
        restart::restart_into_bootloader()
    }

    fn save(&mut self, bytes: &[u8]) -> bool {
        saved::save(&mut self.sector, bytes)
    }

    fn load(&mut self, out: &mut [u8]) -> usize {
        saved::load(&self.sector, out)
    }
}
