//! The command, and what is generated from its command line.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use xshell::{Shell, cmd};

use super::archive::{VERSION, archive, staging};
use super::notices;
use crate::machine::Machine;
use crate::{web, workspace};

/// Shells, and how each names the file with a command's completions.
const COMPLETIONS: [(&str, &str); 4] =
    [("bash", "cantap"), ("zsh", "_cantap"), ("fish", "cantap.fish"), ("powershell", "_cantap.ps1")];

/// Packs the command for this system.
pub fn pack(shell: &Shell, dist: &Path) -> Result<()> {
    let name = format!("cantap-{VERSION}-{}", cmd!(shell, "rustc --print host-tuple").quiet().read()?);
    let content = staging(shell, dist, &name)?;
    let command = build(shell)?;
    shell.copy_file(&command, &content)?;
    man_pages(shell, &command, &content.join("man"))?;
    for (which, file) in COMPLETIONS {
        let script = completions(shell, &command, which)?;
        shell.write_file(content.join("completions").join(which).join(file), script)?;
    }
    if cfg!(target_os = "linux") {
        shell.copy_file("packaging/60-cantap.rules", &content)?;
    }
    notices::write(shell, &content.join("THIRD-PARTY.txt"), &["-p", "cantap-cli"])?;
    archive(shell, dist, &name, &content)
}

/// Names the page, compressed, for a system on which it is not built.
const BUILT_PAGE: &str = "CANTAP_BUILT_PAGE";

/// Builds the command as released, with the page in it.
pub fn build(shell: &Shell) -> Result<PathBuf> {
    let page = match std::env::var_os(BUILT_PAGE) {
        Some(page) => PathBuf::from(page),
        None => match web::build(&Machine::new()?)? {
            Ok(page) => page.compressed,
            Err(reason) => bail!("{reason}; or name a page that was built elsewhere by {BUILT_PAGE}"),
        },
    };
    cmd!(shell, "cargo build --locked --release -p cantap-cli").env(BUILT_PAGE, page).run()?;
    Ok(workspace::target().join("release").join(format!("cantap{}", std::env::consts::EXE_SUFFIX)))
}

/// Writes the manual pages into a directory, which it creates.
pub fn man_pages(shell: &Shell, command: &Path, directory: &Path) -> Result<()> {
    shell.create_dir(directory)?;
    Ok(cmd!(shell, "{command} man {directory}").quiet().run()?)
}

/// What a shell needs to complete the command line.
pub fn completions(shell: &Shell, command: &Path, which: &str) -> Result<String> {
    Ok(cmd!(shell, "{command} completions {which}").quiet().read()? + "\n")
}
