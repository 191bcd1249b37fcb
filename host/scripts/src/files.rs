//! Files that a user has granted to scripts: those in one folder, to be read, and nothing outside it, whatever a script asks for.

use std::fs::File;
use std::io::{self, Read};
use std::path::{Component, Path, PathBuf};

/// The largest file, in bytes: as large as a script's texts.
const MOST_BYTES: u64 = 1 << 24;

/// A folder that scripts may read, or none.
#[derive(Clone, Debug, Default)]
pub struct GrantedFiles(Option<PathBuf>);

impl GrantedFiles {
    /// Those in this folder and the folders in it.
    pub const fn under(folder: Option<PathBuf>) -> Self {
        Self(folder)
    }

    /// A file's text, by its path in the folder. No link is followed, and nothing but a regular file is opened.
    pub fn read(&self, path: &str) -> Result<String, String> {
        let Some(folder) = &self.0 else {
            return Err(
                "this script may read no files; --allow-read FOLDER grants those in a folder".to_owned()
            );
        };
        let parts = parts(path)?;
        let cannot = |error: io::Error| format!("cannot read {path}: {error}");
        let file = open(folder, &parts).map_err(cannot)?;
        let metadata = file.metadata().map_err(cannot)?;
        if !metadata.is_file() {
            return Err(cannot(not_regular()));
        }
        let mut bytes = Vec::new();
        file.take(MOST_BYTES + 1).read_to_end(&mut bytes).map_err(cannot)?;
        if bytes.len() as u64 > MOST_BYTES {
            return Err(format!("{path} has more than {} MiB", MOST_BYTES >> 20));
        }
        String::from_utf8(bytes).map_err(|_| format!("{path} is not text in UTF-8"))
    }
}

/// The names on the way to a file: only such as lead downwards.
fn parts(path: &str) -> Result<Vec<&str>, String> {
    let refused = |why: &str| Err(format!("{path} is no path in the granted folder: {why}"));
    let mut parts = Vec::new();
    for component in Path::new(path).components() {
        match component {
            Component::Normal(name) => parts.push(name.to_str().unwrap_or_default()),
            Component::CurDir => {}
            Component::ParentDir => return refused(".. leads out of it"),
            Component::RootDir | Component::Prefix(_) => return refused("it begins at the root"),
        }
    }
    if cfg!(windows) && parts.iter().any(|name| is_special_on_windows(name)) {
        return refused("Windows takes a name in it for a device or a stream");
    }
    if parts.is_empty() { refused("it names no file") } else { Ok(parts) }
}

/// Whether Windows takes a file's name, with any suffix, for that of a device, or for that of a stream of a file.
fn is_special_on_windows(name: &str) -> bool {
    const DEVICES: [&str; 6] = ["CON", "PRN", "AUX", "NUL", "CONIN$", "CONOUT$"];
    let stem = name.split('.').next().unwrap_or_default().trim_end().to_ascii_uppercase();
    let is_numbered = ["COM", "LPT"].iter().any(|device| {
        let number = stem.strip_prefix(device).map(|number| number.chars().collect::<Vec<_>>());
        matches!(number.as_deref(), Some(['0'..='9' | '¹' | '²' | '³']))
    });
    name.contains(':') || is_numbered || DEVICES.contains(&stem.as_str())
}

fn not_regular() -> io::Error {
    let what = "it is a link, a pipe, a device, a socket or a folder, and only regular files are granted";
    io::Error::new(io::ErrorKind::InvalidInput, what)
}

/// Folder by folder, each opened in the one before, so that none can be exchanged for a link meanwhile.
#[cfg(unix)]
fn open(folder: &Path, parts: &[&str]) -> io::Result<File> {
    use rustix::fs::{AtFlags, CWD, FileType, Mode, OFlags, openat, statat};

    // Where a folder was expected is a link, or something else.
    let no_folder = |error: rustix::io::Errno| match error {
        rustix::io::Errno::LOOP | rustix::io::Errno::NOTDIR | rustix::io::Errno::MLINK => not_regular(),
        error => error.into(),
    };
    let (name, folders) = parts.split_last().ok_or_else(not_regular)?;
    let flags = OFlags::RDONLY | OFlags::CLOEXEC;
    let mut at = openat(CWD, folder, flags | OFlags::DIRECTORY, Mode::empty())?;
    for part in folders {
        let inner = openat(&at, *part, flags | OFlags::DIRECTORY | OFlags::NOFOLLOW, Mode::empty());
        at = inner.map_err(no_folder)?;
    }
    // To open a device or a pipe may have effects, so it is looked at before. What was opened is looked at again by the caller.
    let found = statat(&at, *name, AtFlags::SYMLINK_NOFOLLOW)?;
    if !FileType::from_raw_mode(found.st_mode).is_file() {
        return Err(not_regular());
    }
    let flags = flags | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::NOCTTY;
    Ok(File::from(openat(&at, *name, flags, Mode::empty()).map_err(no_folder)?))
}

