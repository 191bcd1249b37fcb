//! `cantap extcap`: boards as interfaces of Wireshark. Wireshark itself calls it, with the arguments of extcap(4), through a name in a
//! separate folder that `cantap extcap install` puts there.

mod bit_rates;
mod capture;
mod install;
mod pipe;
mod places;
mod sentences;
mod toolbar;
mod traffic;

use std::ffi::OsString;
use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use cantap::wire::message::Mode;
use cantap_address::Address;
use cantap_trace::filter::Filter;

use self::bit_rates::BitRate;
use self::capture::Wanted;
use self::toolbar::Toolbar;
use crate::completion;
use crate::usage_error::usage;

/// The command line.
#[derive(clap::Args)]
#[command(
    args_conflicts_with_subcommands = true,
    after_help = "`cantap extcap install` once, and Wireshark and tshark show each connected board as an interface, with \
                both channels: \n\
                `tshark -i cantap-virtual` tries it. Channels only listen, unless the interface's options or the \
                toolbar say otherwise. Capture filters are candump's, several apart by blanks: can0,123:7FF can1,#FF\n\n\
                Wireshark gives every other option; each can also be given by hand:\n  \
                cantap extcap --extcap-interfaces\n  \
                tshark -i cantap-address -o extcap.cantap_address.device:unix:"
)]
pub struct Args {
    #[command(subcommand)]
    command: Option<Action>,
    /// List the interfaces.
    #[arg(long, help_heading = WIRESHARK)]
    extcap_interfaces: bool,
    /// Wireshark's version.
    #[arg(long, value_name = "VERSION", num_args = 0..=1, default_missing_value = "", help_heading = WIRESHARK)]
    extcap_version: Option<String>,
    /// The interface concerned.
    #[arg(long, value_name = "INTERFACE", help_heading = WIRESHARK)]
    extcap_interface: Option<String>,
    /// List the link types of an interface.
    #[arg(long, requires = "extcap_interface", help_heading = WIRESHARK)]
    extcap_dlts: bool,
    /// List the options of an interface.
    #[arg(long, requires = "extcap_interface", help_heading = WIRESHARK)]
    extcap_config: bool,
    /// List the values of one option again.
    #[arg(long, value_name = "OPTION", help_heading = WIRESHARK)]
    extcap_reload_option: Option<String>,
    /// Capture, until stopped.
    #[arg(long, requires = "extcap_interface", requires = "fifo", help_heading = WIRESHARK)]
    capture: bool,
    /// The pipe to write to.
    #[arg(long, value_name = "PIPE", help_heading = WIRESHARK)]
    fifo: Option<PathBuf>,
    /// Only these frames, in candump's syntax. Without --capture this is only checked.
    #[arg(long, value_name = "FILTERS", value_parser = filters, help_heading = WIRESHARK)]
    extcap_capture_filter: Option<Filters>,
    /// The pipe with changes in the toolbar.
    #[arg(long, value_name = "PIPE", help_heading = WIRESHARK)]
    extcap_control_in: Option<PathBuf>,
    /// The pipe to the toolbar.
    #[arg(long, value_name = "PIPE", help_heading = WIRESHARK)]
    extcap_control_out: Option<PathBuf>,
    /// Clean up after a capture that was killed: there is nothing to do.
    #[arg(long, help_heading = WIRESHARK)]
    extcap_cleanup_postkill: bool,
    /// The address of the device of the interface cantap-address: a server, a serial port, virtual:OPTIONS.
    #[arg(short, long, help_heading = OPTIONS, add = completion::devices())]
    device: Option<Address>,
    /// Bit rate of channel 1 in bit/s; auto: as saved on the board, otherwise found by listening; off: not
    /// captured.
    #[arg(long, value_name = "RATE", default_value = "auto", help_heading = OPTIONS)]
    bitrate1: BitRate,
    /// The same for channel 2.
    #[arg(long, value_name = "RATE", default_value = "auto", help_heading = OPTIONS)]
    bitrate2: BitRate,
    /// How to take part in the buses.
    #[arg(long, value_enum, default_value = "listen-only", help_heading = OPTIONS)]
    mode: ModeArg,
}

const WIRESHARK: &str = "What Wireshark gives";
const OPTIONS: &str = "Options of an interface";

