//! Adds advice to the libraries' errors, in terms of the `cantap` command: the libraries know nothing of options and
//! subcommands.

use std::error::Error;
use std::io;

use cantap::DeviceError;
use cantap::bit_timing::TimingError;
use cantap::wire::Refusal;
use cantap::wire::message::Role;
use cantap_formats::{Format, NothingRead, OpenError, UnknownFormat};
use cantap_signals::condition::{ConditionError, ConditionFault};

use cantap_address::server::Server;
use cantap_address::{Address, LinkError};

use crate::timing_options::TimingOptionsError;

/// For when nothing could be read.
const NAME_THE_FORMAT: &str = "; if it is a trace, name its format with --from";

/// An error and its causes as shown to the user, leaving out causes already contained in the error.
pub fn sentence(error: &anyhow::Error) -> String {
    // Files are named with their errors; an error without a name concerns standard output.
    let is_full = |error: &io::Error| error.kind() == io::ErrorKind::StorageFull;
    if error.chain().count() == 1 && error.downcast_ref().is_some_and(is_full) {
        return format!("not all of the output could be written: {error}; make room or choose another place");
    }
    error.chain().fold(String::new(), |text, cause| {
        let explained = explained(cause);
        match text.as_str() {
            "" => explained,
            before if before.contains(&cause.to_string()) => text,
            before => format!("{before}: {explained}"),
        }
    })
}

