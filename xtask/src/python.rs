//! The package for Python: built as a wheel, installed into a fresh environment, checked and tested there.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use xshell::{Shell, cmd};

use crate::fleet;
use crate::outcome::Outcome;
use crate::peers::{self, Peers};
use crate::{tests, workspace};

/// Where its crate is.
const MANIFEST: &str = "python/Cargo.toml";

/// Packs the sources, including those of the crates it is made of, and builds a wheel from them alone. Returns both.
pub fn dist(shell: &Shell) -> Result<[PathBuf; 2]> {
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
    Ok([wheel(shell, &sources, Profile::Release, &target().join("dist"))?, archive])
}

/// What a wheel is built for.
#[derive(Clone, Copy)]
enum Profile {
    /// For tests: the workspace's profile, next to its builds, so that compiled crates of other people are shared.
    Dev,
    /// For users.
    Release,
}

/// Builds a wheel from the sources in a folder and returns its path.
fn wheel(shell: &Shell, sources: &Path, profile: Profile, out: &Path) -> Result<PathBuf> {
    let maturin = peers::venv(shell)?.join("bin/maturin");
    let manifest = sources.join(MANIFEST);
    let (profile, compiled) = match profile {
        Profile::Dev => ("dev", workspace::target()),
        Profile::Release => ("release", target()),
    };
    shell.remove_path(out)?;
    cmd!(shell, "{maturin} build --manifest-path {manifest} --profile {profile} --out {out}")
        .env("CARGO_TARGET_DIR", compiled)
        .run()?;
    only_file(out)
}

/// The whole step.
pub fn check(shell: &Shell, peers: Option<&Peers>) -> Result<Outcome> {
    if peers.is_none() {
        return Ok(Outcome::Skipped("its tests need the peers, which cannot be installed here".to_owned()));
    }
    // Lints first: they need no wheel.
    cmd!(shell, "cargo fmt --manifest-path {MANIFEST} --check").run()?;
    cmd!(shell, "cargo clippy --manifest-path {MANIFEST} -- -D warnings")
        .env("CARGO_TARGET_DIR", workspace::target())
        .run()?;
    cmd!(shell, "cargo clippy --manifest-path {MANIFEST} --no-default-features -- -D warnings")
        .env("CARGO_TARGET_DIR", workspace::target())
        .run()?;
    let wheel = wheel(shell, &workspace::root(), Profile::Dev, &target().join("wheels"))?;
    let python = environment(shell, &wheel)?;
    cmd!(shell, "{python} -m mypy --config-file python/pyproject.toml python/cantap python/tests/typed.py")
        .run()?;
    cmd!(shell, "{python} -m mypy.stubtest --mypy-config-file python/pyproject.toml cantap._native").run()?;
    let suite = python_can(shell, &python)?;
    let pytest = python.with_file_name("python");
    // Built by the tests' step; without it, the tests that need a server say that they were skipped.
    let command = workspace::target().join("debug/cantap");
    let named = command.exists().then_some(("CANTAP_COMMAND", command));
    let fleet = ["--ignore", "python/tests/test_fleet.py"];
    // Most of them wait. python-can's look at the clock, so they run alone.
    let alone = "python/tests/test_python_can_suite.py";
    let workers = tests::threads().to_string();
    let side_by_side = ["--numprocesses", &workers, "--dist", "worksteal", "--ignore", alone];
    // Not from `python/`, where `import cantap` would find the sources.
    let mut outcome = Outcome::Passed;
    let together = cmd!(shell, "{pytest} -m pytest --quiet python/tests {fleet...} {side_by_side...}");
    if together.envs(named.clone()).run().is_err() {
        // Beside others and alone: see `tests::run`.
        println!("\nonce more, alone: the ones that failed");
        let failed = ["--last-failed", "--last-failed-no-failures", "none", "-rA"];
        cmd!(shell, "{pytest} -m pytest python/tests {fleet...} --ignore {alone} {failed...}")
            .envs(named.clone())
            .run()?;
        outcome = Outcome::Flaky(vec!["what pytest listed under 'once more'".to_owned()]);
    }
    cmd!(shell, "{pytest} -m pytest --quiet {alone}")
        .env("CANTAP_PYTHON_CAN_SOURCE", suite)
        .envs(named)
        .run()?;
    fleet::check(shell, &wheel)?;
    Ok(outcome)
}

/// Times it against other people's packages.
#[cfg(feature = "bench")]
pub fn measure() -> Result<()> {
    let shell = workspace::shell()?;
    let wheel = wheel(&shell, &workspace::root(), Profile::Release, &target().join("dist"))?;
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
