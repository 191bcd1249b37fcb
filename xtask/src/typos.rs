//! Spelling, by `typos`. Words that it would wrongly flag are in `typos.toml`.

use anyhow::Result;
use xshell::{Shell, cmd};

use crate::outcome::Outcome;
use crate::{peers, toolchain};

/// Checks every file that belongs to the source.
pub fn check(shell: &Shell) -> Result<Outcome> {
    if !toolchain::is_installed("python3") {
        return Ok(Outcome::Skipped(
            "typos is installed by Python's pip, and there is no python3".to_owned(),
        ));
    }
    let typos = peers::venv(shell)?.join("bin/typos");
    cmd!(shell, "{typos} --format brief").run()?;
    Ok(Outcome::Passed)
}
