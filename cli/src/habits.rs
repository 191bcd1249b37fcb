//! What users of other programs type, and what it is called here.

use std::ffi::OsString;
use std::path::Path;

use cantap_trace::grammar;
use cantap_work::boards::BoardsError;
use clap::error::{ContextKind, ContextValue, ErrorKind};

/// The names of other programs and of their parts, and what does the same here.
const NAMES: [(&[&str], &str); 18] = [
    (
        &["candump", "dump", "record", "log", "logger", "can_logger"],
        "cantap capture prints or records what a device receives",
    ),
    (&["cansend"], "cantap send sends frames"),
    (&["cangen", "generate"], "cantap gen sends made-up frames"),
    (&["canplayer", "play", "player", "can_player"], "cantap replay plays a trace on a bus"),
    (
        &[
            "cansniffer",
            "sniff",
            "sniffer",
            "view",
            "viewer",
            "can_viewer",
            "watch",
            "live",
            "show",
            "open",
            "trace",
        ],
        "cantap monitor shows a device or a trace",
    ),
    (&["canbusload", "load", "statistics", "summary"], "cantap stats measures a trace or a bus"),
    (
        &["log2asc", "asc2log", "log2long", "can_logconvert", "export", "import"],
        "cantap convert IN OUT writes a trace in another format",
    ),
    (&["isotpdump", "isotpsniffer", "isotprecv"], "cantap conversations shows transfers and what is in them"),
    (&["dbc", "database", "databases"], "cantap db shows what is in a database"),
    (&["devices", "ports", "ls", "interfaces"], "cantap list lists devices"),
    (&["grep", "find", "filter"], "cantap search finds frames"),
    (&["graph", "chart", "scatter"], "cantap plot draws signals"),
    (&["version"], "cantap --version"),
    (&["compare", "cmp"], "cantap diff shows what differs between two traces"),
    (
        &["cut", "split", "trim", "crop", "slice"],
        "cantap convert IN OUT --start 10s --end 20s writes a part of a trace",
    ),
    (&["merge", "join", "concat"], "cantap align puts traces of several recorders on one clock and together"),
    (&["ids", "messages", "frames"], "cantap stats TRACE --per-id lists the identifiers"),
    (
        &["isotpsend", "isotp"],
        "cantap uds and cantap obd ask by ISO-TP, and cantap conversations shows transfers",
    ),
];

/// The same below a command.
const NAMES_BELOW: [(&str, &[&str], &str); 4] = [
    ("obd", &["dtc", "dtcs", "faults", "errors", "trouble"], "cantap obd codes reads trouble codes"),
    (
        "obd",
        &["pids", "pid", "list"],
        "cantap obd supported lists what the vehicle has, and cantap obd live 0C shows a value",
    ),
    ("uds", &["rdbi", "did", "22"], "cantap uds read F190 reads data by identifier"),
    ("uds", &["request", "send", "hex"], "cantap uds raw 22F190 sends any request"),
];

/// What other programs' options are here: in these commands, or in all of them that have this option of ours.
const OPTIONS: [(&str, &[&str], &str); 12] = [
    (
        "capture",
        &["-l", "-L"],
        "what is printed is a log as candump -L writes it, and -o FILE.log records one",
    ),
    ("capture", &["-x"], "what was sent has a T behind it without that"),
    ("capture", &["-e"], "bus errors are captured without that"),
    ("capture", &["-a", "-i", "-S"], "cantap monitor shows bytes in other ways"),
    (
        "convert",
        &["-I", "-O", "-o", "--input", "--output"],
        "both names follow without an option: cantap convert IN OUT",
    ),
    ("convert", &["--force", "-y", "--overwrite"], "an existing file is replaced without that"),
    (
        "search",
        &["-Y", "-R", "--display-filter"],
        "a condition needs no option, as in: cantap search TRACE 'id == 0x123'; cantap help conditions",
    ),
    (
        "device",
        &["-i", "--interface", "--bustype"],
        "-d names the adapter, as in: -d can0, -d slcan:/dev/ttyACM0, -d pcan:PCAN_USBBUS1",
    ),
    (
        "bitrate",
        &["--baud", "--baudrate", "--speed", "-s", "-B"],
        "a bit rate is given with -b, as in: -b 500k",
    ),
    ("time", &["--duration", "--seconds", "--for"], "-t says for how long, as in: -t 10s"),
    ("signal", &["-S"], "signals are named with --signal, as in: --signal Speed --signal Gear"),
    ("db", &["--database", "--kcd", "--arxml", "--sym"], "a database of any kind is given with --db"),
];

/// What a wrong command line may have meant.
pub fn advice(
    error: &clap::Error,
    command: Option<&clap::Command>,
    arguments: &[OsString],
) -> Option<String> {
    let text = |kind| match error.get(kind) {
        Some(ContextValue::String(text)) => Some(text.as_str()),
        _ => None,
    };
    match error.kind() {
        ErrorKind::InvalidSubcommand => {
            let text = text(ContextKind::InvalidSubcommand)?;
            if arguments.get(1).is_some_and(|name| name != text) {
                return below(command?, text);
            }
            let known = NAMES.iter().find(|(names, _)| names.contains(&text));
            known.map(|(_, advice)| (*advice).to_owned()).or_else(|| of_file(Path::new(text)))
        }
        ErrorKind::UnknownArgument => of_argument(text(ContextKind::InvalidArg)?, command?, arguments),
        // As candump chooses how times are shown.
        ErrorKind::ValueValidation => {
            let is_time = text(ContextKind::InvalidArg)?.starts_with("--time");
            let is_candumps = matches!(text(ContextKind::InvalidValue)?, "a" | "A" | "d" | "z");
            (is_time && is_candumps)
                .then(|| "-t says for how long, as in: -t 10s; a trace has the time of each frame".to_owned())
        }
        _ => None,
    }
}

