//! How long the live view's graph takes to be drawn anew with millions of values in its window. What is drawn is inside of the command,
//! so its own test measures.

use anyhow::Result;
use xshell::cmd;

use crate::workspace;

/// Runs the measurement.
pub fn run() -> Result<()> {
    let shell = workspace::shell()?;
    let test = "redraws_of_five_million_values";
    cmd!(
        shell,
        "cargo test --release --quiet -p cantap-cli --bin cantap -- --ignored --nocapture --test-threads 1 {test}"
    )
    .quiet()
    .run()?;
    Ok(())
}