/// One error as shown to the user: what happened, and what to do.
pub fn explained(error: &(dyn Error + 'static)) -> String {
    if let Some(condition) = error.downcast_ref::<ConditionError>() {
        return of_condition(condition);
    }
    let advice = device_error(error)
        .and_then(of_device)
        .or_else(|| timing_error(error).and_then(of_timing))
        .or_else(|| error.downcast_ref().map(|_: &NothingRead| NAME_THE_FORMAT.to_owned()))
        .or_else(|| unknown_format(error).and_then(|unknown| of_format(unknown, option(error))));
    advice.map_or_else(|| error.to_string(), |advice| format!("{error}{advice}"))
}

/// The device's error, including one while connecting.
fn device_error<'e>(error: &'e (dyn Error + 'static)) -> Option<&'e DeviceError> {
    match error.downcast_ref() {
        Some(LinkError::Device(error)) => Some(error),
        _ => error.downcast_ref(),
    }
}

/// The timing's error, including one in what was requested.
fn timing_error<'e>(error: &'e (dyn Error + 'static)) -> Option<&'e TimingError> {
    match error.downcast_ref() {
        Some(TimingOptionsError::Timing(error)) => Some(error),
        _ => error.downcast_ref(),
    }
}

fn of_device(error: &DeviceError) -> Option<String> {
    let advice = match error {
        DeviceError::NotFound { .. } => "; `cantap list` shows what is connected",
        DeviceError::Open { .. } => "; check the address with `cantap list`",
        DeviceError::NotCantap { .. } => {
            "; check that it is one (`cantap list`), then unplug it and plug it in again"
        }
        DeviceError::Vanished { address, .. } if Server::is_meant(address) => {
            "; its server has ended, or does not let this client in"
        }
        DeviceError::Vanished { .. } => "; plug it in again",
        DeviceError::Silent { address, .. } if Server::is_meant(address) => {
            "; the line to its server may be too slow or interrupted, or the server hangs"
        }
        DeviceError::Silent { address, .. } if Address::is_no_port(address) => {
            "; it is part of this program, so this computer is too busy: close other programs, or give the device less to do"
        }
        DeviceError::Silent { .. } => "; if that stays so, unplug it and plug it in again",
        DeviceError::NoChannel { .. } => "; choose one it has with -c",
        DeviceError::AlwaysAcknowledges { .. } => " (--mode normal)",
        DeviceError::Refused { refusal } => match refusal {
            Refusal::Unsupported => "; `cantap info` shows what it can",
            Refusal::BadTiming => "; see `cantap timing`",
            Refusal::BadSlot => "; `cantap info` shows how many there are",
            Refusal::ListenOnly => "; open it in normal mode (--mode normal) to send",
            Refusal::NotGranted { needs: Role::Listen } => {
                "; the server's --permissions do not cover it, and its log says why"
            }
            Refusal::NotGranted { needs } => {
                return Some(format!(
                    "; start the server with --allow {needs}; if it was, its log says whether the certificate's role or --permissions do not cover it"
                ));
            }
            Refusal::OtherSettings => " (without -b, the server's bit rate is taken)",
            _ => return None,
        },
        _ => return None,
    };
    Some(advice.to_owned())
}

fn of_timing(error: &TimingError) -> Option<String> {
    let advice = match error {
        TimingError::JumpWidth { .. } => "; give a smaller --sjw",
        TimingError::Rate(_) => ", see `cantap timing -b RATE` for what reaches a rate",
        TimingError::Register(_) => ", and choose loopback or silent with --mode",
        TimingError::TripleSampling => ": omit --triple",
        _ => return None,
    };
    Some(advice.to_owned())
}

/// The error for a name that does not indicate a format, wherever that was found out.
fn unknown_format<'e>(error: &'e (dyn Error + 'static)) -> Option<&'e UnknownFormat> {
    if let Some(OpenError::Format(unknown)) = error.downcast_ref() {
        return Some(unknown);
    }
    let within = error.downcast_ref::<io::Error>().and_then(io::Error::get_ref);
    within.and_then(|within| within.downcast_ref()).or_else(|| error.downcast_ref())
}

/// Whether an output's name or `--format` names no format. Input is recognised by its content, so a name that says nothing is not a mistake there.
pub fn is_unknown_format(error: &anyhow::Error) -> bool {
    error.chain().all(|cause| !cause.is::<OpenError>())
        && error.chain().any(|cause| unknown_format(cause).is_some())
}

/// The option that names the format: for input, or for output.
fn option(error: &(dyn Error + 'static)) -> &'static str {
    if error.is::<OpenError>() { "--from" } else { "--format" }
}

fn of_format(error: &UnknownFormat, option: &str) -> Option<String> {
    let formats = if option == "--from" { Format::names() } else { Format::written_names() };
    matches!(error, UnknownFormat::Suffix(_)).then(|| format!("; name it with one of {option} {formats}"))
}

/// The advice comes after what is wrong, before the condition itself.
fn of_condition(error: &ConditionError) -> String {
    let text = error.to_string();
    match &error.fault {
        fault @ ConditionFault::NoDatabase(_) => {
            text.replacen(&fault.to_string(), &format!("{fault}; load one with --db"), 1)
        }
        _ => text,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn advice_stands_behind_what_happened_and_causes_are_named_once() {
        let source = io::Error::other("broken");
        let error = anyhow::Error::from(DeviceError::Open { address: "X".to_owned(), source: source.into() });
        assert_eq!(
            sentence(&error),
            "'X' cannot be opened as a serial port: broken; check the address with `cantap list`"
        );
        // Nobody is to be sent to a cable that is on another computer.
        let error = DeviceError::Silent { address: "ssh://car".to_owned(), seconds: 1.4 };
        assert!(explained(&error).contains("the line to its server"), "{}", explained(&error));
        // Nor to one that does not exist.
        for address in ["virtual", "virtual:load=100", "emu:board.elf"] {
            let error = DeviceError::Silent { address: address.to_owned(), seconds: 1.4 };
            assert!(explained(&error).contains("this computer is too busy"), "{}", explained(&error));
        }
        let error = DeviceError::Silent { address: "/dev/ttyACM0".to_owned(), seconds: 1.4 };
        assert!(explained(&error).contains("unplug it"), "{}", explained(&error));
        let error = DeviceError::Refused { refusal: Refusal::Unsupported };
        assert_eq!(
            explained(&error),
            "the device refused: it cannot do that; `cantap info` shows what it can"
        );
        let error = anyhow::Error::from(TimingError::TripleSampling).context("channel 1");
        assert!(sentence(&error).starts_with("channel 1: this controller"), "{}", sentence(&error));
        assert!(sentence(&error).ends_with("in it: omit --triple"), "{}", sentence(&error));
    }

    #[test]
    fn a_name_without_a_format_is_explained_for_reading_and_writing() {
        let expected = "the name 'a.xyz' does not show the format; name it with one of ";
        let unknown = || UnknownFormat::Suffix("a.xyz".to_owned());
        let (read, written) = (OpenError::from(unknown()), io::Error::other(unknown()));
        for (text, option) in [(explained(&read), "--from"), (explained(&written), "--format")] {
            assert!(text.starts_with(&format!("{expected}{option} candump, ")), "{text}");
        }
    }
}
