//! Debian's package: the command, its manual pages and completions, the udev rule, and units for a shared board.
//!
//! Assembled by hand and packed by `dpkg-deb`: cargo-deb would be one more program to build, for a handful of files.

use std::path::Path;

use anyhow::{Context, Result, ensure};
use xshell::{Shell, cmd};

use super::archive::{VERSION, staging};
use super::{command, notices};
use crate::toolchain::is_installed;

/// Completions, by shell: where Debian looks for them.
const COMPLETIONS: [(&str, &str); 3] = [
    ("bash", "usr/share/bash-completion/completions/cantap"),
    ("zsh", "usr/share/zsh/vendor-completions/_cantap"),
    ("fish", "usr/share/fish/vendor_completions.d/cantap.fish"),
];

/// Units of systemd: files in `packaging/systemd`, and where systemd looks for them.
const UNITS: [(&str, &str); 3] = [
    ("cantap.socket", "usr/lib/systemd/user"),
    ("cantap.service", "usr/lib/systemd/user"),
    ("cantap-lab.service", "usr/lib/systemd/system"),
];

/// Builds and packs it.
pub fn pack(shell: &Shell, dist: &Path) -> Result<()> {
    ensure!(
        is_installed("dpkg-deb"),
        "dpkg-deb is missing; on Debian it is part of the system, elsewhere install `dpkg`"
    );
    let built = command::build(shell)?;
    let architecture = cmd!(shell, "dpkg --print-architecture").quiet().read()?;
    let root = staging(shell, dist, "deb")?;

    let program = root.join("usr/bin/cantap");
    shell.create_dir(root.join("usr/bin"))?;
    shell.copy_file(&built, &program)?;
    // Debug information is for developers.
    cmd!(shell, "strip --strip-unneeded {program}").run()?;
    let man = root.join("usr/share/man/man1");
    command::man_pages(shell, &built, &man)?;
    for page in shell.read_dir(&man)? {
        cmd!(shell, "gzip -9n {page}").run()?;
    }
    for (which, path) in COMPLETIONS {
        shell.write_file(root.join(path), command::completions(shell, &built, which)?)?;
    }
    let rules = root.join("usr/lib/udev/rules.d");
    shell.create_dir(&rules)?;
    shell.copy_file("packaging/60-cantap.rules", &rules)?;
    for (unit, folder) in UNITS {
        let folder = root.join(folder);
        shell.create_dir(&folder)?;
        shell.copy_file(format!("packaging/systemd/{unit}"), &folder)?;
    }
    let papers = root.join("usr/share/doc/cantap");
    shell.create_dir(&papers)?;
    notices::write(shell, &papers.join("THIRD-PARTY.txt"), &["-p", "cantap-cli"])?;
    shell.write_file(papers.join("copyright"), copyright(&shell.read_file("LICENSE-MIT")?))?;
    let changes = papers.join("changelog");
    shell.copy_file("CHANGELOG.md", &changes)?;
    cmd!(shell, "gzip -9n {changes}").run()?;

    shell.write_file(root.join("DEBIAN/control"), control(shell, &root, &program, &architecture)?)?;
    shell.copy_file("packaging/postinst", root.join("DEBIAN/postinst"))?;
    let script = root.join("DEBIAN/postinst");
    cmd!(shell, "chmod 755 {script} {program}").run()?;
    let package = dist.join(format!("cantap_{VERSION}_{architecture}.deb"));
    cmd!(shell, "dpkg-deb --root-owner-group --build {root} {package}").quiet().run()?;
    println!("{}", package.display());
    Ok(())
}

/// The package's own description. It requires the oldest glibc that has every symbol the program uses.
fn control(shell: &Shell, root: &Path, program: &Path, architecture: &str) -> Result<String> {
    let symbols = cmd!(shell, "objdump -T {program}").quiet().read()?;
    let glibc = newest_glibc(&symbols).context("the program uses no versioned symbol of glibc")?;
    let size = cmd!(shell, "du -sk {root}").quiet().read()?;
    let size = size.split_whitespace().next().context("du says nothing")?;
    Ok(format!(
        "Package: cantap\nVersion: {VERSION}\nArchitecture: {architecture}\nMaintainer: The cantap developers\n\
         Installed-Size: {size}\nDepends: libc6 (>= {}.{}), libgcc-s1\nSuggests: dfu-util\nSection: electronics\nPriority: optional\n\
         Description: capture, decode and drive CAN buses\n \
         The command for cantap boards, which carry all of two CAN buses over USB,\n \
         each frame stamped and each loss counted; and for traces in the usual formats.\n",
        glibc.0, glibc.1
    ))
}

/// Debian's machine-readable form. The Apache licence is on every Debian system; only its location is named.
fn copyright(mit: &str) -> String {
    let lines = mit.trim().lines().map(|line| format!(" {}", if line.is_empty() { "." } else { line }));
    let indented = lines.collect::<Vec<_>>().join("\n");
    format!(
        "Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/\nUpstream-Name: cantap\n\
         Comment: Other people's crates in this program, and their licences, are in THIRD-PARTY.txt.\n\n\
         Files: *\nCopyright: The cantap developers\nLicense: Expat or Apache-2.0\n\n\
         License: Expat\n{indented}\n\n\
         License: Apache-2.0\n The full text is in /usr/share/common-licenses/Apache-2.0.\n"
    )
}

/// The newest version among symbols such as `(GLIBC_2.34)`.
fn newest_glibc(symbols: &str) -> Option<(u32, u32)> {
    let versions = symbols.split("GLIBC_").skip(1).filter_map(|rest| {
        let mut parts = rest.split(|other: char| !other.is_ascii_digit());
        Some((parts.next()?.parse().ok()?, parts.next()?.parse().ok()?))
    });
    versions.max()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_licence_text_has_no_empty_line_in_debian_s_form() {
        let text = copyright("MIT\n\nGranted.\n");
        assert!(text.contains("License: Expat\n MIT\n .\n Granted.\n\nLicense: Apache-2.0\n"), "{text}");
    }

    #[test]
    fn the_newest_symbol_decides_which_glibc_is_needed() {
        let symbols = "w D *UND* (GLIBC_2.9) read\nDF *UND* (GLIBC_2.34) start\nDF *UND* (GLIBC_2.2.5) free";
        assert_eq!(newest_glibc(symbols), Some((2, 34)));
        assert_eq!(newest_glibc(""), None);
    }
}
