//! The oldest compiler that the packages promise to build with (`rust-version`).

use anyhow::{Context, Result};
use serde::Deserialize;
use xshell::{Shell, cmd};

use crate::outcome::Outcome;
use crate::workspace;

#[derive(Deserialize)]
struct Manifest {
    workspace: Workspace,
}

#[derive(Deserialize)]
struct Workspace {
    package: Package,
}

#[derive(Deserialize)]
struct Package {
    #[serde(rename = "rust-version")]
    rust_version: String,
}

/// Compiles everything with that compiler. If the other steps already use that compiler, they are the check.
pub fn check(shell: &Shell) -> Result<Outcome> {
    let manifest: Manifest = toml::from_str(&shell.read_file("Cargo.toml")?).context("Cargo.toml")?;
    let oldest = manifest.workspace.package.rust_version;
    let here = cmd!(shell, "rustc --version").quiet().read()?;
    if here.starts_with(&format!("rustc {oldest}.")) {
        println!("{here}: every other step is built with it");
        return Ok(Outcome::Passed);
    }
    if cmd!(shell, "rustup run {oldest} rustc --version")
        .quiet()
        .ignore_stderr()
        .ignore_stdout()
        .run()
        .is_err()
    {
        return Ok(Outcome::Skipped(format!(
            "this is {here}; `rustup toolchain install {oldest}` installs the one to check"
        )));
    }
    let target = workspace::target().join("oldest-compiler");
    cmd!(shell, "rustup run {oldest} cargo check --locked --workspace --all-targets --all-features --target-dir {target}")
        .run()?;
    Ok(Outcome::Passed)
}
