//! Finds a compiler for the chip.
//!
//! An ordinary rustup has the target's standard library, because `rust-toolchain.toml` names it. If it is
//! absent and cannot be fetched, Debian's packaged toolchain builds `core` from source. That source must
//! match the compiler's version, so parts of the two toolchains are never mixed.

use std::path::{Path, PathBuf};

use crate::workspace;
use anyhow::{Context, Result, bail};
use xshell::{Cmd, Shell, cmd};

/// The chip's target: Cortex-M4 with its FPU.
pub const TARGET: &str = "thumbv7em-none-eabihf";

const DEBIAN_CARGO: &str = "/usr/bin/cargo";
const DEBIAN_RUSTC: &str = "/usr/bin/rustc";
const DEBIAN_LINKER: &str = "/usr/bin/ld.lld";
const DEBIAN_CLIPPY: &str = "/usr/bin/clippy-driver";

/// Debian's packages with a compiler that can build `core`, its source, a linker, and the lints.
const DEBIAN_PACKAGES: [&str; 5] = ["rustc-web", "cargo-web", "rust-web-src", "lld", "rust-web-clippy"];

/// A way to build for the chip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Toolchain {
    /// The toolchain that builds everything else, with the target's standard library.
    Rustup,
    /// Debian's, with `core` built from source.
    Debian,
}

impl Toolchain {
    /// The toolchain that is installed.
    pub fn find(shell: &Shell) -> Result<Self> {
        if has_std(shell, TARGET)? {
            return Ok(Toolchain::Rustup);
        }
        let tools = [DEBIAN_CARGO, DEBIAN_RUSTC, DEBIAN_LINKER, DEBIAN_CLIPPY];
        if tools.iter().all(|tool| Path::new(tool).exists()) {
            let library = sysroot(shell, DEBIAN_RUSTC)?.join("lib/rustlib/src/rust/library/core");
            if library.is_dir() {
                return Ok(Toolchain::Debian);
            }
        }
        let debian = DEBIAN_PACKAGES.join(" ");
        bail!(
            "no compiler for {TARGET}; run `rustup target add {TARGET}`, or on Debian `apt-get install {debian}`"
        )
    }

    /// Like [`Self::find`], but on Debian, as root, installs what is missing. If that is not possible, returns what to do.
    pub fn find_or_install(shell: &Shell) -> Result<Result<Self, String>> {
        match Self::find(shell) {
            Ok(toolchain) => Ok(Ok(toolchain)),
            Err(error) if can_install() => {
                eprintln!("{error}; installing Debian's");
                install(shell, &DEBIAN_PACKAGES)?;
                Self::find(shell).map(Ok)
            }
            Err(error) => Ok(Err(error.to_string())),
        }
    }

    /// `cargo SUBCOMMAND` for the chip. What it builds contains no paths of this machine.
    pub fn cargo<'a>(self, shell: &'a Shell, subcommand: &str, target_dir: &Path) -> Result<Cmd<'a>> {
        // Both chips' core: the target alone does not schedule code for it.
        let flags = self.remaps(shell)? + "\x1f-Ctarget-cpu=cortex-m4";
        Ok(self
            .cargo_for(shell, subcommand, TARGET, "core", target_dir)?
            .env("CARGO_ENCODED_RUSTFLAGS", flags))
    }

    /// Compiler flags, in `CARGO_ENCODED_RUSTFLAGS`' form, that replace this machine's directories.
    pub fn remaps(self, shell: &Shell) -> Result<String> {
        remaps(shell, &sysroot(shell, self.rustc())?)
    }

    /// The toolchain that has a standard library for a target, preferably rustup's; `None` if neither has one.
    pub fn with_std(chip: Option<Self>, shell: &Shell, target: &str) -> Result<Option<Self>> {
        if has_std(shell, target)? {
            return Ok(Some(Toolchain::Rustup));
        }
        Ok(chip.filter(|toolchain| *toolchain == Toolchain::Debian))
    }

    /// `cargo SUBCOMMAND` for a target; `parts` are the parts of the standard library to build if there is none.
    pub fn cargo_for<'a>(
        self,
        shell: &'a Shell,
        subcommand: &str,
        target: &str,
        parts: &str,
        target_dir: &Path,
    ) -> Result<Cmd<'a>> {
        let cargo = match self {
            Toolchain::Rustup => "cargo",
            Toolchain::Debian => DEBIAN_CARGO,
        };
        let mut cmd =
            cmd!(shell, "{cargo} {subcommand} --locked --target {target} --target-dir {target_dir}");
        if self == Toolchain::Debian {
            // Unstable only in name: it lets the packaged stable compiler build its own library.
            cmd = cmd
                .arg(format!("-Zbuild-std={parts}"))
                .env("RUSTC", DEBIAN_RUSTC)
                .env("RUSTC_BOOTSTRAP", "1")
                // `cargo clippy` runs the first cargo-clippy on the path, which must belong to the same compiler.
                .env("PATH", debian_first()?)
                .env("CARGO_TARGET_THUMBV7EM_NONE_EABIHF_LINKER", "ld.lld")
                .env_remove("RUSTUP_TOOLCHAIN")
                .env_remove("RUSTC_WRAPPER");
        }
        Ok(cmd)
    }

    /// The argument that selects the features of the standard library if it is built: only those an executable cannot do
    /// without.
    pub const fn std_features(self) -> Option<&'static str> {
        match self {
            Toolchain::Rustup => None,
            Toolchain::Debian => Some("-Zbuild-std-features=panic-unwind"),
        }
    }

    const fn rustc(self) -> &'static str {
        match self {
            Toolchain::Rustup => "rustc",
            Toolchain::Debian => DEBIAN_RUSTC,
        }
    }
}