/// What else there is for who has named no device, since on Linux most adapters are CAN interfaces, or has named one in the place of a trace.
pub fn also(error: &anyhow::Error, arguments: &[OsString]) -> String {
    let none = error.downcast_ref().is_some_and(|error| matches!(error, BoardsError::NoneConnected));
    if none {
        return interface_as_channel(arguments)
            .unwrap_or_else(|| of_interfaces(&cantap_adapters::can_interfaces()));
    }
    let shown = error.to_string();
    let is_device = |text: &&str| {
        shown.starts_with(&format!("cannot open {text}:"))
            && cantap_address::Address::is_meant_by(Path::new(text))
    };
    let device = arguments.iter().skip(2).filter_map(|argument| argument.to_str()).find(is_device);
    device.map_or_else(String::new, |device| format!("; a device is given with -d, as in: -d {device}"))
}

/// As cansend and cangen have it: the interface first.
fn interface_as_channel(arguments: &[OsString]) -> Option<String> {
    let name = arguments.get(1)?.to_str().filter(|name| matches!(*name, "send" | "gen"))?;
    let is_interface = |text: &&str| grammar::channel(text).is_some() && text.parse::<u8>().is_err();
    let interface = arguments.iter().skip(2).filter_map(|argument| argument.to_str()).find(is_interface)?;
    Some(format!("; for a CAN interface of this computer: cantap {name} -d {interface} 1 …"))
}

/// A word below a command.
fn below(command: &clap::Command, text: &str) -> Option<String> {
    let known = NAMES_BELOW.iter().find(|(of, names, _)| *of == command.get_name() && names.contains(&text));
    let takes_device = command.get_arguments().any(|arg| arg.get_short() == Some('d'));
    known.map(|(.., advice)| (*advice).to_owned()).or_else(|| {
        let is_device = takes_device && cantap_address::Address::is_meant_by(Path::new(text));
        is_device.then(|| format!("a device is given with -d, as in: -d {text}"))
    })
}

fn of_interfaces(names: &[String]) -> String {
    let given: Vec<_> = names.iter().map(|name| format!("-d {name}")).collect();
    if given.is_empty() {
        String::new()
    } else {
        format!("; CAN interfaces of this computer: {}", given.join(", "))
    }
}

/// A file in place of a command.
fn of_file(path: &Path) -> Option<String> {
    let shown = path.display();
    if is_database(path) {
        return Some(format!("cantap db {shown} shows what is in a database"));
    }
    path.exists()
        .then(|| format!("cantap monitor {shown} shows a trace, and cantap stats {shown} measures it"))
}

/// One thing too many behind a command.
fn of_argument(text: &str, command: &clap::Command, arguments: &[OsString]) -> Option<String> {
    let has_long = |name: &str| command.get_arguments().any(|arg| arg.get_long() == Some(name));
    // Some commands take a device without -d.
    let takes_device = command.get_arguments().any(|arg| arg.get_short() == Some('d'));
    if takes_device && cantap_address::Address::is_meant_by(Path::new(text)) {
        return Some(format!("a device is given with -d, as in: -d {text}"));
    }
    if text.starts_with('-') {
        let name = text.split('=').next().unwrap_or(text);
        let is_of = |of: &str| of == command.get_name() || has_long(of);
        let known = OPTIONS.iter().find(|(of, names, _)| is_of(of) && names.contains(&name));
        return known.map(|(.., advice)| (*advice).to_owned());
    }
    let before = arguments.iter().zip(arguments.iter().skip(1));
    let database = before
        .filter(|(before, _)| *before != "--db")
        .map(|(_, argument)| Path::new(argument))
        .find(|path| is_database(path));
    if let Some(database) = database.filter(|_| has_long("db")) {
        return Some(format!("a database is given with --db, as in: --db {}", database.display()));
    }
    let name = command.get_name();
    if has_long("signal") && !Path::new(text).exists() {
        return Some(format!("a signal is named with --signal, as in: --signal {text}"));
    }
    Path::new(text).is_file().then(|| {
        format!("it takes one trace at a time, as in: for trace in *.log; do cantap {name} \"$trace\"; done")
    })
}

fn is_database(path: &Path) -> bool {
    cantap_signals::is_database_name(path) && path.is_file()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_names_no_device_is_told_of_the_computers_can_interfaces() {
        let names = ["can0".to_owned(), "vcan1".to_owned()];
        assert_eq!(of_interfaces(&names), "; CAN interfaces of this computer: -d can0, -d vcan1");
        assert_eq!(of_interfaces(&[]), "");
        assert_eq!(also(&anyhow::anyhow!("something else"), &[]), "");
    }
}