#[derive(clap::Subcommand)]
enum Action {
    /// Put it where Wireshark looks, or remove it.
    Install(install::Args),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum ModeArg {
    /// Send nothing, acknowledge nothing.
    #[value(name = "listen-only", alias = "listen")]
    ListenOnly,
    /// Acknowledge frames.
    Normal,
}

/// Several filters, any of which may match.
#[derive(Clone, Debug, PartialEq)]
struct Filters(Vec<Filter>);

fn filters(text: &str) -> Result<Filters, String> {
    let parse = |word: &str| word.parse().map_err(|error| format!("'{word}' is not a filter: {error}"));
    text.split_whitespace().map(parse).collect::<Result<_, _>>().map(Filters)
}

/// Converts the arguments for this command. Wireshark starts what is in its folder without a subcommand.
pub fn arguments(given: impl Iterator<Item = OsString>) -> Vec<OsString> {
    let mut arguments: Vec<_> = given.collect();
    let is_wireshark = arguments.get(1).and_then(|first| first.to_str()).is_some_and(|first| {
        first.starts_with("--extcap-") || first == "--capture" || first.starts_with("--fifo")
    });
    if is_wireshark {
        arguments.insert(1, "extcap".into());
    }
    arguments
}

/// Runs it.
pub fn run(args: Args) -> anyhow::Result<ExitCode> {
    if let Some(Action::Install(args)) = &args.command {
        return install::run(args);
    }
    // The version comes before the interfaces.
    if args.extcap_interfaces || args.extcap_interface.is_none() && args.extcap_version.is_some() {
        return say(&sentences::interfaces(&places::all()));
    }
    let Some(interface) = &args.extcap_interface else {
        return Err(usage(
            "Wireshark calls this; `cantap extcap install` has it do so, and `tshark -D` shows the interfaces then",
        ));
    };
    if args.extcap_dlts {
        return say(&sentences::link_types());
    }
    if args.extcap_cleanup_postkill {
        return Ok(ExitCode::SUCCESS);
    }
    let place = places::find(interface)?;
    if args.extcap_config || args.extcap_reload_option.is_some() {
        return say(&sentences::config(&place));
    }
    if !args.capture {
        if args.extcap_capture_filter.is_some() {
            return Ok(ExitCode::SUCCESS);
        }
        return Err(usage(
            "say what to do with the interface: --capture --fifo PIPE, --extcap-config or --extcap-dlts",
        ));
    }
    let toolbar = Toolbar::open(args.extcap_control_in.as_deref(), args.extcap_control_out.as_deref());
    let wanted = Wanted {
        address: place.address(args.device.as_ref()),
        bit_rates: [args.bitrate1, args.bitrate2],
        mode: match args.mode {
            ModeArg::ListenOnly => Mode::ListenOnly,
            ModeArg::Normal => Mode::Normal,
        },
        filters: args.extcap_capture_filter.map(|Filters(filters)| filters).unwrap_or_default(),
        pipe: args.fifo.unwrap_or_default(),
        toolbar: toolbar.context("the system refused a thread; close other programs and try again")?,
    };
    capture::run(&wanted)
}

fn say(text: &str) -> anyhow::Result<ExitCode> {
    std::io::stdout().lock().write_all(text.as_bytes())?;
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wireshark_needs_no_subcommand_and_nobody_else_gets_one() {
        let arguments = |line: &str| {
            let words = arguments(line.split(' ').map(OsString::from)).into_iter();
            words.map(|word| word.into_string().unwrap()).collect::<Vec<_>>().join(" ")
        };
        let calls = [
            "--extcap-interfaces --extcap-version=4.0",
            "--extcap-interface x --extcap-dlts",
            "--capture --extcap-interface x --fifo y",
        ];
        for call in calls {
            assert_eq!(arguments(&format!("cantap {call}")), format!("cantap extcap {call}"));
        }
        for call in
            ["cantap", "cantap capture -d virtual", "cantap --help", "cantap extcap --extcap-interfaces"]
        {
            assert_eq!(arguments(call), call);
        }
    }

    #[test]
    fn a_capture_filter_is_several_of_candumps() {
        assert_eq!(filters("").unwrap().0.len(), 0);
        assert_eq!(filters("can0,123:7FF  #FF").unwrap().0.len(), 2);
        assert!(filters("tcp port 80").unwrap_err().starts_with("'tcp' is not a filter"));
    }
}