/// The path, with Debian's programs before all others.
fn debian_first() -> Result<std::ffi::OsString> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    Ok(std::env::join_paths(std::iter::once(PathBuf::from("/usr/bin")).chain(std::env::split_paths(&path)))?)
}

/// Whether packages can be installed here without asking.
pub fn can_install() -> bool {
    let is_root = std::process::Command::new("id").arg("-u").output().is_ok_and(|id| id.stdout == b"0\n");
    is_root && Path::new("/etc/debian_version").exists()
}

/// Whether a program is on the path.
pub fn is_installed(program: &str) -> bool {
    let path = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&path).any(|dir| dir.join(program).is_file())
}

/// Installs Debian packages. Another lane's installation is waited for: apt itself only waits for some of its locks.
pub fn install(shell: &Shell, packages: &[&str]) -> Result<()> {
    let _alone = workspace::only_one("apt")?;
    cmd!(shell, "apt-get -q -o Acquire::Retries=3 update").env("DEBIAN_FRONTEND", "noninteractive").run()?;
    cmd!(shell, "apt-get -q -o Acquire::Retries=3 install -y --no-install-recommends {packages...}")
        .env("DEBIAN_FRONTEND", "noninteractive")
        .run()?;
    Ok(())
}

/// Whether the toolchain that builds everything else has a target's standard library.
fn has_std(shell: &Shell, target: &str) -> Result<bool> {
    Ok(sysroot(shell, "rustc")?.join("lib/rustlib").join(target).join("lib").is_dir())
}

fn sysroot(shell: &Shell, rustc: &str) -> Result<PathBuf> {
    Ok(cmd!(shell, "{rustc} --print sysroot").quiet().read()?.into())
}

/// See [`Toolchain::remaps`].
fn remaps(shell: &Shell, sysroot: &Path) -> Result<String> {
    let home = std::env::var_os("CARGO_HOME")
        .map(PathBuf::from)
        .or_else(|| std::env::home_dir().map(|home| home.join(".cargo")))
        .context("neither CARGO_HOME nor a home directory is known; set CARGO_HOME")?;
    // The compiler takes the last flag that matches, so the most specific ones come last.
    let mut flags = vec![remap(&home, "/cargo")];
    // A registry's directory is named after where it was fetched from, which must not affect the result.
    if let Ok(registries) = shell.read_dir(home.join("registry/src")) {
        flags.extend(registries.iter().map(|registry| remap(registry, "/crates")));
    }
    let library = sysroot.join("lib/rustlib/src/rust");
    if let Ok(library) = library.canonicalize() {
        flags.push(remap(&library, "/rust"));
    }
    flags.push(remap(&library, "/rust"));
    flags.push(remap(&shell.current_dir(), "/cantap"));
    Ok(flags.join("\x1f"))
}

fn remap(from: &Path, to: &str) -> String {
    format!("--remap-path-prefix={}={to}", from.display())
}
