//! The fleet's job, on a Spark cluster of two worker processes: types and tests of `python/examples/fleet`.

use std::path::Path;

use anyhow::{Result, ensure};
use xshell::{Shell, cmd};

use crate::{peers, toolchain, workspace};

/// Spark (430 MB, kept in `target/spark`) and what else the job and its tests need.
const REQUIREMENTS: &str = "python/examples/fleet/requirements.txt";
/// What Spark runs on.
const JAVA: &str = "openjdk-17-jre-headless";

/// Checks the job with this wheel of the package.
pub fn check(shell: &Shell, wheel: &Path) -> Result<()> {
    if !toolchain::is_installed("java") {
        if !toolchain::can_install() {
            ensure!(
                !peers::are_required(),
                "Spark needs Java 17: run `apt-get install {JAVA}` or your system's equivalent"
            );
            println!("the fleet's job was not run: run `apt-get install {JAVA}` or your system's equivalent");
            return Ok(());
        }
        toolchain::install(shell, &[JAVA])?;
    }
    let python = peers::environment(shell, "spark", REQUIREMENTS)?.join("bin/python");
    cmd!(shell, "{python} -m pip install --quiet --no-deps --no-index --force-reinstall {wheel}").run()?;
    let fleet = "python/examples/fleet";
    cmd!(shell, "{python} -m mypy --config-file {fleet}/mypy.ini {fleet}/job.py {fleet}/cantap_fleet")
        .run()?;
    // Built by the tests' step; without it one test says that it was skipped.
    let command = workspace::target().join("debug/cantap");
    let named = command.exists().then_some(("CANTAP_COMMAND", command));
    cmd!(shell, "{python} -m pytest --quiet python/tests/test_fleet.py").envs(named).run()?;
    Ok(())
}
