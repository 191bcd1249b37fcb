//! Other people's programs: those that the tests compare ours with (can-utils, tshark, python-can, cantools, asammdf), and the spelling checker.

use std::path::PathBuf;

use anyhow::Result;
use xshell::{Shell, cmd};

use crate::toolchain::{self, is_installed};
use crate::workspace;

/// Programs from Debian's packages: a program, and the package that has it.
const PROGRAMS: [(&str, &str); 2] = [("log2asc", "can-utils"), ("tshark", "tshark")];
/// Installed only where no peer may be skipped: its package starts a server that other computers can reach, which nobody wants
/// except on a test machine.
const SSH_SERVER: (&str, &str) = ("/usr/sbin/sshd", "openssh-server");
/// Python packages, with their versions.
pub const REQUIREMENTS: &str = "xtask/peers.txt";

/// Where the peers are.
pub struct Peers {
    /// A Python that has all the modules.
    pub python: PathBuf,
}

impl Peers {
    /// Finds the peers, and installs what is missing if possible. If not, prints what to run and
    /// returns `None`: the tests that need the peers then say that they were skipped.
    pub fn find_or_install(shell: &Shell) -> Result<Option<Self>> {
        let must_not_skip = std::env::var_os("CANTAP_REQUIRE_PEERS").is_some_and(|value| value == "1");
        let missing: Vec<&str> = PROGRAMS
            .iter()
            .chain(must_not_skip.then_some(&SSH_SERVER))
            .filter(|(program, _)| !is_installed(program))
            .map(|(_, package)| *package)
            .collect();
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
        Ok(Some(Peers { python: venv(shell)?.join("bin/python") }))
    }
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
    // On Debian, what a venv needs is in a separate package.
    if cmd!(shell, "python3 -c 'import ensurepip'").quiet().ignore_stderr().run().is_err()
        && toolchain::can_install()
    {
        toolchain::install(shell, &["python3-venv"])?;
    }
    cmd!(shell, "python3 -m venv --clear {venv}").run()?;
    let python = venv.join("bin/python");
    cmd!(shell, "{python} -m pip install --quiet --retries 10 -r {requirements}").run()?;
    shell.write_file(installed, wanted)?;
    Ok(venv)
}
