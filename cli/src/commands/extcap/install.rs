//! `cantap extcap install`: puts the command where Wireshark looks for such programs.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use anyhow::{Context, bail};

use super::places::Place;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "tshark is asked where it looks (tshark -G folders), and afterwards whether it sees the interfaces (tshark -D).\n\n\
                        Examples:\n  cantap extcap install\n  cantap extcap install --folder ~/.local/lib/wireshark/extcap\n  \
                        cantap extcap install --remove"
)]
pub struct Args {
    /// Remove it again.
    #[arg(long)]
    remove: bool,
    /// Wireshark's folder for such programs, if tshark cannot be asked: Help, About Wireshark, Folders, Personal Extcap path.
    #[arg(long, value_name = "FOLDER")]
    folder: Option<PathBuf>,
}

/// The file that Wireshark starts.
const NAME: &str = if cfg!(windows) { "cantap.bat" } else { "cantap" };
/// The first line of the small program on Windows, where creating links requires a special right.
const MARK: &str = "@rem cantap extcap install wrote this";

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let tshark = tshark();
    let folder = match (&args.folder, &tshark) {
        (Some(folder), _) => folder.clone(),
        (None, Some(tshark)) => ask(tshark)?,
        (None, None) => bail!(
            "Wireshark's folder is unknown, since there is no tshark to query; install it, or name the folder with --folder \
             (in Wireshark: Help, About Wireshark, Folders, Personal Extcap path)"
        ),
    };
    let place = folder.join(NAME);
    let is_there = is_ours(&place)?;
    if args.remove {
        if is_there {
            fs::remove_file(&place).with_context(|| failed(&place))?;
            eprintln!("cantap: '{}' is taken away", place.display());
        } else {
            eprintln!("cantap: it is not installed at '{}'", place.display());
        }
        return Ok(ExitCode::SUCCESS);
    }
    fs::create_dir_all(&folder).with_context(|| failed(&folder))?;
    if is_there {
        fs::remove_file(&place).with_context(|| failed(&place))?;
    }
    put(&place, &program()?).with_context(|| failed(&place))?;
    writeln!(std::io::stdout().lock(), "{}", place.display())?;
    match tshark.as_deref().map(sees) {
        Some(Some(false)) => bail!(
            "it is at '{}', but tshark does not show it there; compare with Help, About Wireshark, Folders, Personal Extcap path",
            place.display()
        ),
        Some(Some(true)) => {
            eprintln!(
                "cantap: tshark shows the interfaces; Wireshark does after a restart, or F5. `tshark -i {}` tries it",
                Place::Virtual.name()
            );
        }
        // It is not there, or may not capture, which it needs for its list.
        Some(None) | None => eprintln!("cantap: Wireshark shows the interfaces after a restart, or F5"),
    }
    Ok(ExitCode::SUCCESS)
}

fn failed(path: &Path) -> String {
    format!("cannot change '{}'; name a folder that you may write with --folder", path.display())
}

/// Where tshark is: on the path, or where Wireshark's installers put it.
fn tshark() -> Option<PathBuf> {
    let mut places = vec![PathBuf::from("tshark")];
    if cfg!(target_os = "macos") {
        places.push("/Applications/Wireshark.app/Contents/MacOS/tshark".into());
    }
    if cfg!(windows) {
        let programs = ["ProgramFiles", "ProgramFiles(x86)"].into_iter().filter_map(std::env::var_os);
        places.extend(programs.map(|programs| Path::new(&programs).join("Wireshark").join("tshark.exe")));
    }
    places.into_iter().find(|tshark| {
        Command::new(tshark).arg("--version").output().is_ok_and(|output| output.status.success())
    })
}

/// Asks tshark for the folder.
fn ask(tshark: &Path) -> anyhow::Result<PathBuf> {
    let output = Command::new(tshark).args(["-G", "folders"]).output();
    let output = output.with_context(|| format!("'{}' does not start", tshark.display()))?;
    let text = String::from_utf8_lossy(&output.stdout);
    personal_folder(&text).with_context(|| {
        format!("'{} -G folders' names no folder for such programs; name it with --folder", tshark.display())
    })
}

