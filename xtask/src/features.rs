//! Checks that each crate compiles by itself, without features and with each one alone. In the workspace's build, a feature that one crate
//! forgot to request may come with another.

use anyhow::Result;
use xshell::{Shell, cmd};

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
        cmd!(shell, "cargo check --locked -p {name} --no-default-features").run()?;
        for feature in features {
            cmd!(shell, "cargo check --locked -p {name} --no-default-features --features {feature}").run()?;
        }
    }
    Ok(())
}
