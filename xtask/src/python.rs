//! The package for Python: built as a wheel, installed into a fresh environment, checked and tested there.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use xshell::{Shell, cmd};

use crate::dist::notices;
use crate::fleet;
use crate::outcome::Outcome;
use crate::peers::{self, Peers};
use crate::{tests, workspace};

/// Where its crate is.
const MANIFEST: &str = "python/Cargo.toml";

/// Writes the licences of the package and of other people's crates in it to where maturin packs them from.
pub fn licences(shell: &Shell) -> Result<()> {
    for ours in ["LICENSE-APACHE", "LICENSE-MIT"] {
        shell.copy_file(ours, "python")?;
    }
    notices::write(shell, Path::new("python/LICENSES-THIRD-PARTY.txt"), &["-p", "cantap-python"])
}

/// Packs the sources, including those of the crates it is made of, and builds a wheel from them alone. Returns both.
pub fn dist(shell: &Shell) -> Result<[PathBuf; 2]> {
    licences(shell)?;
    let maturin = peers::venv(shell)?.join("bin/maturin");
    let packed = target().join("sources");
    shell.remove_path(&packed)?;
    cmd!(shell, "{maturin} sdist --manifest-path {MANIFEST} --out {packed}").run()?;
    let archive = only_file(&packed)?;
    let unpacked = target().join("unpacked");
    shell.remove_path(&unpacked)?;
    shell.create_dir(&unpacked)?;
    cmd!(shell, "tar --extract --file {archive} --directory {unpacked}").run()?;
    let sources = only_file(&unpacked)?;
    Ok([released_wheel(shell, &sources)?, archive])
}

/// Builds the wheel for users from the sources in a folder and returns its path.
fn released_wheel(shell: &Shell, sources: &Path) -> Result<PathBuf> {
    let maturin = peers::venv(shell)?.join("bin/maturin");
    let (manifest, out) = (sources.join(MANIFEST), target().join("dist"));
    shell.remove_path(&out)?;
    cmd!(shell, "{maturin} build --manifest-path {manifest} --out {out}")
        .env("CARGO_TARGET_DIR", target())
        .run()?;
    only_file(&out)
}

/// Builds a wheel for tests and returns its path.
///
/// `maturin build` would compile this package alone, and with it the crates that then have other features than in the whole workspace,
/// Arrow and Parquet among them. So the library is compiled as the tests of the workspace are, and maturin tells what else is in a wheel.
fn wheel(shell: &Shell) -> Result<PathBuf> {
    cmd!(shell, "cargo build --locked --workspace --all-features --lib").run()?;
    let tools = peers::venv(shell)?.join("bin");
    let (maturin, python) = (tools.join("maturin"), tools.join("python"));
    let (unpacked, out) = (target().join("wheel"), target().join("wheels"));
    for folder in [&unpacked, &out] {
        shell.remove_path(folder)?;
        shell.create_dir(folder)?;
    }
    let there = shell.clone();
    there.change_dir("python");
    cmd!(there, "{maturin} pep517 write-dist-info --metadata-directory {unpacked} --interpreter {python}")
        .run()?;
    let files = cmd!(there, "git ls-files --cached --others --exclude-standard cantap").quiet().read()?;
    for file in files.lines().filter(|file| there.path_exists(file)) {
        shell.create_dir(unpacked.join(file).parent().unwrap_or(&unpacked))?;
        there.copy_file(file, unpacked.join(file))?;
    }
    let library = workspace::target().join("debug").join(LIBRARY);
    shell.copy_file(library, unpacked.join("cantap/_native.abi3.so"))?;
    cmd!(shell, "{python} -m wheel pack {unpacked} --dest-dir {out}").quiet().run()?;
    only_file(&out)
}

/// What the compiler calls the extension module.
const LIBRARY: &str = if cfg!(target_os = "macos") { "lib_native.dylib" } else { "lib_native.so" };

