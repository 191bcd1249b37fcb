//! What a shell offers as values: devices, channels, and the content of the databases on the command line.
//!
//! A shell runs `cantap` with the words typed so far; [`crate::shells`] defines how. Nothing here opens a device, and what cannot be
//! read is not offered.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use cantap::wire::CHANNELS;
use cantap_address::Address;
use cantap_formats::Format;
use cantap_signals::Database;
use clap_complete::engine::{ArgValueCompleter, CompletionCandidate, PathCompleter, ValueCompleter};

use crate::shells;

/// Device addresses: connected boards, and devices that need none.
pub fn devices() -> ArgValueCompleter {
    ArgValueCompleter::new(offer_devices)
}

/// Channels of the devices on the line: 1, 2, and so on, or all.
pub fn channels() -> ArgValueCompleter {
    ArgValueCompleter::new(offer_channels)
}

/// One channel of a device.
pub fn channel() -> ArgValueCompleter {
    ArgValueCompleter::new(offer_channel)
}

/// Common bit rates.
pub fn bit_rates() -> ArgValueCompleter {
    ArgValueCompleter::new(offer_bit_rates)
}

/// Formats to read.
pub fn formats() -> ArgValueCompleter {
    ArgValueCompleter::new(offer_formats)
}

/// Formats to write.
pub fn written_formats() -> ArgValueCompleter {
    ArgValueCompleter::new(offer_written_formats)
}

/// Database files, with or without a channel.
pub fn databases() -> ArgValueCompleter {
    ArgValueCompleter::new(offer_databases)
}

/// Messages of the databases.
pub fn messages() -> ArgValueCompleter {
    ArgValueCompleter::new(offer_messages)
}

/// Identifiers of the databases' messages.
pub fn identifiers() -> ArgValueCompleter {
    ArgValueCompleter::new(offer_identifiers)
}

/// Signals of the databases, by name or `Message.Signal`.
pub fn signals() -> ArgValueCompleter {
    ArgValueCompleter::new(offer_signals)
}

/// The last word of a condition, if it may be a signal.
pub fn conditions() -> ArgValueCompleter {
    ArgValueCompleter::new(offer_conditions)
}

/// A message to send: its name, its signals, and the texts of their values.
pub fn values() -> ArgValueCompleter {
    ArgValueCompleter::new(offer_values)
}

/// Those of the values, each with its description, that continue `current`.
fn beginning<V, H>(current: &OsStr, values: impl IntoIterator<Item = (V, H)>) -> Vec<CompletionCandidate>
where
    V: AsRef<str>,
    H: Into<String>,
{
    let Some(current) = current.to_str() else { return Vec::new() };
    values
        .into_iter()
        .filter(|(value, _)| value.as_ref().starts_with(current))
        .map(|(value, help)| {
            let help: String = help.into();
            CompletionCandidate::new(value.as_ref()).help((!help.is_empty()).then(|| help.into()))
        })
        .collect()
}

fn offer_devices(current: &OsStr) -> Vec<CompletionCandidate> {
    let text = current.to_string_lossy();
    if let Some(file) = text.strip_prefix("emu:") {
        let files = PathCompleter::file().complete(OsStr::new(file));
        return files.into_iter().map(|file| file.add_prefix("emu:")).collect();
    }
    let boards = cantap::device::list().unwrap_or_default();
    let boards = boards.into_iter().map(|board| (board.port, board.product.unwrap_or_default()));
    let others = [
        ("virtual", "a simulated device, which needs no board"),
        ("virtual:car", "the same, with a vehicle on its buses"),
        ("gs_usb:", "a gs_usb adapter, such as candleLight or CANable"),
        ("pcan:", "an adapter of PEAK's, through PCAN-Basic"),
        ("kvaser:", "an adapter of Kvaser's, through CANlib"),
    ];
    let interfaces = cantap_adapters::can_interfaces();
    let interfaces = interfaces.into_iter().map(|name| (name, "a CAN interface of this computer".to_owned()));
    let others = others.into_iter().map(|(address, what)| (address.to_owned(), what.to_owned()));
    beginning(current, boards.chain(interfaces).chain(others))
}

fn offer_channels(current: &OsStr) -> Vec<CompletionCandidate> {
    let all = ("both".to_owned(), "all there are".to_owned());
    beginning(current, numbers().chain([all]))
}

fn offer_channel(current: &OsStr) -> Vec<CompletionCandidate> {
    beginning(current, numbers().take(CHANNELS))
}

fn numbers() -> impl Iterator<Item = (String, String)> {
    let devices = shells::line().iter().filter(|word| matches!(word.as_str(), "-d" | "--device")).count();
    (1..=CHANNELS * devices.max(1)).map(|number| (number.to_string(), format!("can{} in traces", number - 1)))
}

fn offer_bit_rates(current: &OsStr) -> Vec<CompletionCandidate> {
    let rates =
        ["auto", "1M", "800k", "500k", "250k", "125k", "100k", "83.333k", "50k", "33.333k", "20k", "10k"];
    beginning(current, rates.map(|rate| (rate, "")))
}

