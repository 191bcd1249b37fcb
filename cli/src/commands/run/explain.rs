//! `cantap run --explain`: where each statement that sends runs. Nothing is opened on the bus, and nothing runs.

use std::io::Write;

use cantap::Channel;
use cantap_address::{Address, OpenDevice};
use cantap_scripts::{Explained, Script, Target};
use cantap_trace::clean;
use serde_json::json;

/// Prints a line for each statement.
pub fn explain(
    scripts: &[Script],
    device: Option<&Address>,
    channels: impl Fn(&OpenDevice) -> Vec<Channel>,
    as_json: bool,
) -> anyhow::Result<()> {
    let target = match device {
        None => Target::Simulation,
        Some(address) => {
            let device = address.open()?;
            match (scripts, &channels(&device)[..]) {
                ([_], [channel]) => Target::alone_on(device.hello(), *channel),
                _ => Target::of(device.hello()),
            }
        }
    };
    let mut out = std::io::stdout().lock();
    for script in scripts {
        for statement in script.explain(target)? {
            if as_json {
                writeln!(out, "{}", object(&statement))?;
            } else {
                writeln!(out, "{}", line(&statement))?;
            }
        }
    }
    Ok(out.flush()?)
}

fn line(statement: &Explained) -> String {
    let Explained { script, line, function, within, placement } = statement;
    let within = within.as_ref().map(|(of, line)| format!("; called by {of} of line {line}"));
    format!(
        "{}:{line}: {function}: {}: {}{}",
        clean::line(script),
        placement.runner.name(),
        placement.accuracy,
        within.unwrap_or_default()
    )
}

fn object(statement: &Explained) -> serde_json::Value {
    let Explained { script, line, function, within, placement } = statement;
    json!({
        "script": script,
        "line": line,
        "function": function,
        "runs_on": placement.runner.name(),
        "accuracy": placement.accuracy,
        "called_by": within.as_ref().map(|(function, line)| json!({ "function": function, "line": line })),
    })
}
