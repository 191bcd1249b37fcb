//! Spelling, by `typos`. Words that it would wrongly flag are in `typos.toml`.

use anyhow::Result;
use xshell::{Shell, cmd};

use crate::outcome::Outcome;
use crate::peers;

/// Checks every file that belongs to the source.
pub fn check(shell: &Shell) -> Result<Outcome> {
    if !peers::has_venv(shell)? {
        return Ok(Outcome::Skipped(format!("typos is installed by Python's pip: {}", peers::NO_VENV)));
    }
    let typos = peers::venv(shell)?.join("bin/typos");
    cmd!(shell, "{typos} --format brief").run()?;
    Ok(Outcome::Passed)
}
