//! Other people's programs: those that the tests compare ours with (can-utils, tshark, python-can, cantools, asammdf), and the spelling checker.

use std::path::PathBuf;

use anyhow::{Result, ensure};
use xshell::{Shell, cmd};

use crate::toolchain::{self, is_installed};
use crate::workspace;

/// Programs from Debian's packages: a program, and the package that has it.
const PROGRAMS: [(&str, &str); 2] = [("log2asc", "can-utils"), ("tshark", "tshark")];
/// The server, the client, and the package that brings both. Installed only in CI, or if no peer may be skipped: the package starts
/// a server that other computers can reach, which nobody wants except on a test machine.
const SSH: ([&str; 2], &str) = (["/usr/sbin/sshd", "ssh"], "openssh-server");
/// Python packages, with their versions.
pub const REQUIREMENTS: &str = "xtask/peers.txt";

/// What installs them: pip would take eight times as long.
const INSTALLER: &str = "uv==0.13.9";

/// Where the peers are.
pub struct Peers {
    /// A Python that has all the modules.
    pub python: PathBuf,
    /// Those that were not installed on purpose, by the names that tests use (`peers::skip_without`).
    pub left_out: Vec<&'static str>,
}

impl Peers {
    /// Finds the peers, and installs what is missing if possible. If not, prints what to run and
    /// returns `None`: the tests that need the peers then say that they were skipped.
    pub fn find_or_install(shell: &Shell) -> Result<Option<Self>> {
        let mut missing: Vec<&str> = PROGRAMS
            .iter()
            .filter(|(program, _)| !is_installed(program))
            .map(|(_, package)| *package)
            .collect();
        let mut left_out = Vec::new();
        if !SSH.0.iter().all(|program| is_installed(program)) {
            if are_required() || std::env::var_os("CI").is_some() {
                missing.push(SSH.1);
            } else {
                println!("not compared with a real ssh: run `apt-get install {}` for that", SSH.1);
                left_out.push("ssh");
            }
        }
        if !missing.is_empty() {
            let packages = missing.join(" ");
            if !toolchain::can_install() {
                println!(
                    "not compared with {packages}: run `apt-get install {packages}` or your system's equivalent"
                );
                return Ok(None);
            }
            toolchain::install(shell, &missing)?;
        }
        if !has_venv(shell)? {
            println!("not compared with Python's packages: {NO_VENV}");
            return Ok(None);
        }
        Ok(Some(Peers { python: venv(shell)?.join("bin/python"), left_out }))
    }
}

/// What to do where there are no Python environments.
pub const NO_VENV: &str = "run `apt-get install python3-venv` or your system's equivalent";

/// Whether a missing peer is a failure.
pub fn are_required() -> bool {
    std::env::var_os("CANTAP_REQUIRE_PEERS").is_some_and(|value| value == "1")
}

/// Whether Python environments can be made here. On Debian, what that takes is in a separate package, which is installed if possible.
pub fn has_venv(shell: &Shell) -> Result<bool> {
    let works = || cmd!(shell, "python3 -c 'import ensurepip'").quiet().ignore_stderr().run().is_ok();
    if is_installed("python3") && works() {
        return Ok(true);
    }
    if !toolchain::can_install() {
        return Ok(false);
    }
    toolchain::install(shell, &["python3-venv"])?;
    Ok(true)
}

/// A Python environment with the packages of `peers.txt`.
pub fn venv(shell: &Shell) -> Result<PathBuf> {
    environment(shell, "peers", REQUIREMENTS)
}

/// A Python environment under this name in `target/`, with the packages that a file names, made again if that file has changed.
pub fn environment(shell: &Shell, name: &str, requirements: &str) -> Result<PathBuf> {
    let venv = workspace::target().join(name);
    let installed = venv.join("installed.txt");
    let wanted = shell.read_file(requirements)?;
    if shell.read_file(&installed).is_ok_and(|text| text == wanted) {
        return Ok(venv);
    }
    ensure!(has_venv(shell)?, "no Python environments: {NO_VENV}");
    cmd!(shell, "python3 -m venv --clear {venv}").run()?;
    let python = venv.join("bin/python");
    // Most of their modules are never imported: those that are, are compiled then.
    let pip = ["install", "--quiet", "--no-compile", "--retries", "10"];
    cmd!(shell, "{python} -m pip {pip...} {INSTALLER}").run()?;
    let uv = venv.join("bin/uv");
    let cache = workspace::target().join("uv");
    let installs = cmd!(shell, "{uv} pip install --quiet --python {python} -r {requirements}");
    if installs.env("UV_CACHE_DIR", cache).run().is_err() {
        // It knows nothing of pip's configuration: another index, a proxy's certificate.
        cmd!(shell, "{python} -m pip {pip...} -r {requirements}").run()?;
    }
    shell.write_file(installed, wanted)?;
    Ok(venv)
}