/// Each name on the way is looked at; who can write to the folder could exchange one meanwhile, which no script can.
#[cfg(not(unix))]
fn open(folder: &Path, parts: &[&str]) -> io::Result<File> {
    let mut path = folder.to_owned();
    for (index, part) in parts.iter().enumerate() {
        path.push(part);
        let found = path.symlink_metadata()?;
        let is_last = index + 1 == parts.len();
        if found.is_symlink() || (is_last && !found.is_file()) || (!is_last && !found.is_dir()) {
            return Err(not_regular());
        }
    }
    File::open(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_files_below_the_folder_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let granted = folder.path().join("granted");
        std::fs::create_dir_all(granted.join("deep")).unwrap();
        std::fs::write(folder.path().join("secret"), "no").unwrap();
        std::fs::write(granted.join("deep/a.csv"), "yes").unwrap();
        std::fs::write(granted.join("binary"), [0xFF]).unwrap();
        let files = GrantedFiles::under(Some(granted.clone()));
        assert_eq!(files.read("deep/a.csv").as_deref(), Ok("yes"));
        assert_eq!(files.read("./deep//a.csv").as_deref(), Ok("yes"));
        let secret = folder.path().join("secret").display().to_string();
        for (path, reason) in [
            ("../secret", ".. leads out"),
            ("deep/../../secret", ".. leads out"),
            ("deep/../deep/a.csv", ".. leads out"),
            (secret.as_str(), "begins at the root"),
            ("/etc/passwd", "begins at the root"),
            ("", "names no file"),
            (".", "names no file"),
            ("deep", "only regular files"),
            ("deep/a.csv/b", "only regular files"),
            ("none", "cannot read none"),
            ("binary", "UTF-8"),
            ("a\0b", "cannot read"),
        ] {
            let error = files.read(path).unwrap_err();
            assert!(error.contains(reason), "{path}: {error}");
        }
        assert!(GrantedFiles::default().read("a").unwrap_err().contains("--allow-read"));
    }

    #[cfg(unix)]
    #[test]
    fn links_pipes_devices_and_sockets_are_refused_at_once() {
        use std::os::unix::fs::symlink;

        let folder = tempfile::tempdir().unwrap();
        let granted = folder.path().join("granted");
        std::fs::create_dir_all(granted.join("real")).unwrap();
        std::fs::write(granted.join("real/file"), "yes").unwrap();
        std::fs::write(folder.path().join("secret"), "no").unwrap();
        symlink("../secret", granted.join("link")).unwrap();
        // Also one that stays inside: where a link leads may change.
        symlink("real/file", granted.join("inside")).unwrap();
        symlink("real", granted.join("folder")).unwrap();
        symlink("/dev/zero", granted.join("zero")).unwrap();
        symlink("loop", granted.join("loop")).unwrap();
        assert!(std::process::Command::new("mkfifo").arg(granted.join("pipe")).status().unwrap().success());
        let _socket = std::os::unix::net::UnixListener::bind(granted.join("socket")).unwrap();
        let files = GrantedFiles::under(Some(granted.clone()));
        for path in ["link", "inside", "folder/file", "zero", "loop", "pipe", "socket", "link/passwd"] {
            let error = files.read(path).unwrap_err();
            assert!(error.contains("only regular files"), "{path}: {error}");
        }
        // The folder itself is the user's choice, also if it is a link; devices in it are not files.
        symlink(&granted, folder.path().join("alias")).unwrap();
        let files = GrantedFiles::under(Some(folder.path().join("alias")));
        assert_eq!(files.read("real/file").as_deref(), Ok("yes"));
        let devices = GrantedFiles::under(Some("/dev".into()));
        for device in ["null", "zero"] {
            assert!(devices.read(device).unwrap_err().contains("only regular files"), "{device}");
        }
    }

    #[test]
    fn a_file_larger_than_any_text_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let file = File::create(folder.path().join("large")).unwrap();
        file.set_len(MOST_BYTES + 1).unwrap();
        let files = GrantedFiles::under(Some(folder.path().to_owned()));
        assert!(files.read("large").unwrap_err().contains("more than 16 MiB"));
    }

    #[test]
    fn names_that_windows_takes_for_devices_are_known() {
        for name in ["NUL", "nul.csv", "COM1", "com¹.txt", "aux ", "CONIN$", "a.csv:stream", "lpt9.a.b"] {
            assert!(is_special_on_windows(name), "{name}");
        }
        for name in ["null.csv", "common", "COM10", "lpt.csv", "rows.csv"] {
            assert!(!is_special_on_windows(name), "{name}");
        }
    }
}