/// The user's own folder in the output of `tshark -G folders`. Before 4.2 it was inside the configuration folder, and
/// not printed.
fn personal_folder(text: &str) -> Option<PathBuf> {
    let value = |name: &str| {
        let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'))?;
        Some(line.trim()).filter(|value| !value.is_empty()).map(PathBuf::from)
    };
    value("Personal Extcap path").or_else(|| Some(value("Personal configuration")?.join("extcap")))
}

/// Whether tshark lists the interfaces; `None` if it lists none at all.
fn sees(tshark: &Path) -> Option<bool> {
    let output = Command::new(tshark).arg("-D").output().ok()?;
    let text = String::from_utf8_lossy(&output.stdout);
    (!text.trim().is_empty()).then(|| text.contains(Place::Virtual.name()))
}

/// Whether the existing file is ours; an error if it is somebody else's.
fn is_ours(place: &Path) -> anyhow::Result<bool> {
    let Ok(there) = place.symlink_metadata() else { return Ok(false) };
    let is_ours = there.is_symlink() || fs::read_to_string(place).is_ok_and(|text| text.starts_with(MARK));
    anyhow::ensure!(
        is_ours,
        "'{}' is there and is neither a link nor from here; move it away and try again",
        place.display()
    );
    Ok(true)
}

/// This program's path: through a name on the path that stays valid when a package manager replaces the program behind
/// it.
fn program() -> anyhow::Result<PathBuf> {
    let this = std::env::current_exe().context("the system does not say where this program is")?;
    let real = fs::canonicalize(&this).unwrap_or_else(|_| this.clone());
    let path = std::env::var_os("PATH").unwrap_or_default();
    let named = this.file_name().unwrap_or_default();
    let same = std::env::split_paths(&path)
        .map(|folder| folder.join(named))
        .find(|other| other.is_absolute() && fs::canonicalize(other).is_ok_and(|other| other == real));
    Ok(same.unwrap_or(this))
}

#[cfg(unix)]
fn put(place: &Path, program: &Path) -> std::io::Result<()> {
    std::os::unix::fs::symlink(program, place)
}

#[cfg(not(unix))]
fn put(place: &Path, program: &Path) -> std::io::Result<()> {
    fs::write(place, batch(program))
}

/// The program's path for a Windows batch file, in which per cent signs are doubled.
#[cfg(any(not(unix), test))]
fn batch(program: &Path) -> String {
    let program = program.display().to_string().replace('%', "%%");
    format!("{MARK}\r\n@\"{program}\" extcap %*\r\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As printed by 4.0 and 4.2.
    #[test]
    fn the_personal_folder_is_the_one_that_this_tshark_looks_in() {
        let old = "Temp:                \t/tmp\nPersonal configuration:\t/home/me/.config/wireshark\n\
                   Extcap path:         \t/usr/lib/x86_64-linux-gnu/wireshark/extcap\n";
        assert_eq!(personal_folder(old), Some("/home/me/.config/wireshark/extcap".into()));
        let new = "Personal configuration:\t/home/me/.config/wireshark\nPersonal Plugins:\t/home/me/x\n\
                   Personal Extcap path:\t/home/me/.local/lib/wireshark/extcap\nGlobal Extcap path:\t/usr/lib/wireshark/extcap\n";
        assert_eq!(personal_folder(new), Some("/home/me/.local/lib/wireshark/extcap".into()));
        let windows = "Personal Extcap path:\tC:\\Users\\me\\AppData\\Roaming\\Wireshark\\extcap\r\n";
        let expected = "C:\\Users\\me\\AppData\\Roaming\\Wireshark\\extcap";
        assert_eq!(personal_folder(windows), Some(expected.into()));
        assert_eq!(personal_folder("Usage: tshark\n"), None);
    }

    #[test]
    fn what_stands_there_on_windows_is_known_again() {
        let text = batch(Path::new(r"C:\100% mine\cantap.exe"));
        assert!(text.starts_with(MARK));
        assert!(text.ends_with("@\"C:\\100%% mine\\cantap.exe\" extcap %*\r\n"), "{text}");
    }

    #[test]
    fn what_somebody_else_put_there_stays() {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().join(NAME);
        assert!(!is_ours(&place).unwrap());
        fs::write(&place, "#!/bin/sh\n").unwrap();
        assert!(is_ours(&place).unwrap_err().to_string().contains("move it away"));
        fs::write(&place, batch(Path::new("x"))).unwrap();
        assert!(is_ours(&place).unwrap());
    }
}
