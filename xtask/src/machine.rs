//! The machine that the steps run on: what is installed there is looked for, and installed if possible, only when a step needs it.

use std::cell::OnceCell;

use anyhow::Result;
use xshell::{Shell, cmd};

use crate::peers::Peers;
use crate::toolchain::Toolchain;
use crate::workspace;

/// A shell in the workspace's root, and what can be found on the machine.
pub struct Machine {
    pub shell: Shell,
    chip: OnceCell<Result<Toolchain, String>>,
    peers: OnceCell<Option<Peers>>,
}

impl Machine {
    /// Looks for nothing yet.
    pub fn new() -> Result<Self> {
        let shell = workspace::shell()?;
        if std::env::var_os("CI").is_some() {
            // In CI nothing is compiled twice, and nobody uses a debugger.
            for name in ["CARGO_INCREMENTAL", "CARGO_PROFILE_DEV_DEBUG"] {
                if std::env::var_os(name).is_none() {
                    shell.set_var(name, "0");
                }
            }
        }
        Ok(Self { shell, chip: OnceCell::new(), peers: OnceCell::new() })
    }

    /// A compiler for the chip, or what to do to get one.
    pub fn chip(&self) -> Result<Result<Toolchain, String>> {
        if let Some(chip) = self.chip.get() {
            return Ok(chip.clone());
        }
        let chip = Toolchain::find_or_install(&self.shell)?;
        Ok(self.chip.get_or_init(|| chip).clone())
    }

    /// Other people's programs, if they are or can be installed.
    pub fn peers(&self) -> Result<Option<&Peers>> {
        if let Some(peers) = self.peers.get() {
            return Ok(peers.as_ref());
        }
        let peers = Peers::find_or_install(&self.shell)?;
        Ok(self.peers.get_or_init(|| peers).as_ref())
    }

    /// Processors, memory, system and compiler in one line.
    pub fn description(&self) -> String {
        let read = |program: &str, arguments: &[&str]| {
            cmd!(self.shell, "{program} {arguments...}").quiet().ignore_stderr().read().unwrap_or_default()
        };
        let cores = std::thread::available_parallelism().map_or(0, usize::from);
        let model = std::fs::read_to_string("/proc/cpuinfo").ok().and_then(|text| {
            let line = text.lines().find(|line| line.starts_with("model name"))?;
            Some(line.split_once(": ")?.1.to_owned())
        });
        let memory = std::fs::read_to_string("/proc/meminfo").ok().and_then(|text| {
            let kib: u64 = text.lines().next()?.split_whitespace().nth(1)?.parse().ok()?;
            Some(format!(", {} GiB", kib / (1024 * 1024)))
        });
        format!(
            "{cores} cores ({}){}, {}, {}",
            model.as_deref().unwrap_or("unknown processor"),
            memory.unwrap_or_default(),
            read("uname", &["-sr"]),
            read("rustc", &["--version"])
        )
    }
}
