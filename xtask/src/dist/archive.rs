//! A release's archives, and where their contents are assembled.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use flate2::Compression;
use flate2::write::GzEncoder;
use xshell::Shell;

/// The version of everything in a release.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");
/// What goes into every archive.
const PAPERS: [&str; 4] = ["README.md", "CHANGELOG.md", "LICENSE-MIT", "LICENSE-APACHE"];

/// Packs a directory's contents and the papers into `DIST/NAME.tar.gz`, under a directory `NAME`.
pub fn archive(shell: &Shell, dist: &Path, name: &str, content: &Path) -> Result<()> {
    for paper in PAPERS {
        shell.copy_file(paper, content)?;
    }
    let path = dist.join(format!("{name}.tar.gz"));
    let mut tar = tar::Builder::new(GzEncoder::new(std::fs::File::create(&path)?, Compression::best()));
    tar.mode(tar::HeaderMode::Deterministic);
    for file in files_under(shell, content)? {
        let inside = Path::new(name).join(file.strip_prefix(content)?);
        tar.append_path_with_name(&file, inside).with_context(|| file.display().to_string())?;
    }
    tar.into_inner()?.finish()?;
    println!("{}", path.display());
    Ok(())
}

/// Every file, in an order that does not depend on the file system.
fn files_under(shell: &Shell, directory: &Path) -> Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for path in shell.read_dir(directory)? {
        if path.is_dir() {
            files.extend(files_under(shell, &path)?);
        } else {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

/// An empty directory in which to assemble a package.
pub fn staging(shell: &Shell, dist: &Path, name: &str) -> Result<PathBuf> {
    let staging = dist.join("staging").join(name);
    shell.remove_path(&staging)?;
    Ok(shell.create_dir(&staging)?)
}
