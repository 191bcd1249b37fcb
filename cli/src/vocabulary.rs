//! Every option has the same meaning in every command, which is checked by walking the command line that clap has. The output of
//! commands is checked in `tests/vocabulary.rs`.

use std::collections::{BTreeMap, BTreeSet};

use clap::{Arg, ArgAction, Command, CommandFactory};

use crate::Cli;

/// The option that a letter is short for.
const LETTERS: [(char, &[&str]); 20] = [
    ('A', &["after-context"]),
    ('B', &["before-context"]),
    ('C', &["context"]),
    ('b', &["bitrate"]),
    ('c', &["channel"]),
    ('d', &["device"]),
    ('e', &["condition"]),
    ('f', &["filter"]),
    ('h', &["help"]),
    ('i', &["id"]),
    ('m', &["max-count"]),
    // How many frames.
    ('n', &["frames", "count"]),
    ('o', &["output"]),
    ('p', &["profile"]),
    ('q', &["quiet"]),
    ('s', &["signal"]),
    // How long.
    ('t', &["time"]),
    ('v', &["verbose"]),
    ('w', &["window"]),
    ('y', &["yes"]),
];

/// Letters of can-utils, which users of `cangen` and `canplayer` type without looking.
const OF_CAN_UTILS: [(&str, &str); 2] = [("gen", "DEILRcefgimpx8"), ("replay", "Igilstx")];

/// Options whose values do not follow from their name alone, with the reason.
const MANY_KINDS: [(&str, &str); 9] = [
    ("pair", "what asks an ECU has one pair; what reads a trace also knows makers' pairs"),
    ("count", "as in grep, search counts instead of printing; send's is a number"),
    ("id", "gen makes identifiers, search looks for them"),
    ("loop", "replay's number of rounds, as canplayer's; selftest's wiring"),
    ("data", "gen makes data, search looks for them"),
    ("length", "gen's alone"),
    ("check", "diff says whether, align how much"),
    ("from", "delay's is the channel that a gateway receives on; elsewhere the format of a trace"),
    ("to", "delay's is the channel that a gateway sends on; j1939's the address of a node"),
];

/// Calls `see` with each command that does something, with its full name, and each of its options.
fn each(command: &Command, name: &str, see: &mut impl FnMut(&str, &Arg)) {
    for argument in command.get_arguments() {
        see(name, argument);
    }
    for below in command.get_subcommands() {
        each(below, format!("{name} {}", below.get_name()).trim_start(), see);
    }
}

