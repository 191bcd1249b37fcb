//! The file of a UNIX socket: made, replaced if a server left it behind, and removed at the end, without ever touching anything else.
//!
//! A path that a user typed may name anything: a log, a link, another server's socket. Only a socket of this user on which nobody listens is
//! replaced, and a server that ends removes its own socket only. What is to be removed is first renamed and then looked at again, so that
//! nothing that was put there in between is deleted. Servers that want the same path at the same time take turns by a lock on the folder.

use std::ffi::OsString;
use std::fs::{File, Metadata};
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::{DirBuilderExt, FileTypeExt, MetadataExt};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use nix::sys::socket::{AddressFamily, SockFlag, SockType, UnixAddr, connect, socket};
use rustix::fs::{FlockOperation, flock};

/// How long to wait for another server that is at the same folder: it needs milliseconds.
const TURN_TIMEOUT: Duration = Duration::from_secs(2);
/// How often to try.
const TRY_EVERY: Duration = Duration::from_millis(5);

/// Why a socket was not made.
#[derive(Debug, thiserror::Error)]
pub enum SocketError {
    /// A server listens on it, or somebody else who is about to.
    #[error("another server is there already")]
    InUse,
    /// There is something that no server left behind.
    #[error("there is {0}, which is left as it is")]
    Foreign(&'static str),
    /// The folder for it can be changed by others.
    #[error("'{}' {why}", folder.display())]
    Folder {
        /// The folder.
        folder: PathBuf,
        /// What is wrong with it.
        why: &'static str,
    },
    /// The system refused it.
    #[error(transparent)]
    Io(#[from] io::Error),
}

/// A socket that listens, and its file.
pub struct SocketFile {
    path: PathBuf,
    identity: Identity,
    /// Open until the file is removed: until then the system gives its number to no other file.
    _listener: UnixListener,
}

/// What distinguishes a file from all others that exist at the same time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Identity {
    device: u64,
    file: u64,
}

impl Identity {
    fn of(there: &Metadata) -> Self {
        Self { device: there.dev(), file: there.ino() }
    }
}

/// Makes a socket that only this user can reach, and listens on it. The listener does not block.
pub fn bind(path: &Path) -> Result<(UnixListener, SocketFile), SocketError> {
    // The system would take no name for a socket without a file, which every user of the machine can reach.
    if path.as_os_str().is_empty() {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "the path is empty").into());
    }
    let _turn = Turn::at(path)?;
    if let Some(there) = look(path)? {
        let identity = abandoned(path, &there)?;
        remove(path, identity)?;
    }
    // This must apply from the beginning: setting the mode afterwards would be too late.
    let before = rustix::process::umask(rustix::fs::Mode::from_raw_mode(0o177));
    let bound = UnixListener::bind(path);
    rustix::process::umask(before);
    let listener = bound.map_err(|error| match error.kind() {
        io::ErrorKind::AddrInUse => SocketError::InUse,
        _ => error.into(),
    })?;
    listener.set_nonblocking(true)?;
    let kept = listener.try_clone()?;
    let identity = Identity::of(&std::fs::symlink_metadata(path)?);
    Ok((listener, SocketFile { path: path.to_owned(), identity, _listener: kept }))
}

/// Makes the folder for a socket of this user, if there is none, and checks that nobody else can put anything there.
pub fn private_folder(folder: &Path) -> Result<(), SocketError> {
    match std::fs::DirBuilder::new().mode(0o700).create(folder) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => return Err(error.into()),
        _ => {}
    }
    let there = std::fs::symlink_metadata(folder)?;
    let why = if !there.is_dir() {
        "is not a folder; remove it"
    } else if there.uid() != rustix::process::geteuid().as_raw() {
        "belongs to another user"
    } else if there.mode() & 0o077 != 0 {
        "can be used by other users; `chmod 700` it"
    } else {
        return Ok(());
    };
    Err(SocketError::Folder { folder: folder.to_owned(), why })
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        // Without a turn, too: a file that is not ours is put back.
        let _turn = Turn::at(&self.path);
        if let Ok(Some(there)) = look(&self.path)
            && Identity::of(&there) == self.identity
        {
            // If it cannot be removed, the next server replaces it.
            let _ = remove(&self.path, self.identity);
        }
    }
}

