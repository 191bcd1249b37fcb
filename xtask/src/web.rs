//! The page: its engine for WebAssembly, its script and style, and all of it in one file, `target/web/page.html`.

use std::path::{Path, PathBuf};

use anyhow::{Result, ensure};
use flate2::Compression;
use flate2::write::GzEncoder;
use xshell::{Shell, cmd};

use crate::dist::notices;
use crate::machine::Machine;
use crate::outcome::Outcome;
use crate::tests;
use crate::toolchain::{self, Toolchain};
use crate::workspace;

const TARGET: &str = "wasm32-unknown-unknown";
/// A released binary carries the page, compressed, and so does every report.
const MOST_BYTES: usize = 4_000_000;
/// Programs that build the page, and Debian's packages that have them.
const PROGRAMS: [(&str, &str); 2] = [("node", "nodejs"), ("npm", "npm")];
/// The same for what runs the page's tests.
const BROWSER: (&str, &str) = ("chromium", "chromium");
/// A second browser, in which less is tested. Without it, its tests are skipped and say so.
const OTHER_BROWSER: (&str, &str) = ("firefox-esr", "firefox-esr");
/// What Debian's toolchain needs in addition.
const LINKER: (&str, &str) = ("wasm-ld", "lld");

/// The page, and how large it is.
pub struct Page {
    /// The page itself.
    pub html: PathBuf,
    /// The same, compressed: for `CANTAP_BUILT_PAGE`.
    pub compressed: PathBuf,
}

/// `cargo xtask web`.
pub fn run() -> Result<()> {
    match build(&Machine::new()?)? {
        Ok(page) => println!("{}", page.html.display()),
        Err(reason) => anyhow::bail!("{reason}"),
    }
    Ok(())
}

/// Builds the page: it is small enough.
pub fn builds(machine: &Machine) -> Result<Outcome> {
    Ok(build(machine)?.map_or_else(Outcome::Skipped, |_| Outcome::Passed))
}

/// Builds the page, and runs its tests in a browser, with a trace of its own and served by the command.
pub fn check(machine: &Machine) -> Result<Outcome> {
    let page = match build(machine)? {
        Ok(page) => page,
        Err(reason) => return Ok(Outcome::Skipped(reason)),
    };
    let shell = &machine.shell;
    if let Err(reason) = install(shell, &[BROWSER])? {
        return Ok(Outcome::Skipped(reason));
    }
    // A system that has no such package is no reason to fail.
    let installed = install(shell, &[OTHER_BROWSER]).unwrap_or_else(|error| Err(error.to_string()));
    if let Err(reason) = installed {
        println!("Firefox is not tested: {reason}");
    }
    // The command that serves it, as the tests' step builds it.
    tests::build(shell)?;
    let program = workspace::target().join(format!("debug/cantap{}", std::env::consts::EXE_SUFFIX));
    let _in_page = shell.push_dir("web/page");
    let html = &page.html;
    cmd!(shell, "npm test -- --page {html} --program {program}").run()?;
    Ok(Outcome::Passed)
}

/// Builds the page; if something is missing that cannot be installed, returns what to do.
pub fn build(machine: &Machine) -> Result<Result<Page, String>> {
    let _alone = workspace::only_one("page")?;
    let shell = &machine.shell;
    if let Err(reason) = install(shell, &PROGRAMS)? {
        return Ok(Err(reason));
    }
    let Some(toolchain) = Toolchain::with_std(machine.chip()?.ok(), shell, TARGET)? else {
        return Ok(Err(format!("no standard library for {TARGET}; run `rustup target add {TARGET}`")));
    };
    if toolchain == Toolchain::Debian
        && let Err(reason) = install(shell, &[LINKER])?
    {
        return Ok(Err(reason));
    }
    let directory = workspace::target().join("web");
    shell.create_dir(&directory)?;
    let engine = engine(shell, toolchain, &directory)?;
    let licences = directory.join("THIRD-PARTY.txt");
    notices::write(shell, &licences, &["-p", "cantap-web-engine", "--target", TARGET])?;
    let html = directory.join("page.html");
    {
        let _in_page = shell.push_dir("web/page");
        // Not while another lane's tests use the packages: it would remove them first.
        let (wanted, installed) = ("package-lock.json", "node_modules/installed.json");
        if shell.read_file(installed).ok() != Some(shell.read_file(wanted)?) {
            cmd!(shell, "npm ci --no-audit --no-fund").quiet().run()?;
            shell.copy_file(wanted, installed)?;
        }
        cmd!(shell, "npm run --silent check").run()?;
        cmd!(shell, "node build.mjs --engine {engine} --licences {licences} --out {html}").run()?;
    }
    let compressed = compress(&html)?;
    Ok(Ok(Page { html, compressed }))
}

/// The engine as WebAssembly.
fn engine(shell: &Shell, toolchain: Toolchain, directory: &Path) -> Result<PathBuf> {
    toolchain
        .cargo_for(shell, "build", TARGET, "std,panic_abort", directory)?
        .env("CARGO_TARGET_WASM32_UNKNOWN_UNKNOWN_LINKER", linker(toolchain))
        // The page has no paths of this machine in it.
        .env("CARGO_ENCODED_RUSTFLAGS", toolchain.remaps(shell)?)
        // Without the parts that read debug information for backtraces.
        .args(toolchain.std_features())
        .args(["--profile", "web", "-p", "cantap-web-engine"])
        .run()?;
    Ok(directory.join(TARGET).join("web/cantap_web_engine.wasm"))
}

const fn linker(toolchain: Toolchain) -> &'static str {
    match toolchain {
        Toolchain::Rustup => "rust-lld",
        Toolchain::Debian => "wasm-ld",
    }
}

/// Compresses the page and checks its size.
fn compress(html: &Path) -> Result<PathBuf> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
    std::io::Write::write_all(&mut encoder, &std::fs::read(html)?)?;
    let packed = encoder.finish()?;
    let path = html.with_extension("html.gz");
    std::fs::write(&path, &packed)?;
    println!("the page takes {} bytes, {} compressed", std::fs::metadata(html)?.len(), packed.len());
    ensure!(
        packed.len() <= MOST_BYTES,
        "the page takes {} bytes compressed; at most {MOST_BYTES} are allowed",
        packed.len()
    );
    Ok(path)
}

/// Installs what is missing; if that is not possible, returns what to do.
fn install(shell: &Shell, programs: &[(&str, &str)]) -> Result<Result<(), String>> {
    let missing: Vec<&str> = programs
        .iter()
        .filter(|(program, _)| !toolchain::is_installed(program))
        .map(|(_, package)| *package)
        .collect();
    if missing.is_empty() {
        return Ok(Ok(()));
    }
    if !toolchain::can_install() {
        let packages = missing.join(" ");
        return Ok(Err(format!("the page needs {packages}; on Debian run `apt-get install {packages}`")));
    }
    toolchain::install(shell, &missing)?;
    Ok(Ok(()))
}
