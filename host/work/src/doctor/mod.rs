//! Examines a device from its port to its buses, and says what is the matter and what to do next. It only listens: nothing is sent and
//! nothing acknowledged.

mod bus;
mod check;
mod port;

use cantap::wire::message::{Failures, Hello, capability};
use cantap_address::OpenDevice;
use cantap_trace::counted;

pub use self::check::{BusFigures, Check, Examination, Verdict};
use crate::advice;
use crate::boards::{BoardsError, the_one_connected};

/// Below this, the chip's supply of 3.3 V is too low, in millivolts: the firmware's brown-out reset is at 2.7 V, and transceivers need
/// 3.0 V.
const LEAST_SUPPLY_MV: u16 = 3_000;

/// Examines, and shows each check as soon as it is done. An error says that it cannot be examined at all, such as several boards of which
/// none was named.
pub fn examine(examination: &Examination, show: &mut dyn FnMut(Check)) -> Result<(), BoardsError> {
    let address = match &examination.address {
        Some(address) => address.clone(),
        None => match the_one_connected() {
            Ok(address) => address,
            Err(BoardsError::NoneConnected) => {
                show(port::none_connected());
                return Ok(());
            }
            Err(error) => return Err(error),
        },
    };
    if let Some(port) = address.serial_port()
        && !port::examine(port, show)
    {
        show(Check::new("device", Verdict::Skipped, "its port cannot be opened"));
        return Ok(());
    }
    let device = match address.open() {
        Ok(device) => device,
        Err(error) => {
            show(port::of_error(&address, &error));
            return Ok(());
        }
    };
    if address.serial_port().is_some() {
        show(Check::ok("rights", "the port can be opened"));
    }
    examine_device(&device, show);
    for check in bus::examine(&device, examination) {
        show(check);
    }
    Ok(())
}

fn examine_device(device: &OpenDevice, show: &mut dyn FnMut(Check)) {
    let hello = device.hello();
    let [major, minor, patch] = hello.firmware;
    let about = format!(
        "{} with firmware {major}.{minor}.{patch}, protocol version {}, serial number {}",
        hello.board, hello.protocol, hello.serial
    );
    show(match device.failures() {
        Err(error) => Check::problem("device", advice::explained(&error), port::UNPLUG),
        Ok(failures) => of_failures(&about, hello, &failures),
    });
    if is_older(hello, env!("CARGO_PKG_VERSION")) {
        show(Check::note(
            "firmware",
            format!("{major}.{minor}.{patch} is older than this program, {}", env!("CARGO_PKG_VERSION")),
            format!("`cantap update -d {} FILE.bin` brings the one that belongs to it", device.name()),
        ));
    }
    let supply = device.status().ok().and_then(|status| status.supply_millivolts);
    if let Some(millivolts) = supply.filter(|millivolts| *millivolts < LEAST_SUPPLY_MV) {
        show(Check::problem(
            "supply",
            format!("the chip has only {:.2} V", f64::from(millivolts) / 1e3),
            "use another USB port or cable, without a hub, and look for what else draws from 3.3 V",
        ));
    }
}

fn of_failures(about: &str, hello: &Hello, failures: &Failures) -> Check {
    match failures.count {
        0 => Check::ok("device", about),
        // Of another maker's adapter, this is what it left out.
        _ if hello.capabilities & capability::ADAPTER != 0 => {
            Check::ok("device", format!("{about}; {}", failures.last))
        }
        count => Check::note(
            "device",
            format!(
                "{about}; its firmware has failed {count} since power-on, the last time: {}",
                failures.last,
                count = counted(count, "time")
            ),
            "report it with the output of `cantap status --registers`",
        ),
    }
}

/// Whether a board's firmware has an older major or minor version than this program; another maker's adapter has its own versions.
fn is_older(hello: &Hello, program: &str) -> bool {
    let mut parts = program.split('.').map(|part| part.parse().unwrap_or(0_u16));
    let mut next = || parts.next().unwrap_or(0);
    let program = [next(), next()];
    hello.capabilities & capability::ADAPTER == 0 && [hello.firmware[0], hello.firmware[1]] < program
}

#[cfg(test)]
mod tests {
    use cantap_address::Address;

    use super::*;

    #[test]
    fn an_older_firmware_is_noticed_and_an_adapter_s_is_not_compared() {
        let device = Address::of_virtual_device().open().unwrap();
        let mut hello = device.hello().clone();
        hello.firmware = [0, 9, 9];
        assert!(is_older(&hello, "0.10.0") && is_older(&hello, "1.0.0"));
        assert!(!is_older(&hello, "0.9.10") && !is_older(&hello, "0.8.0"));
        hello.capabilities |= capability::ADAPTER;
        assert!(!is_older(&hello, "1.0.0"));
    }

    #[test]
    fn failures_of_the_firmware_are_worth_a_note() {
        let device = Address::of_virtual_device().open().unwrap();
        let failures = |count| Failures { count, last: "panicked".try_into().unwrap() };
        assert_eq!(of_failures("a board", device.hello(), &failures(0)), Check::ok("device", "a board"));
        let failed = of_failures("a board", device.hello(), &failures(2));
        assert!(
            failed.outcome == Verdict::Note && failed.found.ends_with("the last time: panicked"),
            "{failed:?}"
        );
        let adapter = Hello { capabilities: capability::ADAPTER, ..device.hello().clone() };
        assert_eq!(of_failures("can0", &adapter, &failures(2)).outcome, Verdict::Ok);
    }
}
