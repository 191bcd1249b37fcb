//! A lane: steps that run one after the other while the steps of another lane do.
//!
//! All lanes use one target folder, so cargo's own lock makes one of them wait while another compiles.

use std::fs::File;
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};

use anyhow::{Context, Result};

use crate::steps::Step;
use crate::{toolchain, workspace};

/// Which processor time a lane gets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Priority {
    /// As much as others.
    Normal,
    /// What nobody else wants.
    Lowest,
}

/// Steps under way; they end with this value.
pub struct Meanwhile {
    child: Child,
    output: PathBuf,
    ended: bool,
}

impl Meanwhile {
    /// Begins them, one after the other, in this program once more.
    pub fn begin(steps: &[Step], priority: Priority) -> Result<Self> {
        let folder = workspace::target().join("xtask");
        std::fs::create_dir_all(&folder)?;
        let first = steps.first().map_or_else(String::new, |step| step.name());
        let output = folder.join(format!("beside-{first}.txt"));
        let file = File::create(&output).with_context(|| output.display().to_string())?;
        let mut command = if priority == Priority::Lowest && toolchain::is_installed("nice") {
            let mut nice = Command::new("nice");
            nice.args(["-n", "19", "cargo"]);
            nice
        } else {
            Command::new("cargo")
        };
        command.args(["xtask", "ci"]).current_dir(workspace::root());
        for step in steps {
            command.args(["--only", &step.name()]);
        }
        let child =
            command.stdin(Stdio::null()).stdout(file.try_clone()?).stderr(file).spawn().context("cargo")?;
        Ok(Self { child, output, ended: false })
    }

    /// Whether a step has failed already.
    pub fn has_failed(&mut self) -> Result<bool> {
        Ok(self.child.try_wait()?.is_some_and(|status| !status.success()))
    }

    /// Waits for the end and prints what the steps printed.
    pub fn end(mut self) -> Result<ExitStatus> {
        let status = self.child.wait()?;
        self.ended = true;
        std::io::copy(&mut File::open(&self.output)?, &mut std::io::stdout().lock())?;
        Ok(status)
    }
}

impl Drop for Meanwhile {
    /// The other lane has failed: what these steps have said helps nobody any more. The command that is under way ends by itself.
    fn drop(&mut self) {
        if !self.ended {
            drop(self.child.kill());
            drop(self.child.wait());
        }
    }
}