fn offer_formats(current: &OsStr) -> Vec<CompletionCandidate> {
    beginning(current, Format::names().split(", ").map(|name| (name, "")))
}

fn offer_written_formats(current: &OsStr) -> Vec<CompletionCandidate> {
    let names = format!("{}, {}", Format::written_names(), Format::Parquet);
    beginning(current, names.split(", ").map(|name| (name, "")))
}

fn offer_databases(current: &OsStr) -> Vec<CompletionCandidate> {
    let text = current.to_string_lossy();
    let channel = text.find(':').filter(|at| text[..*at].bytes().all(|byte| byte.is_ascii_digit()));
    let (channel, path) = text.split_at(channel.map_or(0, |at| at + 1));
    let files = PathCompleter::any().filter(|path| path.is_dir() || is_database(path));
    files.complete(OsStr::new(path)).into_iter().map(|file| file.add_prefix(channel)).collect()
}

fn is_database(path: &Path) -> bool {
    let suffix = path.extension().and_then(OsStr::to_str).unwrap_or_default();
    cantap_signals::SUFFIXES.iter().any(|known| suffix.eq_ignore_ascii_case(known))
}

/// The databases named on the command line, otherwise the virtual vehicle's if it is used.
fn loaded() -> Vec<Database> {
    let words = shells::line();
    let path = |word: &String| {
        let word = word.strip_prefix("--db=").unwrap_or(word);
        let behind_channel = word
            .split_once(':')
            .filter(|(number, _)| number.bytes().all(|byte| byte.is_ascii_digit()))
            .map_or(word, |(_, path)| path);
        Some(PathBuf::from(behind_channel)).filter(|path| is_database(path))
    };
    let named: Vec<_> = words.iter().filter_map(path).collect();
    if named.is_empty() && words.iter().any(|word| word.parse().is_ok_and(|device: Address| device.is_car()))
    {
        return cantap_virtual::car::database().into_iter().collect();
    }
    named.iter().filter_map(|path| cantap_signals::load(path).ok()).collect()
}

fn offer_messages(current: &OsStr) -> Vec<CompletionCandidate> {
    let databases = loaded();
    let messages = databases.iter().flat_map(|database| &database.messages);
    beginning(current, messages.map(|message| (message.name.as_str(), message.id.to_string())))
}

fn offer_identifiers(current: &OsStr) -> Vec<CompletionCandidate> {
    let databases = loaded();
    let messages = databases.iter().flat_map(|database| &database.messages);
    beginning(current, messages.map(|message| (message.id.to_string(), message.name.as_str())))
}

fn offer_signals(current: &OsStr) -> Vec<CompletionCandidate> {
    let qualified = current.to_string_lossy().contains('.');
    let mut names = Vec::new();
    for message in loaded().iter().flat_map(|database| &database.messages) {
        for signal in &message.signals {
            let whole = format!("{}.{}", message.name, signal.label());
            if qualified {
                names.push((whole, signal.unit.clone()));
            } else {
                names.push((signal.label().into_owned(), whole));
            }
        }
    }
    beginning(current, names)
}

fn offer_conditions(current: &OsStr) -> Vec<CompletionCandidate> {
    let text = current.to_string_lossy();
    let is_name = |symbol: char| symbol.is_alphanumeric() || matches!(symbol, '_' | '.');
    let word = text.trim_end_matches(is_name).len();
    if text.is_empty() {
        return Vec::new();
    }
    let (before, word) = text.split_at(word);
    offer_signals(OsStr::new(word)).into_iter().map(|signal| signal.add_prefix(before)).collect()
}

fn offer_values(current: &OsStr) -> Vec<CompletionCandidate> {
    let text = current.to_string_lossy();
    let databases = loaded();
    let mut all = databases.iter().flat_map(|database| &database.messages);
    let Some((name, signals)) = text.split_once(':') else {
        return beginning(current, all.map(|message| (format!("{}:", message.name), message.id.to_string())));
    };
    let Some(message) = all.find(|message| message.name == name) else { return Vec::new() };
    let (before, last) = signals.rsplit_once(',').map_or(("", signals), |(before, last)| (before, last));
    let head = format!("{name}:{before}{}", if before.is_empty() { "" } else { "," });
    match last.split_once('=') {
        None => {
            let taken = |label: &str| before.split(',').any(|part| part.split('=').next() == Some(label));
            let signals =
                message.signals.iter().filter(|signal| signal.contained.is_none() && !taken(&signal.label()));
            let signals = signals.map(|signal| (format!("{head}{}=", signal.label()), signal.unit.clone()));
            beginning(current, signals)
        }
        Some((label, _)) => {
            let signal = message.signals.iter().find(|signal| signal.label() == label);
            let texts = signal.into_iter().flat_map(|signal| signal.values.iter());
            beginning(
                current,
                texts.map(|(value, text)| (format!("{head}{label}={text}"), value.to_string())),
            )
        }
    }
}
