//! What is checked before a change lands, one step each.

use anyhow::Result;
use clap::ValueEnum;
use xshell::cmd;

use crate::board::Board;
use crate::machine::Machine;
use crate::outcome::Outcome;
use crate::toolchain::Toolchain;
#[cfg(unix)]
use crate::wine;
use crate::{
    check, compiler, cross, dependencies, features, firmware, kernel, package, python, reproducible, tests,
    typos, web, workspace,
};

/// One thing that is checked, in the order of the run. What [`TEST`](Step::TEST) names comes first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Step {
    /// Formatting.
    Fmt,
    /// Spelling.
    Typos,
    /// Files of one crate that import each other in a circle, and public types of one crate that share a name.
    Circles,
    /// Links in the pages, and files named there.
    Links,
    /// Lints of everything for the host.
    Clippy,
    /// The firmware, and its memory against the budget: the default board's, or in `ci` every board's.
    Firmware,
    /// The tests compile, and the programs that they run.
    Build,
    /// Every test, including those that run the firmware's ELF on the emulated board.
    Tests,
    /// Other people's crates: licences, duplicates, sources.
    Dependencies,
    /// The oldest compiler that the packages promise to build with.
    OldestCompiler,
    /// Each crate without features, and with each one alone.
    Features,
    /// The fuzz targets compile.
    Fuzz,
    /// The documentation of public items, with every link checked.
    Doc,
    /// The public items of each published library against its `public-api.txt`.
    PublicApi,
    /// The libraries without ports and threads compile for WebAssembly.
    Wasm,
    /// Windows and macOS, as far as they can be checked here.
    Systems,
    /// Lints of the firmware for each board.
    ClippyFirmware,
    /// A second build in another place gives the same bytes.
    Reproducible,
    /// A stock Linux kernel under QEMU drives the firmware on the emulated board.
    Kernel,
    /// The package for Python: wheel, types, tests, notebooks.
    Python,
    /// python-can's own tests, with that package.
    PythonCan,
    /// The page of `cantap report` in a browser: its tests.
    Web,
    /// The command that a newcomer runs first: both channels at full load, nothing lost.
    Demo,
    /// The page itself, without its tests.
    Page,
    /// The crates as they would be published: each packs.
    Package,
    /// The command for Windows, run under Wine.
    Windows,
}

impl Step {
    /// What `cargo xtask test` runs.
    pub const TEST: [Self; 8] = [
        Self::Fmt,
        Self::Typos,
        Self::Circles,
        Self::Links,
        Self::Clippy,
        Self::Firmware,
        Self::Build,
        Self::Tests,
    ];

    /// What `cargo xtask ci` runs beside the others, at the lowest priority: these steps only compile, and nothing in them waits or looks
    /// at a clock. The first ones have target folders of their own, so that they keep nobody waiting.
    pub const MEANWHILE: [Self; 12] = [
        Self::Page,
        Self::Wasm,
        Self::Systems,
        Self::Dependencies,
        Self::OldestCompiler,
        Self::Fuzz,
        Self::Features,
        Self::Doc,
        Self::PublicApi,
        Self::ClippyFirmware,
        Self::Reproducible,
        Self::Package,
    ];

    /// What `cargo xtask ci` runs beside the tests: most of both waits, and what one of them does not use of the processors the other does.
    /// It has ended before the step that needs the computer for itself, [`Kernel`](Step::Kernel).
    pub const BESIDE_TESTS: [Self; 1] = [Self::Python];

    /// What takes too long for every change, and runs weekly.
    pub const WEEKLY: [Self; 1] = [Self::Windows];

    /// Its name on the command line.
    pub fn name(self) -> String {
        self.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned())
    }

    /// Runs it for these boards; the first is the one that most tests use.
    pub fn run(self, machine: &Machine, boards: &[Board]) -> Result<Outcome> {
        let shell = &machine.shell;
        match self {
            Step::Fmt => cmd!(shell, "cargo fmt --all --check").run()?,
            Step::Typos => return typos::check(shell),
            Step::Circles => check::circles()?,
            Step::Links => check::links()?,
            Step::Clippy => {
                cmd!(shell, "cargo clippy --locked --workspace --all-targets --all-features -- -D warnings")
                    .run()?;
            }
            Step::Firmware => {
                return with_chip(machine, |chip| firmware::build_checked(shell, chip, boards));
            }
            Step::Build => {
                // They are installed first, so that whatever begins after this step finds them.
                machine.peers()?;
                tests::build(shell)?;
            }
            // Without a compiler for the chip those on the emulated board are ignored, and say so.
            Step::Tests => return tests::run(shell, machine.peers()?, boards),
            Step::Dependencies => dependencies::check(shell)?,
            Step::OldestCompiler => return compiler::check(shell),
            Step::Features => features::check(shell)?,
            Step::Fuzz => {
                let target = workspace::target();
                // A separate workspace, but with the same versions.
                shell.copy_file("Cargo.lock", "fuzz/Cargo.lock")?;
                cmd!(shell, "cargo check --manifest-path fuzz/Cargo.toml --target-dir {target}").run()?;
            }
            Step::Doc => {
                cmd!(shell, "cargo doc --locked --workspace --lib --no-deps --all-features")
                    .env("RUSTDOCFLAGS", "-D warnings")
                    .run()?;
            }
            Step::PublicApi => check::public_api()?,
            Step::Wasm => return cross::check(shell, machine.chip()?.ok(), cross::WASM),
            Step::Systems => return cross::check(shell, machine.chip()?.ok(), cross::SYSTEMS),
            Step::ClippyFirmware => return with_chip(machine, |chip| firmware::clippy(shell, chip)),
            Step::Reproducible => return with_chip(machine, |chip| reproducible::check(shell, chip)),
            Step::Kernel => {
                return match machine.chip()? {
                    Ok(_) => kernel::run(shell),
                    Err(reason) => Ok(Outcome::Skipped(reason)),
                };
            }
            Step::Python => return python::check(shell, machine.peers()?),
            Step::PythonCan => return python::check_python_can(shell, machine.peers()?),
            Step::Web => return web::check(machine),
            Step::Page => return web::builds(machine),
            Step::Demo => cmd!(shell, "cargo demo --time 3s").run()?,
            Step::Package => package::check(shell)?,
            #[cfg(unix)]
            Step::Windows => return wine::check(machine),
            #[cfg(not(unix))]
            Step::Windows => {
                return Ok(Outcome::Skipped("Wine is needed where there is no Windows".to_owned()));
            }
        }
        Ok(Outcome::Passed)
    }
}

/// Does what needs a compiler for the chip; without one, says what to do to get it.
fn with_chip(machine: &Machine, run: impl FnOnce(Toolchain) -> Result<()>) -> Result<Outcome> {
    match machine.chip()? {
        Ok(chip) => run(chip).map(|()| Outcome::Passed),
        Err(reason) => Ok(Outcome::Skipped(reason)),
    }
}
