//! Reads the files that whoever runs a server names: certificates, keys, permissions. Anything but a regular file of a limited size is refused. A
//! pipe would keep the server waiting for as long as nobody writes to it, also at each hang-up, and some devices never end.

use std::fs::{File, OpenOptions};
use std::io::{self, Read};
use std::path::Path;

/// The largest file, in bytes.
const MOST_BYTES: u64 = 1 << 20;

/// A whole file.
pub fn read(path: &Path) -> io::Result<Vec<u8>> {
    let file = open(path, OpenOptions::new().read(true))?;
    let mut bytes = Vec::new();
    file.take(MOST_BYTES + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > MOST_BYTES {
        return Err(bad(format!("it has more than {MOST_BYTES} bytes")));
    }
    Ok(bytes)
}

/// The same as text.
pub fn read_text(path: &Path) -> io::Result<String> {
    String::from_utf8(read(path)?).map_err(|_| bad("it is not text in UTF-8".to_owned()))
}

/// Opens a regular file without waiting, whatever it is.
fn open(path: &Path, options: &mut OpenOptions) -> io::Result<File> {
    open_as(path, options, true)
}

/// The same, unless it is a link.
pub fn open_itself(path: &Path, options: &mut OpenOptions) -> io::Result<File> {
    open_as(path, options, false)
        .map_err(|error| if path.is_symlink() { bad("a link has taken its place".to_owned()) } else { error })
}

fn open_as(path: &Path, options: &mut OpenOptions, follows: bool) -> io::Result<File> {
    #[cfg(unix)]
    {
        use rustix::fs::OFlags;
        use std::os::unix::fs::OpenOptionsExt;
        // A pipe that nobody writes to is opened at once, and one that nobody reads is an error.
        let flags = OFlags::NONBLOCK | OFlags::NOCTTY;
        let flags = if follows { flags } else { flags | OFlags::NOFOLLOW };
        options.custom_flags(flags.bits().cast_signed());
    }
    #[cfg(not(unix))]
    let _ = follows;
    // The file that was opened is looked at, since another may be at its path meanwhile.
    match options.open(path) {
        Ok(file) if file.metadata()?.is_file() => Ok(file),
        Ok(_) => Err(not_regular()),
        Err(_) if path.metadata().is_ok_and(|there| !there.is_file()) => Err(not_regular()),
        Err(error) => Err(error),
    }
}

fn not_regular() -> io::Error {
    bad("it is a pipe, a device, a socket or a folder; give a regular file".to_owned())
}

fn bad(reason: String) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidInput, reason)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_regular_file_is_read_up_to_its_limit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        std::fs::write(&path, "text").unwrap();
        assert_eq!(read_text(&path).unwrap(), "text");
        std::fs::write(&path, vec![b'x'; MOST_BYTES as usize]).unwrap();
        assert_eq!(read(&path).unwrap().len() as u64, MOST_BYTES);
        std::fs::write(&path, vec![b'x'; MOST_BYTES as usize + 1]).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("more than 1048576 bytes"));
        std::fs::write(&path, [0xFF]).unwrap();
        assert!(read_text(&path).unwrap_err().to_string().contains("UTF-8"));
        assert_eq!(read(&folder.path().join("none")).unwrap_err().kind(), io::ErrorKind::NotFound);
    }

    /// Each of them would keep a reader or a writer for ever.
    #[cfg(unix)]
    #[test]
    fn what_is_no_regular_file_is_refused_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        rustix::fs::mknodat(
            rustix::fs::CWD,
            &pipe,
            rustix::fs::FileType::Fifo,
            rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR,
            0,
        )
        .unwrap();
        let socket = folder.path().join("socket");
        let _listener = std::os::unix::net::UnixListener::bind(&socket).unwrap();
        for path in [&pipe, Path::new("/dev/zero"), folder.path(), &socket] {
            for options in [OpenOptions::new().read(true), OpenOptions::new().append(true)] {
                let error = open(path, options).unwrap_err().to_string();
                assert!(error.contains("give a regular file"), "{}: {error}", path.display());
            }
        }
    }
}
