//! The port: whether it is there, who may open it, and who has it open.

use cantap::DeviceError;
use cantap_address::{Address, LinkError};

use super::check::Check;
use crate::advice;

/// For when nothing better is known.
pub const UNPLUG: &str = "unplug it, plug it in again, and examine it again";

/// No address was given, and there is no board.
pub fn none_connected() -> Check {
    Check::problem("port", "no board is connected", absent_next(None))
}

/// What to do about a port that is not there; `port` is the one that was named.
fn absent_next(port: Option<&str>) -> String {
    let boards = cantap::device::list().unwrap_or_default();
    if let (Some(_), [board, ..]) = (port, &boards[..]) {
        return format!("a board is at {}: `cantap doctor -d {}`", board.port, board.port);
    }
    if bootloaders() > 0 {
        return "a chip is in its USB bootloader: write a firmware to it (`cantap update --help`), or plug it in again with BOOT0 low"
            .to_owned();
    }
    let shows =
        if cfg!(target_os = "linux") { "; `sudo dmesg | tail` shows what the computer noticed" } else { "" };
    format!(
        "plug the board in, with a cable that carries data and not only power{shows}; `-d virtual` needs no board"
    )
}

#[cfg(target_os = "linux")]
fn bootloaders() -> usize {
    crate::port_access::System::default().bootloaders()
}

#[cfg(not(target_os = "linux"))]
fn bootloaders() -> usize {
    0
}

/// Shows what the system knows about a port, and returns whether to open it.
#[cfg(target_os = "linux")]
pub fn examine(port: &str, show: &mut dyn FnMut(Check)) -> bool {
    use crate::port_access::{PortFile, System};
    use std::path::Path;

    let system = System::default();
    let file = match system.port(Path::new(port)) {
        Ok(file) => file,
        Err(error) => {
            let found = match error.kind() {
                std::io::ErrorKind::NotFound => format!("there is no '{port}'"),
                _ => format!("'{port}' cannot be looked at: {error}"),
            };
            show(Check::problem("port", found, absent_next(Some(port))));
            return false;
        }
    };
    if !file.is_device {
        show(Check::problem(
            "port",
            format!("'{port}' is a file or a folder, and no port"),
            "give a port, such as /dev/ttyACM0 (`cantap list`); to read a trace, give it to a command without -d",
        ));
        return false;
    }
    let PortFile { path, group, mode, .. } = &file;
    show(Check::ok("port", format!("{} is there, group {group}, access {mode:03o}", path.display())));
    let may_open = of_holders(&system.holders(path), show);
    let is_usb = path.file_name().is_some_and(|name| {
        let name = name.to_string_lossy();
        name.starts_with("ttyACM") || name.starts_with("ttyUSB")
    });
    if is_usb && system.has_modem_manager() {
        show(of_modem_manager(file.is_ignored_by_modem_manager));
    }
    may_open
}

/// Elsewhere, opening it says what there is to know.
#[cfg(not(target_os = "linux"))]
pub fn examine(_: &str, _: &mut dyn FnMut(Check)) -> bool {
    true
}

#[cfg(target_os = "linux")]
fn of_holders(holders: &crate::port_access::Holders, show: &mut dyn FnMut(Check)) -> bool {
    let Some(first) = holders.seen.first() else {
        let hidden = match holders.hidden {
            0 => String::new(),
            count => format!(" ({count} processes of other users could not be looked into)"),
        };
        show(Check::ok("in-use", format!("no other program has it open{hidden}")));
        return true;
    };
    let all: Vec<String> =
        holders.seen.iter().map(|holder| format!("{}, process {}", holder.name, holder.pid)).collect();
    let next = match first.name.as_str() {
        "ModemManager" => format!("wait ten seconds; so that it stays away, {}", with_rules()),
        "cantap" => {
            "end that command; to use one board in several programs, share it with `cantap serve`".to_owned()
        }
        _ => "close it there".to_owned(),
    };
    show(Check::problem("in-use", format!("it is open in {}", all.join("; ")), next));
    false
}

#[cfg(target_os = "linux")]
fn of_modem_manager(is_ignored: bool) -> Check {
    if is_ignored {
        return Check::ok("modem-manager", "ModemManager runs, and leaves this port alone");
    }
    Check::note(
        "modem-manager",
        "ModemManager runs, and talks to this port for some seconds whenever the board is plugged in",
        with_rules(),
    )
}

/// How to install the udev rule, with its exact text.
#[cfg(target_os = "linux")]
fn with_rules() -> String {
    use crate::port_access::{UDEV_RULES, UDEV_RULES_FILE};
    format!(
        "write these two lines to {UDEV_RULES_FILE}, run `sudo udevadm control --reload`, and plug the board in again:\n{}",
        UDEV_RULES.trim_end()
    )
}

