//! The live view in a terminal, at full load on both channels: how responsive it is, and whether the recording is
//! complete.

use anyhow::{Result, ensure};
use xshell::cmd;

use crate::workspace;

/// Runs it for this long.
pub fn run(seconds: u32) -> Result<()> {
    let shell = workspace::shell()?;
    ensure!(
        cmd!(shell, "tmux -V").quiet().ignore_stdout().ignore_stderr().run().is_ok(),
        "the live view is measured in tmux; install it (apt-get install tmux)"
    );
    cmd!(shell, "cargo build --release --quiet -p cantap-cli").quiet().run()?;
    let binary = workspace::target().join("release/cantap");
    let seconds = seconds.to_string();
    cmd!(shell, "python3 xtask/src/bench/monitor.py {binary} {seconds}").quiet().run()?;
    Ok(())
}
