//! `cantap help`: the commands in groups, one command, or a topic that many commands have in common.

use std::fmt::Write as _;
use std::io::Write as _;
use std::process::ExitCode;

use crate::usage_error::usage;

/// The command line.
#[derive(clap::Args)]
pub struct Args {
    /// A command, or a topic: wiring, filters, conditions, times.
    #[arg(value_name = "COMMAND|TOPIC")]
    words: Vec<String>,
}

/// What several commands have in common.
const TOPICS: [(&str, &str, &str); 4] = [
    ("wiring", "where CAN_H and CAN_L are, termination", include_str!("help/wiring.txt")),
    ("filters", "identifiers and filters (-f, --id)", include_str!("help/filters.txt")),
    ("conditions", "what search and --trigger look for", include_str!("help/conditions.txt")),
    ("times", "times and rates (-t, -b, --start)", include_str!("help/times.txt")),
];

/// The commands by what they are for, the most used first.
const GROUPS: [(&str, &[&str]); 7] = [
    ("Look at a bus or a trace", &["monitor", "ui", "stats", "autobaud"]),
    ("Record, convert", &["capture", "convert", "align"]),
    (
        "Understand",
        &[
            "decode",
            "search",
            "conversations",
            "plot",
            "report",
            "page",
            "diff",
            "delay",
            "db",
            "bits",
            "timing",
        ],
    ),
    (
        "Send, ask",
        &[
            "send", "replay", "gen", "run", "twin", "obd", "uds", "xcp", "canopen", "j1939", "gateway",
            "disturb",
        ],
    ),
    (
        "Devices",
        &[
            "doctor",
            "list",
            "info",
            "interface",
            "status",
            "defaults",
            "selftest",
            "compare-adapters",
            "identify",
            "reset",
            "update",
            "virtual",
            "demo",
        ],
    ),
    ("Share with other programs", &["serve", "bridge", "extcap"]),
    ("More", &["help", "completions"]),
];

/// Columns for a command's name.
const NAME: usize = 17;
/// No line is longer, as in the help of a single command.
const MOST_COLUMNS: usize = 100;

/// The columns of the terminal.
fn columns() -> usize {
    let size = terminal_size::terminal_size();
    size.map_or(MOST_COLUMNS, |(width, _)| usize::from(width.0).clamp(20, MOST_COLUMNS))
}

/// Gives the whole command its list of commands, in groups.
pub fn grouped(line: clap::Command) -> clap::Command {
    let list = groups(&line, columns());
    // The template's own brackets are none of a command's description.
    let list = list.replace('{', "(").replace('}', ")");
    line.help_template(format!(
        "{{about}}\n\n{{usage-heading}} {{usage}}\n\n{list}\nOptions:\n{{options}}{{after-help}}"
    ))
}

fn groups(line: &clap::Command, columns: usize) -> String {
    let mut text = String::new();
    for (title, names) in GROUPS {
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{title}:");
        for command in names.iter().filter_map(|name| line.find_subcommand(name)) {
            let about = command.get_about().map(ToString::to_string).unwrap_or_default();
            push_row(&mut text, command.get_name(), about.trim_end_matches('.'), columns);
        }
        text.push('\n');
    }
    text.push_str("Topics, as in cantap help filters:\n");
    for (name, about, _) in TOPICS {
        push_row(&mut text, name, about, columns);
    }
    text
}

/// A name, and beside it what it is, on as many lines as that needs.
fn push_row(text: &mut String, name: &str, about: &str, columns: usize) {
    let wrapped = wrapped(about, columns.saturating_sub(NAME + 2));
    for (number, line) in wrapped.lines().enumerate() {
        let name = if number == 0 { name } else { "" };
        // Writing to a String cannot fail.
        let _ = writeln!(text, "  {name:<NAME$}{line}");
    }
}

/// The text in lines of at most this many columns; lines that begin with a blank stay as they are.
fn wrapped(text: &str, columns: usize) -> String {
    let mut out = String::new();
    for line in text.lines() {
        if line.starts_with(' ') {
            out.push_str(line);
        } else {
            let mut used = 0;
            for word in line.split_whitespace() {
                let length = word.chars().count();
                if used > 0 && used + 1 + length > columns {
                    out.push('\n');
                    used = 0;
                } else if used > 0 {
                    out.push(' ');
                    used += 1;
                }
                out.push_str(word);
                used += length;
            }
        }
        out.push('\n');
    }
    out
}

