//! `cargo xtask kernel`, and the step of the same name: the firmware on the emulated board, driven by a stock Linux kernel under QEMU. The
//! scripts are in `sim/kernel/`.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail, ensure};
use xshell::Shell;

use crate::board::Board;
use crate::mutants::MUTANTS;
use crate::outcome::Outcome;
use crate::toolchain::{self, Toolchain, is_installed};
use crate::{firmware, workspace};

/// The command line.
#[derive(clap::Args)]
pub struct Args {
    /// Debian's kernel of this series, such as 6.12, in place of the release's own.
    #[arg(long, value_name = "SERIES")]
    linux: Option<String>,
    /// Build the firmware with a fault, for each of several: the step must find it.
    #[arg(long, conflicts_with = "parts")]
    mutants: bool,
    /// Which parts of sim/kernel/guest/parts to run; all if none is named.
    parts: Vec<String>,
}

/// What the scripts need on Debian: a program, and the package that has it.
const PROGRAMS: [(&str, &str); 6] = [
    ("qemu-system-x86_64", "qemu-system-x86"),
    ("apt-get", "apt"),
    ("cpio", "cpio"),
    ("depmod", "kmod"),
    ("xz", "xz-utils"),
    ("zstd", "zstd"),
];

/// The exit code of `prepare.sh` when the guest's packages cannot be fetched: `EX_TEMPFAIL` of sysexits.h.
const NOT_FETCHED: i32 = 75;

/// `cargo xtask kernel`. What cannot be run is a failure.
pub fn main(args: &Args) -> Result<()> {
    let shell = workspace::shell()?;
    let guest = match Guest::prepare(&shell, args.linux.as_deref())? {
        Ok(guest) => guest,
        Err(reason) => bail!("{reason}"),
    };
    if args.mutants { find_mutants(&shell, &guest) } else { guest.pass(&elf()?, &args.parts) }
}

/// The step. If QEMU or the guest is not available, returns the reason and does nothing, unless peers are required.
pub fn run(shell: &Shell) -> Result<Outcome> {
    let elf = elf()?;
    match Guest::prepare(shell, None)? {
        Ok(guest) => guest.pass(&elf, &[]).map(|()| Outcome::Passed),
        Err(reason) if crate::peers::are_required() => bail!("{reason}"),
        Err(reason) => Ok(Outcome::Skipped(reason)),
    }
}

fn elf() -> Result<PathBuf> {
    let elf = Board::ALL[0].elf();
    ensure!(elf.exists(), "there is no {}; run `cargo xtask firmware`", elf.display());
    Ok(elf)
}

/// A guest that can be booted, and the programs of ours that it needs.
struct Guest {
    cache: PathBuf,
    cantap: PathBuf,
    simulator: PathBuf,
}

impl Guest {
    /// Installs, builds and fetches what is missing; if that is not possible, returns the reason.
    fn prepare(shell: &Shell, series: Option<&str>) -> Result<Result<Self, String>> {
        if let Err(reason) = install_missing(shell) {
            return Ok(Err(reason));
        }
        // Builds the same programs as the tests do: another selection of packages would compile everything once more.
        crate::tests::build(shell)?;
        let programs = workspace::target().join("debug");
        let (folder, package) = match series {
            Some(series) => (format!("kernel-{series}"), format!("linux-image-{series}-amd64")),
            None => ("kernel".to_owned(), "linux-image-amd64".to_owned()),
        };
        let cache = workspace::target().join(folder);
        // Its own messages are already on the screen.
        let prepared = script(shell, "prepare.sh").arg(&cache).arg(package).status()?;
        if prepared.code() == Some(NOT_FETCHED) {
            return Ok(Err("the guest's packages cannot be fetched".to_owned()));
        }
        ensure!(prepared.success(), "sim/kernel/prepare.sh: {prepared}");
        Ok(Ok(Self { cache, cantap: programs.join("cantap"), simulator: programs.join("cantap-sim") }))
    }

    /// Boots it for some parts, or all if there are none, and returns the lines of the checks that failed, and whether all is well.
    fn boot(&self, elf: &Path, parts: &[String]) -> Result<(Vec<String>, bool)> {
        let shell = workspace::shell()?;
        let mut command = script(&shell, "run.sh");
        command.arg(&self.cache).args([&self.cantap, &self.simulator]).arg(elf).args(parts);
        let mut child = command.stdout(Stdio::piped()).spawn()?;
        let mut failed = Vec::new();
        for line in BufReader::new(child.stdout.take().context("no output")?).lines() {
            let line = line?;
            println!("{line}");
            failed.extend(line.strip_prefix("FAIL  ").map(str::to_owned));
        }
        Ok((failed, child.wait()?.success()))
    }

    /// Every check of these parts must hold.
    fn pass(&self, elf: &Path, parts: &[String]) -> Result<()> {
        let (failed, is_well) = self.boot(elf, parts)?;
        ensure!(is_well, "{} checks of sim/kernel failed: {}", failed.len(), failed.join("; "));
        Ok(())
    }
}

/// Every mutant must fail the check that is meant for it.
fn find_mutants(shell: &Shell, guest: &Guest) -> Result<()> {
    let toolchain = Toolchain::find(shell)?;
    let folder = workspace::target().join("mutants");
    let tree = folder.join("tree");
    let mut missed = Vec::new();
    for mutant in &MUTANTS {
        println!("--- mutant: {}", mutant.name);
        shell.remove_path(&tree)?;
        workspace::copy_sources(shell, &tree)?;
        mutant.apply(shell, &tree)?;
        let there = shell.clone();
        there.change_dir(&tree);
        let elf = firmware::build(&there, toolchain, Board::ALL[0], &folder.join("target"))?;
        let (failed, _) = guest.boot(&elf, &[mutant.part.to_owned()])?;
        if !failed.iter().any(|line| line.starts_with(mutant.caught_by)) {
            missed.push(mutant.name);
        }
    }
    shell.remove_path(&tree)?;
    ensure!(missed.is_empty(), "the kernel step does not find {}", missed.join(", nor "));
    println!("each of {} mutants is found", MUTANTS.len());
    Ok(())
}

/// A script of `sim/kernel`.
fn script(shell: &Shell, name: &str) -> Command {
    let mut command = Command::new("bash");
    command.arg(format!("sim/kernel/{name}")).current_dir(shell.current_dir());
    command
}

/// Installs what is missing, if possible; otherwise returns the reason.
fn install_missing(shell: &Shell) -> Result<(), String> {
    let missing: Vec<&str> =
        PROGRAMS.iter().filter(|(program, _)| !is_installed(program)).map(|(_, package)| *package).collect();
    if missing.is_empty() {
        return Ok(());
    }
    let packages = missing.join(" ");
    if !toolchain::can_install() {
        return Err(format!(
            "no stock kernel to attach the board to; on Debian run `apt-get install {packages}`"
        ));
    }
    toolchain::install(shell, &missing).map_err(|error| format!("{packages} cannot be installed: {error}"))
}
