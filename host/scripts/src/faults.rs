//! What goes wrong on simulated buses, because a test wants it: settings of the bus, and functions of scripts, by the same names.

use std::str::FromStr;
use std::sync::{Arc, Mutex, PoisonError};

use cantap_can::Channel;
use cantap_trace::grammar;
use cantap_virtual::Options;

use crate::names::short;

/// Something that goes wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// Every frame that begins on this channel within so many nanoseconds is destroyed, whoever sends it.
    ErrorBurst {
        /// The bus.
        channel: Channel,
        /// For how long, in nanoseconds.
        for_ns: u64,
    },
    /// From its next frame on, a node's frames on this channel are destroyed until it is bus-off.
    BusOff {
        /// The bus.
        channel: Channel,
    },
    /// A node is without power: it takes part in no bus, and nothing of it runs. When it has power again, its script begins anew.
    PowerOff {
        /// For how long, in nanoseconds; none for until [`Self::PowerOn`].
        for_ns: Option<u64>,
    },
    /// A node has power again.
    PowerOn,
    /// A node's host, or the one of all nodes and of the trace, does nothing for so many nanoseconds. Its device goes on repeating, and keeps
    /// 4096 frames for it; more are lost, which counts as `queue`.
    Stall {
        /// For how long, in nanoseconds.
        for_ns: u64,
    },
    /// A node's host, or the one of all nodes and of the trace, does not take frames, which counts as `host`.
    Lose(Losing),
}

/// Which frames a host loses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Losing {
    /// The next so many of others.
    Frames(u64),
    /// Those of others within so many nanoseconds.
    For(u64),
}

/// Something that goes wrong at a time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlannedFault {
    /// When, in nanoseconds since the run began.
    pub at_ns: u64,
    /// The node's name, if it is one's.
    pub node: Option<String>,
    /// What.
    pub fault: Fault,
}

/// Simulated buses as users describe them: the options of a virtual device, and what goes wrong.
///
/// As text: `load=20,power_off=engine@2s+500ms`. Besides the keys of [`Options`]: `error_burst=2@1s+10ms` (channel, time and length; without
/// a channel the first), `bus_off=engine@1s`, `power_off=engine@1s+500ms` (without a length for ever), `stall=1s+200ms`, `lose=dash@1s+50ms` and
/// `lose=dash@1s*3` (with the name of a node, or for all). Faults alone are those of a bus without other traffic.
#[derive(Clone, Debug, PartialEq)]
pub struct BenchBus {
    /// What else is on the buses.
    pub options: Options,
    /// What goes wrong, in the order in which it was written.
    pub faults: Vec<PlannedFault>,
}

impl FromStr for BenchBus {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        // A file's name may contain commas: it extends to the end.
        let log_at = if text.starts_with("log=") { Some(0) } else { text.find(",log=") };
        let (options, log) = text.split_at(log_at.unwrap_or(text.len()));
        let mut faults = Vec::new();
        let mut others = Vec::new();
        for option in options.split(',').filter(|option| !option.is_empty()) {
            match option.split_once('=').map(|(key, value)| (planned(key, value), option)) {
                Some((Some(fault), _)) => faults.push(fault?),
                _ => others.push(option),
            }
        }
        if others.is_empty() && log.is_empty() && !faults.is_empty() {
            others.push("load=0");
        }
        let options = format!("{}{log}", others.join(","));
        let options = options.parse().map_err(|error: cantap_virtual::BadOption| match error {
            cantap_virtual::BadOption::Unknown(_) => {
                format!("{error}; and what goes wrong: error_burst, bus_off, power_off, stall, lose")
            }
            error => error.to_string(),
        })?;
        Ok(Self { options, faults })
    }
}

/// A fault by its key and `[NODE@]TIME[+LENGTH]`; none if it is no fault's key.
fn planned(key: &str, value: &str) -> Option<Result<PlannedFault, String>> {
    let example = match key {
        "error_burst" => "error_burst=1s+10ms, or 2@1s+10ms on channel 2",
        "bus_off" => "bus_off=engine@1s, or engine:2@1s on channel 2",
        "power_off" => "power_off=engine@1s+500ms, or engine@1s for ever",
        "stall" => "stall=1s+200ms, or dash@1s+200ms for one node",
        "lose" => "lose=1s+50ms or 1s*3 for three frames, or dash@1s*3 for one node",
        _ => return None,
    };
    let wrong = |reason: &str| format!("'{value}' does not fit '{key}'{reason}: write it as {example}");
    Some(read(key, value).map_err(|reason| wrong(&reason)))
}

