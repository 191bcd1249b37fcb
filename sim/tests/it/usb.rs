//! The firmware on USB: enumeration, and the conversation with its host.

use crate::common;

use cantap_emu::machine::Setup;
use cantap_emu::timing::Bound;
use cantap_emu::usb_host::Timing;
use cantap_sim::board::{self, CLOCK};
use cantap_sim::rig::Rig;

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn the_device_enumerates_as_a_serial_port_and_says_hello() {
    for bound in Bound::ALL {
        let image = common::firmware();
        let mut rig = Rig::new(image, Setup { bound, ..board::setup() }, Timing::new(CLOCK));
        let hello = rig.connect().unwrap();
        println!("{bound}: {hello:?} at {} us", rig.now() / 144);
        let identity = rig.with_host(|host, _| host.identity().cloned()).unwrap();
        println!("{identity:?}");
        assert_eq!(rig.machine.board().odd_accesses(), []);
    }
}
