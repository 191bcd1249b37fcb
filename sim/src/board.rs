//! What the emulator must know about our boards and the firmware: clock, crystal, and the interrupts that capture.

use std::sync::{Arc, Mutex};

use cantap_emu::can::ZeroSplit;
use cantap_emu::usb::UsbPort;
use cantap_emu::usb_host::Timing;
use cantap_emu::{Clock, Image, Machine, Setup, memory_map as map};
use cantap_wire::RECEIVE_PINS_SYMBOL;

/// The firmware's SYSCLK, which is the core's clock.
pub const CLOCK: Clock = Clock::new(144_000_000);
/// The Olimex STM32-P405's crystal, in Hz.
const CRYSTAL_HZ: u64 = 8_000_000;
/// The interrupts in which the firmware captures CAN1 and CAN2: the one that stamps, and the task that drains (`src/main.rs`).
pub const CAPTURE_IRQS: [[u16; 2]; 2] = [[20, 21], [64, 11]];

/// The Olimex STM32-P405, with the masking of the interrupts that stamp measured.
pub fn setup() -> Setup {
    Setup { watched: 1 << CAPTURE_IRQS[0][0] | 1 << CAPTURE_IRQS[1][0], ..Setup::new(CLOCK, CRYSTAL_HZ) }
}

/// The same with the buses at the pins that the firmware uses.
pub fn setup_for(image: &Image) -> Setup {
    let pins = image.datum(RECEIVE_PINS_SYMBOL).and_then(|address| image.bytes_at(address));
    let mut setup = setup();
    if let Some([port_1, pin_1, port_2, pin_2, ..]) = pins {
        setup.receive_pins =
            [(usize::from(*port_1), u32::from(*pin_1)), (usize::from(*port_2), u32::from(*pin_2))];
    }
    setup
}

/// How long a program may take to set up its clocks, in ms: a crystal and the PLL start in less than 3.
const CLOCKS_WITHIN_MS: u64 = 50;

/// For any program for the chip, which may depend on what real chips do and no manual says. `None` if the core's clock as it sets it up is not a
/// multiple of 12 MHz, or it ends before.
pub fn setup_for_any(image: &Image) -> Option<Setup> {
    Some(Setup { clock: clock_of(image)?, zero_split: ZeroSplit::AllBanks, ..setup_for(image) })
}

/// The core's clock as a program sets it up, which has to be known before a machine's time has a unit: found out by running it.
fn clock_of(image: &Image) -> Option<Clock> {
    let mut machine = Machine::new(image.clone(), setup());
    machine.attach(map::OTG_FS, map::OTG_FS_IRQ, Arc::new(Mutex::new(UsbPort::new(Timing::new(CLOCK)))));
    machine.run_until(CLOCK.ms(CLOCKS_WITHIN_MS)).ok()?;
    let hz = machine.board().clocks().hclk_hz;
    Clock::checked(hz)
}
