//! Compiles for other targets: the libraries without ports and threads for WebAssembly, and for Windows and macOS whatever needs
//! no C compiler of theirs. The result is neither linked nor run: hosted CI does that.

use anyhow::Result;
use xshell::Shell;

use crate::features::without_warning;
use crate::outcome::Outcome;
use crate::toolchain::{self, Toolchain};
use crate::workspace;

/// A target, and what is checked for it.
pub struct Check {
    target: &'static str,
    /// Arguments for cargo.
    arguments: &'static [&'static str],
    /// A program needed to compile its standard library, and the Debian package that has it.
    needs: Option<(&'static str, &'static str)>,
}

/// Libraries that neither open ports nor start threads.
pub const WASM: &[Check] = &[Check {
    target: "wasm32-unknown-unknown",
    arguments: &[
        "-p",
        "cantap-can",
        "-p",
        "cantap-wire",
        "-p",
        "cantap-trace",
        "-p",
        "cantap-formats",
        "-p",
        "cantap-signals",
        "-p",
        "cantap-analysis",
        "-p",
        "cantap-protocols",
        "--no-default-features",
        "--features",
        "cantap-analysis/plot",
    ],
    needs: None,
}];

/// For Windows, the whole command except zstd and SQLite, which are C. For macOS, signals are left out, too: their parser's stack guard is
/// assembly.
pub const SYSTEMS: &[Check] = &[
    Check {
        target: "x86_64-pc-windows-gnu",
        arguments: &["-p", "cantap-cli", "--no-default-features", "--features", "emu"],
        needs: Some(("x86_64-w64-mingw32-dlltool", "binutils-mingw-w64-x86-64")),
    },
    Check {
        target: "aarch64-apple-darwin",
        arguments: &[
            "-p",
            "cantap",
            "-p",
            "cantap-formats",
            "-p",
            "cantap-vendor",
            "--no-default-features",
            "--features",
            "cantap/serial",
        ],
        needs: None,
    },
];

/// Runs the checks, for each target that has a standard library here.
pub fn check(shell: &Shell, chip: Option<Toolchain>, checks: &[Check]) -> Result<Outcome> {
    let mut skipped = Vec::new();
    for Check { target, arguments, needs } in checks {
        let Some(toolchain) = Toolchain::with_std(chip, shell, target)? else {
            skipped.push(format!("no standard library for {target}; run `rustup target add {target}`"));
            continue;
        };
        if let Some((program, package)) = needs.filter(|(program, _)| !toolchain::is_installed(program)) {
            if !toolchain::can_install() {
                skipped.push(format!("{target} needs {program}; on Debian run `apt-get install {package}`"));
                continue;
            }
            toolchain::install(shell, &[package])?;
        }
        let target_dir = workspace::target().join("cross");
        let check = toolchain
            .cargo_for(shell, "check", target, "std,panic_abort", &target_dir)?
            // A standard library that has to be built is compiled even for a check, but never run: so without optimisation, and
            // without the parts that read debug information for backtraces.
            .envs([("CARGO_PROFILE_DEV_OPT_LEVEL", "0"), ("CARGO_PROFILE_DEV_DEBUG", "0")])
            .args(toolchain.std_features())
            .args(*arguments);
        without_warning(check)?;
    }
    Ok(if skipped.is_empty() { Outcome::Passed } else { Outcome::Skipped(skipped.join("; ")) })
}
