//! `cargo xtask ci --only kernel`: the firmware on the emulated board, driven by a stock Linux kernel under QEMU. The scripts are in
//! `sim/kernel/`.

use anyhow::{Result, bail, ensure};
use xshell::{Shell, cmd};

use crate::board::Board;
use crate::outcome::Outcome;
use crate::toolchain::{self, is_installed};
use crate::workspace;

/// What the scripts need on Debian: a program, and the package that has it.
const PROGRAMS: [(&str, &str); 5] = [
    ("qemu-system-x86_64", "qemu-system-x86"),
    ("apt-get", "apt"),
    ("cpio", "cpio"),
    ("depmod", "kmod"),
    ("xz", "xz-utils"),
];

/// The exit code of `prepare.sh` when the guest's packages cannot be fetched: `EX_TEMPFAIL` of sysexits.h.
const NOT_FETCHED: i32 = 75;

/// Boots the guest and runs its checks. If QEMU or the guest is not available, returns the reason and does nothing, unless peers
/// are required.
pub fn run(shell: &Shell) -> Result<Outcome> {
    let elf = Board::ALL[0].elf();
    ensure!(elf.exists(), "there is no {}; run `cargo xtask firmware`", elf.display());
    if let Err(reason) = install_missing(shell) {
        return skip(reason);
    }
    // Builds the same programs as the tests do: another selection of packages would compile everything once more.
    crate::tests::build(shell)?;
    let programs = workspace::target().join("debug");
    let (cantap, simulator) = (programs.join("cantap"), programs.join("cantap-sim"));
    let cache = workspace::target().join("kernel");
    // Its own messages are already on the screen.
    let prepared = std::process::Command::new("bash")
        .arg("sim/kernel/prepare.sh")
        .arg(&cache)
        .current_dir(shell.current_dir())
        .status()?;
    if prepared.code() == Some(NOT_FETCHED) {
        return skip("the guest's packages cannot be fetched".to_owned());
    }
    ensure!(prepared.success(), "sim/kernel/prepare.sh: {prepared}");
    cmd!(shell, "bash sim/kernel/run.sh {cache} {cantap} {simulator} {elf}").run()?;
    Ok(Outcome::Passed)
}

/// Not run, for a reason; this is a failure if peers are required.
fn skip(reason: String) -> Result<Outcome> {
    if crate::peers::are_required() {
        bail!("{reason}");
    }
    Ok(Outcome::Skipped(reason))
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
