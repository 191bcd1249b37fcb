//! Checks that each crate compiles by itself, without features and with each one alone. In the workspace's build, a feature that one crate
//! forgot to request may come with another.

use anyhow::{Result, ensure};
use xshell::{Cmd, Shell, cmd};

use crate::metadata::Metadata;

/// Compiles every combination that makes a difference on the host.
pub fn check(shell: &Shell) -> Result<()> {
    let metadata = Metadata::read(shell)?;
    for package in metadata.members() {
        let name = &package.name;
        // The firmware's features are its boards, which mean nothing on the host.
        let features: Vec<&String> = match name.as_str() {
            "cantap-firmware" => Vec::new(),
            _ => package.features.keys().filter(|feature| *feature != "default").collect(),
        };
        without_warning(cmd!(shell, "cargo check --locked -p {name} --no-default-features"))?;
        for feature in features {
            without_warning(cmd!(
                shell,
                "cargo check --locked -p {name} --no-default-features --features {feature}"
            ))?;
        }
    }
    Ok(())
}

/// Runs it; a warning about one of our crates is an error. (As a flag of the compiler, that would compile other people's crates again.)
pub fn without_warning(check: Cmd<'_>) -> Result<()> {
    let name = check.to_string();
    let output = check.ignore_status().output()?;
    let text = String::from_utf8_lossy(&output.stderr);
    eprint!("{text}");
    ensure!(output.status.success(), "{name}: {}", output.status);
    ensure!(!text.lines().any(|line| line.starts_with("warning: `cantap")), "{name}: see the warnings above");
    Ok(())
}