/// The whole step.
pub fn check(shell: &Shell, peers: Option<&Peers>) -> Result<Outcome> {
    if peers.is_none() {
        return Ok(Outcome::Skipped("its tests need the peers, which cannot be installed here".to_owned()));
    }
    let wheel = wheel(shell)?;
    let python = environment(shell, &wheel)?;
    cmd!(shell, "{python} -m mypy --config-file python/pyproject.toml python/cantap python/tests/typed.py")
        .run()?;
    cmd!(shell, "{python} -m mypy.stubtest --mypy-config-file python/pyproject.toml cantap._native").run()?;
    let pytest = python.with_file_name("python");
    // Built by the tests' step; without it, the tests that need a server say that they were skipped.
    let command = workspace::target().join("debug/cantap");
    let named = command.exists().then_some(("CANTAP_COMMAND", command));
    let fleet = ["--ignore", "python/tests/test_fleet.py"];
    // Most of them wait.
    let workers = tests::threads().to_string();
    let side_by_side = ["--numprocesses", &workers, "--dist", "worksteal", "--ignore", PYTHON_CAN_SUITE];
    // Not from `python/`, where `import cantap` would find the sources.
    let mut outcome = Outcome::Passed;
    let together = cmd!(shell, "{pytest} -m pytest --quiet python/tests {fleet...} {side_by_side...}");
    if together.envs(named.clone()).run().is_err() {
        // Beside others and alone: see `tests::run`.
        println!("\nonce more, alone: the ones that failed");
        let failed = ["--last-failed", "--last-failed-no-failures", "none", "-rA"];
        cmd!(shell, "{pytest} -m pytest python/tests {fleet...} --ignore {PYTHON_CAN_SUITE} {failed...}")
            .envs(named)
            .run()?;
        outcome = Outcome::Flaky(vec!["what pytest listed under 'once more'".to_owned()]);
    }
    fleet::check(shell, &wheel)?;
    Ok(outcome)
}

/// Where python-can's own tests are run from.
const PYTHON_CAN_SUITE: &str = "python/tests/test_python_can_suite.py";

/// python-can's own tests, with the package that [`check`] has installed. They look at the clock, so nothing runs beside them.
pub fn check_python_can(shell: &Shell, peers: Option<&Peers>) -> Result<Outcome> {
    if peers.is_none() {
        return Ok(Outcome::Skipped("it needs the peers, which cannot be installed here".to_owned()));
    }
    let mut python = target().join("venv/bin/python");
    if !python.exists() {
        python = environment(shell, &wheel(shell)?)?;
    }
    let suite = python_can(shell, &python)?;
    cmd!(shell, "{python} -m pytest --quiet {PYTHON_CAN_SUITE}")
        .env("CANTAP_PYTHON_CAN_SOURCE", suite)
        .run()?;
    Ok(Outcome::Passed)
}

/// Times it against other people's packages.
#[cfg(feature = "bench")]
pub fn measure() -> Result<()> {
    let shell = workspace::shell()?;
    let wheel = released_wheel(&shell, &workspace::root())?;
    let python = environment(&shell, &wheel)?;
    Ok(cmd!(shell, "{python} python/bench/side_by_side.py").run()?)
}

/// The folder for everything that belongs to it.
fn target() -> PathBuf {
    workspace::target().join("python")
}

/// A fresh environment that has this wheel and can see the peers' packages.
fn environment(shell: &Shell, wheel: &Path) -> Result<PathBuf> {
    let venv = target().join("venv");
    cmd!(shell, "python3 -m venv --clear {venv}").run()?;
    let python = venv.join("bin/python");
    let where_packages_are = "import sysconfig; print(sysconfig.get_path('purelib'))";
    let of_peers = peers::venv(shell)?.join("bin/python");
    let theirs = cmd!(shell, "{of_peers} -c {where_packages_are}").read()?;
    let ours = cmd!(shell, "{python} -c {where_packages_are}").read()?;
    shell.write_file(Path::new(&ours).join("peers.pth"), theirs)?;
    cmd!(shell, "{python} -m pip install --quiet --no-deps --no-index {wheel}").run()?;
    Ok(python)
}

/// The sources, with tests, of the python-can version among the peers.
fn python_can(shell: &Shell, python: &Path) -> Result<PathBuf> {
    let wanted = shell.read_file(peers::REQUIREMENTS)?;
    let wanted =
        wanted.lines().find(|line| line.starts_with("python-can==")).context("no python-can in the peers")?;
    let version = wanted.trim_start_matches("python-can==");
    let folder = target().join(format!("python_can-{version}"));
    if !folder.join("test").exists() {
        let out = target();
        let pip = "--quiet --retries 10 --no-deps --no-binary python-can".split(' ');
        cmd!(shell, "{python} -m pip download {pip...} --dest {out} {wanted}").run()?;
        let archive = out.join(format!("python_can-{version}.tar.gz"));
        cmd!(shell, "tar --extract --file {archive} --directory {out}").run()?;
    }
    Ok(folder)
}

fn only_file(folder: &Path) -> Result<PathBuf> {
    let mut files = std::fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect::<Result<Vec<_>>>()?;
    ensure!(files.len() == 1, "expected one file in {}, found {}", folder.display(), files.len());
    Ok(files.remove(0))
}