#[test]
fn a_letter_means_one_thing_in_every_command() {
    let mut wrong = Vec::new();
    each(&Cli::command(), "", &mut |command, argument| {
        let Some(letter) = argument.get_short() else { return };
        let meant = LETTERS.iter().find(|(known, _)| *known == letter).map_or(&[][..], |(_, names)| names);
        let long = argument.get_long().unwrap_or_default();
        let own = OF_CAN_UTILS.iter().any(|(own, letters)| *own == command && letters.contains(letter));
        if !own && !meant.contains(&long) {
            wrong.push(format!("{command}: -{letter}, --{long}"));
        }
    });
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn a_name_takes_one_kind_of_value_in_every_command() {
    let mut kinds: BTreeMap<String, BTreeMap<String, Vec<String>>> = BTreeMap::new();
    each(&Cli::command(), "", &mut |command, argument| {
        let Some(long) = argument.get_long().filter(|long| MANY_KINDS.iter().all(|(name, _)| name != long))
        else {
            return;
        };
        // A value for all channels, or for one.
        let values = argument.get_value_names().unwrap_or_default().join(" ").replace("[CHANNEL:]", "");
        let takes = matches!(argument.get_action(), ArgAction::Set | ArgAction::Append);
        let kind = if takes { values } else { "nothing".to_owned() };
        kinds.entry(long.to_owned()).or_default().entry(kind).or_default().push(command.to_owned());
    });
    kinds.retain(|_, kinds| kinds.len() > 1);
    assert!(kinds.is_empty(), "{kinds:#?}");
}

/// `10` is ten seconds everywhere except in `gen` and `replay`, whose gaps are milliseconds as in can-utils, and whose
/// help says so.
#[test]
fn every_time_is_written_as_the_others() {
    let mut seen = 0;
    each(&Cli::command(), "", &mut |command, argument| {
        let is_time = argument.get_value_names().unwrap_or_default().iter().any(|name| name == "TIME");
        // Points in time have a syntax of their own.
        let is_point = matches!(argument.get_long(), Some("start" | "end"));
        if !is_time || is_point {
            return;
        }
        seen += 1;
        let parse = |text: &str| {
            // Only its parser: what else it requires is not part of a time.
            let line = Arg::new("time").long("time").value_parser(argument.get_value_parser().clone());
            let parser = Command::new("x").arg(line);
            parser.try_get_matches_from(["x", "--time", text]).map(|_| ())
        };
        for good in ["2", "2s", "1s1000ms", "0:02"] {
            assert!(parse(good).is_ok(), "{command} {argument}: {good}: {}", parse(good).unwrap_err());
        }
        for bad in ["fast", "-1", "2 parsecs", "inf", "1s1m"] {
            assert!(parse(bad).is_err(), "{command} {argument}: {bad}");
        }
    });
    assert!(seen > 15, "{seen}");
}

/// What may and may not be written where an option has this value, in every command: `docs/grammar.md`.
const GRAMMAR: [(&str, &[&str], &[&str]); 5] = [
    (
        "FILTER",
        &[
            "C0",
            "F0",
            "CAFE0",
            "FEF1",
            "123",
            "0x123",
            "09F80102",
            "18FEF1??",
            "100-1FF",
            "pgn:61444",
            "123:7FF",
            "can0",
            "vcan0,123",
            "can1,400~7F0,#FF,j",
        ],
        &["12g", "ca0", "800", "200-100", "pgn:x", "100-1FE,j", "can0,", "x"],
    ),
    ("ID", &["C0", "CAFE0", "123", "0x123", "09F80102", "1"], &["12g", "ca0", "800", "", "123456789"]),
    ("RATE", &["500000", "500k", "83.333k", "0.5M", "500kbit/s"], &["500", "fast", "1e6", "-1", ""]),
    ("[CHANNEL:]RATE", &["500k", "2:250k", "can1:1M", "0.5M"], &["500", "0:500k", "x:1M", "2:", "2:fast"]),
    ("CHANNEL", &["1", "can0", "vcan0", "slcan1"], &["0", "x", "can", "", "-1"]),
];

/// A fault in a value is found by the command line, so it has the same exit code everywhere.
#[test]
fn every_identifier_filter_rate_and_channel_is_written_as_the_others() {
    let mut seen = BTreeMap::new();
    let mut wrong = Vec::new();
    each(&Cli::command(), "", &mut |command, argument| {
        let Some(name) = argument.get_value_names().and_then(<[_]>::first) else { return };
        // What makes identifiers, and two endpoints of a conversation, are other things; so is an option of Wireshark's.
        let is_other = matches!(command, "gen" | "extcap")
            || matches!(argument.get_long(), Some("load" | "format"))
            // A routine has an identifier of its own.
            || (command, argument.get_id().as_str()) == ("uds routine", "routine");
        let Some((kind, good, bad)) = GRAMMAR.iter().find(|(kind, ..)| name == kind).filter(|_| !is_other)
        else {
            return;
        };
        *seen.entry(*kind).or_insert(0) += 1;
        let id = argument.get_id();
        let parse = |text: &str| {
            let line = Arg::new("value").long("value").value_parser(argument.get_value_parser().clone());
            let parser = Command::new("x").arg(line.allow_hyphen_values(true));
            parser.try_get_matches_from(["x", "--value", text]).map(|_| ())
        };
        for text in *good {
            if let Err(error) = parse(text) {
                wrong.push(format!("{command} {id}: {text}: {error}"));
            }
        }
        for text in *bad {
            match parse(text) {
                Ok(()) => wrong.push(format!("{command} {id}: {text} is taken")),
                Err(error) if error.exit_code() != 2 => {
                    wrong.push(format!("{command} {id}: {text}: another code"));
                }
                Err(_) => {}
            }
        }
    });
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    assert!(seen["FILTER"] > 8 && seen["[CHANNEL:]RATE"] > 8 && seen.len() == GRAMMAR.len(), "{seen:?}");
}

/// Filters and identifiers take the names of messages in every command, and each of them takes databases.
#[test]
fn whatever_takes_filters_takes_names_of_messages_and_databases() {
    let mut named = BTreeSet::new();
    let mut with_databases = BTreeSet::new();
    let mut wrong = Vec::new();
    each(&Cli::command(), "", &mut |command, argument| {
        if argument.get_long() == Some("db") {
            with_databases.insert(command.to_owned());
        }
        let is_filter =
            argument.get_value_names().and_then(<[_]>::first).is_some_and(|name| name == "FILTER");
        // A board keeps its defaults without their databases, and Wireshark has none.
        let is_filter = is_filter && !matches!(command, "defaults save" | "extcap");
        if !is_filter && (command, argument.get_long()) != ("search", Some("id")) {
            return;
        }
        named.insert(command.to_owned());
        for text in ["EngineData", "msg:EngineData", "msg:ACC", "Body2"] {
            let line = Arg::new("value").long("value").value_parser(argument.get_value_parser().clone());
            if Command::new("x").arg(line).try_get_matches_from(["x", "--value", text]).is_err() {
                wrong.push(format!("{command} {}: {text}", argument.get_id()));
            }
        }
    });
    // `db` takes them as files.
    named.remove("db");
    assert!(wrong.is_empty() && named.len() >= 10, "{named:?} {wrong:?}");
    assert!(named.is_subset(&with_databases), "{named:?} {with_databases:?}");
    let page = include_str!("../../docs/grammar.md");
    assert!(page.contains("`EngineData`") && page.contains("`msg:EngineData`"));
}

/// The page has every example of the table.
#[test]
fn the_page_on_the_grammar_has_what_is_tested() {
    let page = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/grammar.md");
    let page = std::fs::read_to_string(page).unwrap();
    for text in GRAMMAR.iter().flat_map(|(_, good, _)| *good) {
        assert!(page.contains(&format!("`{text}`")), "{text}");
    }
}

/// `docs/interoperability.md` names what is shown, and by which test: that test must exist.
#[test]
fn the_page_on_other_programs_names_tests_that_exist() {
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let page = std::fs::read_to_string(root.join("docs/interoperability.md")).unwrap();
    let rows: Vec<&str> = page.lines().filter(|line| line.starts_with("| ")).collect();
    let mut named = 0;
    for row in rows {
        let last = row.trim_end_matches(['|', ' ']).rsplit('|').next().unwrap_or_default();
        let is_path = |word: &&str| word.contains('/') && !word.contains(' ') && !word.contains(':');
        for path in last.split('`').skip(1).step_by(2).filter(is_path) {
            assert!(root.join(path).is_file(), "{path}");
            named += 1;
        }
    }
    assert!(named > 15, "{named}");
}

/// Output that is available as JSON in one measuring command is available in all.
#[test]
fn what_measures_or_tells_has_json() {
    let mut without = Vec::new();
    let line = Cli::command();
    for command in line.get_subcommands() {
        let has =
            |command: &Command| command.get_arguments().any(|argument| argument.get_long() == Some("json"));
        if !has(command) && !command.get_subcommands().any(has) {
            without.push(command.get_name().to_owned());
        }
    }
    without.sort();
    // Exists on only one system.
    without.retain(|name| name != "bridge");
    // They write scripts or files, act, serve, or show a screen.
    let expected = [
        "completions",
        "extcap",
        "help",
        "identify",
        "man",
        "monitor",
        "page",
        "report",
        "reset",
        "serve",
        "ui",
        "update",
        "virtual",
    ]
    .map(str::to_owned);
    assert_eq!(without, expected);
}
