//! Several requests in one session: the lines of a file, each as it would be on the command line.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{Parser, Subcommand};

use crate::usage_error::usage;

/// A line of a file.
#[derive(clap::Parser)]
#[command(no_binary_name = true, disable_help_subcommand = true)]
struct Line<W: Subcommand> {
    #[command(subcommand)]
    what: W,
}

/// What to do, and where that is written.
pub struct Step<W> {
    /// `file:line`; `None` on the command line.
    pub place: Option<String>,
    /// What to do.
    pub what: W,
}

/// The steps of a file, none of which may run another file; `-` is standard input. Empty lines and those that begin with `#` do nothing.
///
/// # Errors
///
/// The file cannot be read; any line that is no request, before anything is sent.
pub fn read<W: Subcommand>(path: &Path, runs_a_file: fn(&W) -> bool) -> anyhow::Result<Vec<Step<W>>> {
    let (name, text) = if path.as_os_str() == "-" {
        ("standard input".to_owned(), std::io::read_to_string(std::io::stdin()))
    } else {
        (path.display().to_string(), std::fs::read_to_string(path))
    };
    let text = text.with_context(|| format!("cannot read {name}"))?;
    let steps = steps(&name, &text, runs_a_file)?;
    if steps.is_empty() {
        return Err(usage(format!("{name} has no requests; a line is one, as 'read F190'")));
    }
    Ok(steps)
}

fn steps<W: Subcommand>(name: &str, text: &str, runs_a_file: fn(&W) -> bool) -> anyhow::Result<Vec<Step<W>>> {
    let lines = (1..).zip(text.lines().map(str::trim));
    let lines = lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
    lines
        .map(|(number, line)| {
            let place = format!("{name}:{number}");
            match Line::try_parse_from(line.split_whitespace()) {
                Ok(Line { what }) if runs_a_file(&what) => {
                    Err(usage(format!("{place}: a file cannot run another one, or scan")))
                }
                Ok(Line { what }) => Ok(Step { place: Some(place), what }),
                Err(error) => {
                    let text = error.to_string();
                    let reason = text.lines().next().unwrap_or_default().trim_start_matches("error: ");
                    Err(usage(format!(
                        "{place}: {reason}; a line is what follows `cantap uds`, as 'read F190'"
                    )))
                }
            }
        })
        .collect()
}

/// The file of `run`.
#[derive(clap::Args, Clone)]
pub struct RunArgs {
    /// The file; - is standard input.
    #[arg(value_name = "FILE", value_hint = clap::ValueHint::FilePath)]
    pub file: PathBuf,
}

#[cfg(test)]
mod tests {
    use super::super::What;
    use super::*;

    fn steps(name: &str, text: &str) -> anyhow::Result<Vec<Step<What>>> {
        super::steps(name, text, |what| matches!(what, What::Run { .. }))
    }

    #[test]
    fn a_file_has_a_request_in_each_line() {
        let text = "# The engine.\nread F190 F18C\n\nsession extended\nsecurity 1\nroutine start FF00 01\nwait 3s\nraw 22 F1 90\n";
        let steps = steps("a.txt", text).unwrap();
        let places: Vec<_> = steps.iter().filter_map(|step| step.place.as_deref()).collect();
        assert_eq!(places, ["a.txt:2", "a.txt:4", "a.txt:5", "a.txt:6", "a.txt:7", "a.txt:8"]);
    }

    #[test]
    fn a_line_that_is_no_request_is_shown_with_its_place() {
        for (text, expected) in [
            ("read F190\nreed F190", "a.txt:2: unrecognized subcommand 'reed'"),
            ("session XYZ", "a.txt:1: invalid value 'XYZ'"),
            ("run b.txt", "a.txt:1: a file cannot run another one"),
        ] {
            let Err(error) = steps("a.txt", text) else { panic!("{text}") };
            assert!(error.to_string().starts_with(expected), "{error}");
        }
    }
}
