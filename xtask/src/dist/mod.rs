//! `cargo xtask dist`: builds a release's files in `target/dist`, each named by its content and
//! version.

mod archive;
mod command;
mod deb;
mod firmware;
pub mod notices;

use anyhow::Result;

use crate::{python, workspace};

/// The arguments of `cargo xtask dist`.
#[derive(clap::Args)]
pub struct Args {
    /// What to make; everything if not given.
    what: Vec<What>,
}

/// A part of a release.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum What {
    /// The command with manual pages and completions, for this system.
    Command,
    /// The same as Debian's package, with the udev rule.
    Deb,
    /// The package for Python: a wheel for this system, and the sources that it builds from.
    Python,
    /// The licences that such a wheel has, in `python/`, where maturin finds them.
    PythonLicences,
    /// An archive for each board: ELF, and the image for `dfu-util`.
    Firmware,
}

/// Builds and packs.
pub fn run(args: &Args) -> Result<()> {
    use clap::ValueEnum;

    let shell = workspace::shell()?;
    let dist = workspace::target().join("dist");
    shell.create_dir(&dist)?;
    // The package for Python has its own licences anyway.
    let everything =
        What::value_variants().iter().filter(|what| **what != What::PythonLicences).copied().collect();
    for what in if args.what.is_empty() { everything } else { args.what.clone() } {
        match what {
            What::Command => command::pack(&shell, &dist)?,
            What::Deb if !cfg!(target_os = "linux") => println!("no Debian package: this is not Linux"),
            What::Deb => deb::pack(&shell, &dist)?,
            What::PythonLicences => python::licences(&shell)?,
            What::Python => {
                for file in python::dist(&shell)? {
                    shell.copy_file(file, &dist)?;
                }
            }
            What::Firmware => firmware::pack(&shell, &dist)?,
        }
    }
    Ok(())
}
