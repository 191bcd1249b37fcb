//! Other people's programs that the tests compare ours with: can-utils, tshark, python-can, cantools.

use std::path::PathBuf;

use anyhow::Result;
use xshell::{Shell, cmd};

use crate::toolchain;
use crate::workspace;

/// Programs from Debian's packages: a program, and the package that has it.
const PROGRAMS: [(&str, &str); 2] = [("log2asc", "can-utils"), ("tshark", "tshark")];
/// Python packages, each named as pip and as `import` want it.
const MODULES: [(&str, &str); 3] = [("python-can", "can"), ("pyserial", "serial"), ("cantools", "cantools")];

/// Where the peers are.
pub struct Peers {
    /// A Python that has all the modules.
    pub python: PathBuf,
}

impl Peers {
    /// Finds the peers, and installs what is missing where that is possible. `None`, with a word on
    /// what to run, where it is not: the tests that need them then say that they were skipped.
    pub fn find_or_install(shell: &Shell) -> Result<Option<Self>> {
        let missing: Vec<&str> = PROGRAMS
            .iter()
            .filter(|(program, _)| !is_installed(program))
            .map(|(_, package)| *package)
            .collect();
        if !missing.is_empty() {
            let packages = missing.join(" ");
            if !toolchain::can_install() {
                println!(
                    "not compared with {packages}: run `apt-get install {packages}` or your system's like"
                );
                return Ok(None);
            }
            toolchain::install(shell, &missing)?;
        }
        let venv = workspace::target().join("peers");
        let python = venv.join("bin/python");
        let imports: Vec<&str> = MODULES.iter().map(|(_, module)| *module).collect();
        let imports = format!("import {}", imports.join(", "));
        if cmd!(shell, "{python} -c {imports}").quiet().ignore_stderr().run().is_err() {
            let packages = MODULES.map(|(package, _)| package);
            // Debian has what a venv needs in a package of its own.
            if cmd!(shell, "python3 -c 'import ensurepip'").quiet().ignore_stderr().run().is_err()
                && toolchain::can_install()
            {
                toolchain::install(shell, &["python3-venv"])?;
            }
            cmd!(shell, "python3 -m venv --clear {venv}").run()?;
            cmd!(shell, "{python} -m pip install --quiet --retries 10 {packages...}").run()?;
        }
        Ok(Some(Peers { python }))
    }
}

/// Whether a program is on the path.
pub fn is_installed(program: &str) -> bool {
    let path = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&path).any(|dir| dir.join(program).is_file())
}