/// The reason of an error is empty, or begins with a blank.
fn read(key: &str, value: &str) -> Result<PlannedFault, String> {
    let ns = |text: &str| match grammar::duration(text) {
        Ok(time) => u64::try_from(time.as_nanos()).map_err(|_| String::new()),
        Err(error) => Err(format!(" ({error})")),
    };
    let (target, when) = value.rsplit_once('@').map_or((None, value), |(target, when)| (Some(target), when));
    let (at, length) = when.split_once('+').map_or((when, None), |(at, length)| (at, Some(length)));
    let (at, frames) = at.split_once('*').map_or((at, None), |(at, frames)| (at, Some(frames)));
    let frames = frames.map(|frames| frames.parse::<u64>().map_err(|_| String::new())).transpose()?;
    let (at_ns, for_ns) = (ns(at)?, length.map(ns).transpose()?);
    let channel_of = |text: &str| {
        text.parse::<u8>()
            .ok()
            .and_then(Channel::from_number)
            .ok_or_else(|| " (there are channels 1 and 2)".to_owned())
    };
    let mut node = target.filter(|target| !target.is_empty());
    let fault = match (key, for_ns, frames) {
        ("error_burst", Some(for_ns), None) => {
            let channel = node.take().map_or(Ok(Channel::Can1), channel_of)?;
            Fault::ErrorBurst { channel, for_ns }
        }
        ("bus_off", None, None) => {
            let numbered = node.and_then(|node| Some((node, node.rsplit_once(':')?)));
            let numbered =
                numbered.filter(|(_, (_, number))| number.len() == 1 && number.parse::<u8>().is_ok());
            let channel = match numbered {
                Some((_, (name, number))) => {
                    node = Some(name);
                    channel_of(number)?
                }
                None => Channel::Can1,
            };
            Fault::BusOff { channel }
        }
        ("power_off", for_ns, None) => Fault::PowerOff { for_ns },
        ("stall", Some(for_ns), None) => Fault::Stall { for_ns },
        ("lose", Some(for_ns), None) => Fault::Lose(Losing::For(for_ns)),
        ("lose", None, Some(frames)) => Fault::Lose(Losing::Frames(frames)),
        _ => return Err(String::new()),
    };
    if node.is_none() && matches!(fault, Fault::BusOff { .. } | Fault::PowerOff { .. }) {
        return Err(" (it is one node's)".to_owned());
    }
    Ok(PlannedFault { at_ns, node: node.map(str::to_owned), fault })
}

/// The nodes of a bench, for those who name them.
#[derive(Clone, Debug, Default)]
pub struct BenchNodes(Arc<Mutex<Vec<Known>>>);

#[derive(Clone, Debug)]
struct Known {
    name: String,
    has_tests: bool,
}

impl BenchNodes {
    /// One more.
    pub fn add(&self, name: String, has_tests: bool) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(Known { name, has_tests });
    }

    /// The place of the one with this name: as on the command line, or without folder and suffix, or without `node:`.
    pub fn find(&self, name: &str, fault: Fault) -> Result<usize, String> {
        let all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let places_of = |is_it: &dyn Fn(&Known) -> bool| -> Vec<usize> {
            all.iter().enumerate().filter(|(_, known)| is_it(known)).map(|(place, _)| place).collect()
        };
        let mut found = places_of(&|known| known.name == name);
        if found.is_empty() {
            found = places_of(&|known| short(&known.name) == name);
        }
        match found[..] {
            [] => {
                let names: Vec<&str> = all.iter().map(|known| short(&known.name)).collect();
                Err(format!("there is no node {name}; there are {}", names.join(", ")))
            }
            [place] if all[place].has_tests && matches!(fault, Fault::PowerOff { .. }) => Err(format!(
                "{name} has tests, and whoever tests needs its power; give the node a script of its own"
            )),
            [place] => Ok(place),
            _ => Err(format!("there are several nodes {name}; write the name as it is on the command line")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faults_are_read_among_the_buses_options_and_wrong_ones_say_how_they_are_written() {
        let bus: BenchBus =
            "errors=1,error_burst=2@1s+10ms,bus_off=node:engine:2@2s,power_off=engine@1s+500ms,load=3,stall=1s+1ms,lose=a@0s*3"
                .parse()
                .unwrap();
        assert_eq!((bus.options.load_percent, bus.options.error_percent), (3.0, 1.0));
        let (second, million) = (1_000_000_000, 1_000_000);
        let fault =
            |at_ns, node: Option<&str>, fault| PlannedFault { at_ns, node: node.map(str::to_owned), fault };
        assert_eq!(
            bus.faults,
            [
                fault(second, None, Fault::ErrorBurst { channel: Channel::Can2, for_ns: 10 * million }),
                fault(2 * second, Some("node:engine"), Fault::BusOff { channel: Channel::Can2 }),
                fault(second, Some("engine"), Fault::PowerOff { for_ns: Some(500 * million) }),
                fault(second, None, Fault::Stall { for_ns: million }),
                fault(0, Some("a"), Fault::Lose(Losing::Frames(3))),
            ]
        );
        let alone: BenchBus = "power_off=node:engine@1s".parse().unwrap();
        assert!(alone.options.load_percent == 0.0, "{alone:?}");
        assert_eq!(alone.faults[0].node.as_deref(), Some("node:engine"));
        for (text, reason) in [
            ("stall=1s", "'1s' does not fit 'stall': write it as stall=1s+200ms"),
            ("power_off=1s", "'1s' does not fit 'power_off' (it is one node's)"),
            ("error_burst=3@1s+1ms", "'3@1s+1ms' does not fit 'error_burst' (there are channels 1 and 2)"),
            ("lose=1s", "'1s' does not fit 'lose': write"),
            ("lose=1s*x", "'1s*x' does not fit 'lose': write"),
            ("stall=soon+1ms", "'soon+1ms' does not fit 'stall' ("),
            ("stal=1s+1ms", "there is no option 'stal'"),
        ] {
            let error = text.parse::<BenchBus>().unwrap_err();
            assert!(error.starts_with(reason), "{error}");
        }
    }

    #[test]
    fn nodes_are_found_by_whole_and_short_names() {
        let nodes = BenchNodes::default();
        for name in ["a/dash.rhai", "node:engine", "b/dash.rhai"] {
            nodes.add(name.to_owned(), name.starts_with('b'));
        }
        let off = Fault::PowerOff { for_ns: None };
        let find = |name: &str| nodes.find(name, off);
        assert_eq!((find("engine"), find("node:engine"), find("a/dash.rhai")), (Ok(1), Ok(1), Ok(0)));
        assert!(find("dash").unwrap_err().contains("several nodes dash"));
        assert_eq!(find("boat").unwrap_err(), "there is no node boat; there are dash, engine, dash");
        assert!(find("b/dash.rhai").unwrap_err().contains("has tests"));
        assert_eq!(nodes.find("b/dash.rhai", Fault::PowerOn), Ok(2));
    }
}
