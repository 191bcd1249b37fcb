//! `cargo xtask kernel --mutants`: firmware with faults built in on purpose, each of which the kernel step must find. A check that has never
//! been seen to fail shows nothing.

use std::path::Path;

use anyhow::{Result, ensure};
use xshell::Shell;

/// A fault.
pub struct Mutant {
    /// Its name.
    pub name: &'static str,
    /// The part of `sim/kernel/guest/parts` that finds it.
    pub part: &'static str,
    /// The check that fails, by the beginning of its line.
    pub caught_by: &'static str,
    /// In which files what is replaced by what, wherever it stands.
    edits: &'static [(&'static str, &'static str, &'static str)],
}

/// All of them.
pub const MUTANTS: [Mutant; 4] = [
    // The data endpoints keep their toggles, against USB 2.0, 9.1.1.5.
    Mutant {
        name: "toggles that are not reset",
        part: "chapter9",
        caught_by: "a new configuration begins with DATA0",
        edits: &[
            ("src/hw/usb/bulk_in.rs", "| epctl::SD0PID;", ";"),
            ("src/hw/usb/bulk_in.rs", "epctl::STALL, epctl::SD0PID)", "epctl::STALL, 0)"),
            ("src/hw/usb/bulk_out.rs", "| epctl::SD0PID;", ";"),
            ("src/hw/usb/bulk_out.rs", "epctl::STALL, epctl::SD0PID)", "epctl::STALL, 0)"),
        ],
    },
    Mutant {
        name: "one frame in 2,048 dropped",
        part: "captures",
        caught_by: "a capture at 100 %, shortest frames",
        edits: &[(
            "src/bus/capture.rs",
            "state.frames = state.frames.wrapping_add(1);",
            "state.frames = state.frames.wrapping_add(1); if state.frames.is_multiple_of(2048) { continue; }",
        )],
    },
    // Channel 2 takes no extended frames.
    Mutant {
        name: "a filter closed",
        part: "captures",
        caught_by: "a capture at 50 %",
        edits: &[(
            "src/bus/filters.rs",
            "banks[DEFAULT_SPLIT] = Some(Bank::ALL);",
            "banks[DEFAULT_SPLIT] = Some(Bank { shape: Shape::Mask32, first: 0, second: 1 << 2 });",
        )],
    },
    Mutant {
        name: "one stamp in 512 too early by 20 us",
        part: "captures",
        caught_by: "a capture at 50 %",
        edits: &[(
            "src/bus/capture.rs",
            ".map(|entered| self.recorder.time(entered));",
            ".map(|entered| self.recorder.time(entered.wrapping_sub(if state.frames.is_multiple_of(512) { 240 } else { 0 })));",
        )],
    },
];

impl Mutant {
    /// Puts the fault into the sources in `tree`.
    pub fn apply(&self, shell: &Shell, tree: &Path) -> Result<()> {
        for (file, right, wrong) in self.edits {
            let path = tree.join(file);
            let source = shell.read_file(&path)?;
            ensure!(
                source.contains(right),
                "the mutant '{}' finds no `{right}` in {file} any more; adapt it in xtask/src/mutants.rs",
                self.name
            );
            shell.write_file(&path, source.replace(right, wrong))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::workspace;

    /// They are built only now and then: this shows early that the firmware has changed under them.
    #[test]
    fn every_mutant_still_fits_the_firmware_and_the_checks() {
        for mutant in &MUTANTS {
            for (file, right, wrong) in mutant.edits {
                let source = std::fs::read_to_string(workspace::root().join(file)).unwrap();
                assert!(source.contains(right) && right != wrong, "{}: {file}: {right}", mutant.name);
            }
            let part = workspace::root().join(format!("sim/kernel/guest/parts/{}.sh", mutant.part));
            let checks = std::fs::read_to_string(part).unwrap();
            assert!(
                checks.contains(&format!("\"{}\"", mutant.caught_by)),
                "{}: {}",
                mutant.name,
                mutant.caught_by
            );
        }
    }
}