/// What is at a path, without following a link; `None` if there is nothing.
fn look(path: &Path) -> io::Result<Option<Metadata>> {
    match std::fs::symlink_metadata(path) {
        Ok(there) => Ok(Some(there)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
    }
}

/// Whether what is there is a socket that an earlier server of this user has left behind.
fn abandoned(path: &Path, there: &Metadata) -> Result<Identity, SocketError> {
    let kind = there.file_type();
    if !kind.is_socket() {
        return Err(SocketError::Foreign(match kind {
            kind if kind.is_symlink() => "a link",
            kind if kind.is_dir() => "a folder",
            kind if kind.is_fifo() => "a named pipe",
            kind if kind.is_file() => "a file",
            _ => "a device",
        }));
    }
    if there.uid() != rustix::process::geteuid().as_raw() {
        return Err(SocketError::Foreign("another user's socket"));
    }
    // A server that is stopped accepts nobody, and is there nevertheless: so do not wait for it.
    let probe: OwnedFd =
        socket(AddressFamily::Unix, SockType::Stream, SockFlag::empty(), None).map_err(io::Error::from)?;
    let probe = UnixStream::from(probe);
    probe.set_nonblocking(true)?;
    let address = UnixAddr::new(path).map_err(io::Error::from)?;
    match connect(std::os::fd::AsRawFd::as_raw_fd(&probe), &address) {
        Err(nix::errno::Errno::ECONNREFUSED) => Ok(Identity::of(there)),
        // One for datagrams is no server's of ours.
        Err(nix::errno::Errno::EPROTOTYPE) => Err(SocketError::Foreign("a socket of another kind")),
        _ => Err(SocketError::InUse),
    }
}

/// Removes the file at a path if it is this one. Anything else that was put there meanwhile stays, or is put back.
fn remove(path: &Path, identity: Identity) -> Result<(), SocketError> {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    let number = NEXT.fetch_add(1, Ordering::Relaxed);
    let mut name = OsString::from(".");
    name.push(path.file_name().unwrap_or_default());
    name.push(format!(".{}-{number}", std::process::id()));
    let aside = path.with_file_name(name);
    if look(&aside)?.is_some() {
        return Err(SocketError::InUse);
    }
    std::fs::rename(path, &aside)?;
    let there = std::fs::symlink_metadata(&aside)?;
    if Identity::of(&there) == identity && there.file_type().is_socket() {
        return Ok(std::fs::remove_file(&aside)?);
    }
    // A second name does not overwrite what may have come to the path by now. Folders have only one.
    if std::fs::hard_link(&aside, path).is_ok() {
        let _ = std::fs::remove_file(&aside);
    } else if look(path)?.is_none() {
        std::fs::rename(&aside, path)?;
    }
    Err(SocketError::InUse)
}

/// A lock on a socket's folder, which leaves no file behind. Servers hold it while they make or remove a socket. There is none in a folder
/// that may not be read.
struct Turn(#[expect(dead_code, reason = "closing it ends the lock")] Option<File>);

impl Turn {
    fn at(path: &Path) -> Result<Self, SocketError> {
        let folder = match path.parent() {
            Some(folder) if !folder.as_os_str().is_empty() => folder,
            _ => Path::new("."),
        };
        let folder = match File::open(folder) {
            Err(error) if error.kind() == io::ErrorKind::PermissionDenied => return Ok(Self(None)),
            folder => folder?,
        };
        let deadline = Instant::now() + TURN_TIMEOUT;
        loop {
            match flock(&folder, FlockOperation::NonBlockingLockExclusive) {
                Err(rustix::io::Errno::WOULDBLOCK | rustix::io::Errno::INTR) if Instant::now() < deadline => {
                    std::thread::sleep(TRY_EVERY);
                }
                Err(rustix::io::Errno::WOULDBLOCK | rustix::io::Errno::INTR) => {
                    return Err(SocketError::InUse);
                }
                // There are file systems without locks.
                Ok(()) | Err(_) => return Ok(Self(Some(folder))),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::net::UnixDatagram;

    fn refused(path: &Path) -> String {
        bind(path).err().expect("refused").to_string()
    }

    #[test]
    fn only_an_abandoned_socket_is_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("notes.txt"), "mine").unwrap();
        std::os::unix::fs::symlink(at("notes.txt"), at("link")).unwrap();
        std::os::unix::fs::symlink(at("nowhere"), at("dangling")).unwrap();
        std::fs::create_dir(at("folder")).unwrap();
        assert!(std::process::Command::new("mkfifo").arg(at("fifo")).status().unwrap().success());
        let _datagram = UnixDatagram::bind(at("datagram")).unwrap();
        for (name, what) in [
            ("notes.txt", "there is a file, which is left as it is"),
            ("link", "there is a link, which is left as it is"),
            ("dangling", "there is a link, which is left as it is"),
            ("folder", "there is a folder, which is left as it is"),
            ("fifo", "there is a named pipe, which is left as it is"),
            ("datagram", "there is a socket of another kind, which is left as it is"),
            ("", "the path is empty"),
        ] {
            let path = if name.is_empty() { PathBuf::new() } else { at(name) };
            assert_eq!(refused(&path), what, "{name}");
        }
        assert_eq!(std::fs::read_to_string(at("link")).unwrap(), "mine");
        // Left behind, also behind a link's folder.
        drop(UnixListener::bind(at("old")).unwrap());
        let (_listener, file) = bind(&at("old")).unwrap();
        assert_eq!(refused(&at("old")), "another server is there already");
        drop(file);
        assert!(look(&at("old")).unwrap().is_none());
    }

    /// A server that accepts nobody, and whose queue is full, is there nevertheless.
    #[test]
    fn a_server_that_hangs_is_not_replaced_and_not_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.sock");
        let _stopped = UnixListener::bind(&path).unwrap();
        let mut waiting = Vec::new();
        // Until its queue is full.
        for _ in 0..10_000 {
            let one = UnixStream::from(
                socket(AddressFamily::Unix, SockType::Stream, SockFlag::empty(), None).unwrap(),
            );
            one.set_nonblocking(true).unwrap();
            let full =
                connect(std::os::fd::AsRawFd::as_raw_fd(&one), &UnixAddr::new(&path).unwrap()).is_err();
            waiting.push(one);
            if full {
                break;
            }
        }
        assert_eq!(refused(&path), "another server is there already");
    }

    #[test]
    fn a_server_that_ends_leaves_what_came_in_place_of_its_socket() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.sock");
        let (_listener, file) = bind(&path).unwrap();
        std::fs::remove_file(&path).unwrap();
        let (_other, others) = bind(&path).unwrap();
        drop(file);
        assert_eq!(refused(&path), "another server is there already");
        std::fs::remove_file(&path).unwrap();
        std::fs::write(&path, "mine").unwrap();
        drop(others);
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "mine");
    }

    /// What is removed is the file that was looked at, and no other.
    #[test]
    fn what_came_between_looking_and_removing_is_put_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.sock");
        drop(UnixListener::bind(&path).unwrap());
        let identity = Identity::of(&look(&path).unwrap().unwrap());
        // Its number may be given to the next file once it is gone, so keep it.
        std::fs::rename(&path, folder.path().join("kept")).unwrap();
        std::fs::write(&path, "mine").unwrap();
        assert!(remove(&path, identity).is_err());
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "mine");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2);
    }

    /// Of servers that start at the same time on a socket left behind, one gets it.
    #[test]
    fn one_of_many_servers_gets_a_path() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.sock");
        for _ in 0..20 {
            drop(UnixListener::bind(&path).unwrap());
            let got: Vec<_> = std::thread::scope(|scope| {
                let all: Vec<_> = (0..8).map(|_| scope.spawn(|| bind(&path))).collect();
                all.into_iter().map(|one| one.join().unwrap()).filter_map(Result::ok).collect()
            });
            assert_eq!(got.len(), 1);
            assert!(UnixStream::connect(&path).is_ok());
            drop(got);
            assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        }
    }

    #[test]
    fn a_private_folder_is_this_user_s_alone() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        private_folder(&at("new")).unwrap();
        assert_eq!(std::fs::metadata(at("new")).unwrap().mode() & 0o777, 0o700);
        private_folder(&at("new")).unwrap();
        std::os::unix::fs::symlink(at("new"), at("link")).unwrap();
        assert!(private_folder(&at("link")).unwrap_err().to_string().ends_with("is not a folder; remove it"));
        let open = std::os::unix::fs::PermissionsExt::from_mode(0o770);
        std::fs::set_permissions(at("new"), open).unwrap();
        assert!(private_folder(&at("new")).unwrap_err().to_string().ends_with("`chmod 700` it"));
    }
}