/// The board cannot be opened, or what is there is none.
pub fn of_error(address: &Address, error: &LinkError) -> Check {
    let LinkError::Device(device) = error else {
        return Check::problem("device", advice::explained(error), "correct that, and examine it again");
    };
    match device {
        DeviceError::Forbidden { address } => forbidden(address),
        DeviceError::NotFound { address } => {
            Check::problem("port", format!("there is no '{address}'"), absent_next(Some(address)))
        }
        DeviceError::Busy { .. } => Check::problem(
            "in-use",
            "another program has it open",
            if cfg!(unix) {
                format!("close it there; if it is not yours, `sudo fuser -v {address}` shows it")
            } else {
                "close it there: terminal programs, other CAN tools, the Arduino IDE".to_owned()
            },
        ),
        DeviceError::NotCantap { .. } => Check::problem(
            "device",
            "the port can be opened, but what is behind it does not answer as a cantap device",
            format!(
                "if it is another maker's adapter, name its protocol, as in -d slcan:{address} (docs/adapters.md); if it is a board \
                 that hangs, plug it in again; if it has no firmware yet, write it one (docs/bring-up.md)"
            ),
        ),
        DeviceError::Protocol { .. } => Check::problem(
            "firmware",
            device.to_string(),
            format!(
                "`cantap update -d {address} FILE.bin` writes a firmware; `cantap --version` shows this program's version"
            ),
        ),
        _ => Check::problem("device", advice::explained(device), UNPLUG),
    }
}

#[cfg(target_os = "linux")]
fn forbidden(address: &str) -> Check {
    let file = crate::port_access::System::default().port(std::path::Path::new(address)).ok();
    let group = file.as_ref().map_or("dialout", |file| file.group.as_str());
    of_group(address, group, file.as_ref().is_some_and(|file| file.is_in_group))
}

#[cfg(target_os = "linux")]
fn of_group(address: &str, group: &str, is_in_group: bool) -> Check {
    let found = format!("no permission to open {address}, which belongs to the group {group}");
    if is_in_group {
        return Check::problem(
            "rights",
            format!("{found}, as does this program"),
            format!("the port itself is closed to its group: {}", with_rules()),
        );
    }
    let join = match group {
        "root" => String::new(),
        group => format!("run `sudo usermod -aG {group} $USER`, log out and log in again; or "),
    };
    Check::problem("rights", found, format!("{join}{}", with_rules()))
}

#[cfg(not(target_os = "linux"))]
fn forbidden(address: &str) -> Check {
    Check::problem(
        "rights",
        format!("no permission to open {address}"),
        "ask the system's administrator for it",
    )
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::super::check::Verdict;
    use super::*;
    use crate::port_access::{Holder, Holders};

    fn shown(holders: &Holders) -> (bool, Vec<Check>) {
        let mut checks = Vec::new();
        let may_open = of_holders(holders, &mut |check| checks.push(check));
        (may_open, checks)
    }

    #[test]
    fn a_port_that_others_hold_is_not_opened_and_they_are_named() {
        let named = |pid, name: &str| Holder { pid, name: name.to_owned() };
        let (may_open, checks) = shown(&Holders { seen: vec![named(7, "minicom")], hidden: 0 });
        assert!(!may_open && checks[0].outcome == Verdict::Problem, "{checks:?}");
        assert_eq!(checks[0].found, "it is open in minicom, process 7");
        let (_, checks) = shown(&Holders { seen: vec![named(7, "ModemManager")], hidden: 0 });
        assert!(checks[0].next.as_ref().unwrap().contains(r#"ENV{ID_MM_DEVICE_IGNORE}="1""#), "{checks:?}");
        let (may_open, checks) = shown(&Holders { seen: vec![], hidden: 4 });
        assert!(may_open && checks[0].found.contains("4 processes of other users"), "{checks:?}");
    }

    #[test]
    fn who_has_no_right_learns_the_group_and_the_rule() {
        let check = of_group("/dev/ttyACM0", "dialout", false);
        let next = check.next.unwrap();
        assert!(next.starts_with("run `sudo usermod -aG dialout $USER`"), "{next}");
        assert!(
            next.contains("/etc/udev/rules.d/60-cantap.rules") && next.contains("TAG+=\"uaccess\""),
            "{next}"
        );
        // Nobody is to join root's group.
        let next = of_group("/dev/ttyACM0", "root", false).next.unwrap();
        assert!(next.starts_with("write these two lines"), "{next}");
        assert_eq!(of_modem_manager(true).outcome, Verdict::Ok);
        assert_eq!(of_modem_manager(false).outcome, Verdict::Note);
    }
}
