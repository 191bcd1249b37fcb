//! How long redrawing the live view's graph takes with millions of values in its window. The graph is internal to the command, so one
//! of its own tests measures this.

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
