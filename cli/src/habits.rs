//! What users of other programs type, and what it is called here.

use std::ffi::OsString;
use std::path::Path;

use cantap_work::boards::BoardsError;
use clap::error::{ContextKind, ContextValue, ErrorKind};

/// The names of other programs and of their parts, and what does the same here.
const NAMES: [(&[&str], &str); 13] = [
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
            // Not one below another command.
            arguments.get(1).filter(|name| *name == text)?;
            let known = NAMES.iter().find(|(names, _)| names.contains(&text));
            known.map(|(_, advice)| (*advice).to_owned()).or_else(|| of_file(Path::new(text)))
        }
        ErrorKind::UnknownArgument => of_argument(text(ContextKind::InvalidArg)?, command?, arguments),
        _ => None,
    }
}

/// What else there is for who has named no device: on Linux most adapters are CAN interfaces.
pub fn also(error: &anyhow::Error) -> String {
    let none = error.downcast_ref().is_some_and(|error| matches!(error, BoardsError::NoneConnected));
    if none { of_interfaces(&cantap_adapters::can_interfaces()) } else { String::new() }
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
    let has_long = |name| command.get_arguments().any(|arg| arg.get_long() == Some(name));
    // Some commands take a device without -d.
    let takes_device = command.get_arguments().any(|arg| arg.get_short() == Some('d'));
    if takes_device && cantap_address::Address::is_meant_by(Path::new(text)) {
        return Some(format!("a device is given with -d, as in: -d {text}"));
    }
    if text.starts_with('-') {
        return None;
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
        assert_eq!(also(&anyhow::anyhow!("something else")), "");
    }
}