/// Runs it; `line` describes the whole command.
pub fn run(args: &Args, line: &clap::Command) -> anyhow::Result<ExitCode> {
    let mut out = std::io::stdout().lock();
    if let [word] = &args.words[..]
        && let Some((_, _, text)) =
            TOPICS.iter().find(|(name, ..)| name == word || name.strip_suffix('s') == Some(word))
    {
        out.write_all(wrapped(text, columns()).as_bytes())?;
        return Ok(ExitCode::SUCCESS);
    }
    let mut command = line;
    for word in &args.words {
        let below = command.get_name();
        command = match command.find_subcommand(word) {
            Some(command) => command,
            None => {
                return Err(usage(format!(
                    "'{word}' is no command of {below} and no topic; `cantap help` lists both"
                )));
            }
        };
    }
    // The same text as with --help, which clap composes only for a command line.
    let name = line.get_name().to_owned();
    let words = std::iter::once(name.as_str()).chain(args.words.iter().map(String::as_str)).chain(["--help"]);
    if let Err(help) = line.clone().try_get_matches_from(words) {
        write!(out, "{}", help.render())?;
    }
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;
    use crate::Cli;

    fn each(command: &clap::Command, see: &mut impl FnMut(&clap::Command)) {
        see(command);
        command.get_subcommands().for_each(|below| each(below, see));
    }

    #[test]
    fn every_command_is_in_one_group() {
        let line = Cli::command();
        let mut listed: Vec<_> = GROUPS.iter().flat_map(|(_, names)| names.iter().copied()).collect();
        listed.sort_unstable();
        let shown = line.get_subcommands().filter(|command| !command.is_hide_set());
        let mut names: Vec<_> = shown.map(clap::Command::get_name).collect();
        names.sort_unstable();
        // Those that exist on one system only are listed on all.
        listed.retain(|name| names.contains(name) || !["bridge", "interface", "virtual"].contains(name));
        assert_eq!(listed, names);
    }

    /// A command's help on a terminal of this width: of `--help`, or of `-h`.
    fn rendered(command: &clap::Command, is_long: bool, width: usize) -> String {
        let mut command = command.clone().term_width(width);
        if is_long { command.render_long_help() } else { command.render_help() }.to_string()
    }

    /// At every usual width: no line is too long, none is broken within a word, no example is broken, and no sentence is broken where the source happens
    /// to be.
    #[test]
    fn help_is_whole_at_80_to_120_columns() {
        let mut wrong = Vec::new();
        each(&Cli::command(), &mut |command| {
            let name = command.get_name().to_owned();
            let after = command.get_after_help().map(ToString::to_string).unwrap_or_default();
            let lines: Vec<&str> = after.lines().collect();
            for pair in lines.windows(2) {
                let is_text = |line: &str| !line.is_empty() && !line.starts_with(' ');
                if is_text(pair[0]) && is_text(pair[1]) && !pair[0].trim_end().ends_with(':') {
                    wrong.push(format!("{name}: a sentence is broken after {:?}", pair[0]));
                }
            }
            for line in lines.iter().filter(|line| line.starts_with(' ') && line.chars().count() > 80) {
                wrong.push(format!("{name}: too long for 80 columns: {line:?}"));
            }
            for is_long in [false, true] {
                let whole = rendered(command, is_long, 10_000);
                let words = |text: &str| text.split_whitespace().map(str::to_owned).collect::<Vec<_>>();
                for width in [80, 90, 100, 110, 120] {
                    let text = rendered(command, is_long, width);
                    // A usage is one word for a shell; it is not wrapped.
                    let long =
                        text.lines().find(|line| line.chars().count() > width && !line.starts_with("Usage:"));
                    if let Some(line) = long {
                        wrong.push(format!("{name} at {width}: {line:?}"));
                    }
                    if words(&text) != words(&whole) {
                        wrong.push(format!("{name} at {width}: a line is broken within a word"));
                    }
                }
            }
        });
        for (name, _, text) in TOPICS {
            for line in wrapped(text, 80).lines().filter(|line| line.chars().count() > 80) {
                wrong.push(format!("{name}: {line:?}"));
            }
        }
        for width in [80, 100] {
            for line in groups(&Cli::command(), width).lines().filter(|line| line.chars().count() > width) {
                wrong.push(format!("groups at {width}: {line:?}"));
            }
        }
        assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    }

    #[test]
    fn texts_are_wrapped_between_words() {
        assert_eq!(wrapped("one two three\n\n  as  it is", 8), "one two\nthree\n\n  as  it is\n");
    }
}
