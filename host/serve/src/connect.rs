//! Links to a server, from which a client makes a device.

use std::io::{self, Read};
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
#[cfg(unix)]
use std::os::unix::net::UnixStream;
#[cfg(unix)]
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use cantap::device::{Link, pipe};

use crate::flow::acknowledging;

/// A read or write on a socket returns after this time at the latest.
pub(crate) const SOCKET_TIMEOUT: Duration = Duration::from_millis(50);
/// Time limit for connecting to a computer.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit for a server that a program starts on another computer: ssh has to get there, and the server has to greet the
/// board.
const START_TIMEOUT: Duration = Duration::from_secs(30);
/// What such a server sends first, when it is ready: the end of no message.
pub const READY: [u8; 1] = [0];
/// Maximum number of bytes of a program's output that wait.
const PIPE_BYTES: usize = 256 * 1024;

/// The folder of a server's socket, if no path is given: the user's runtime folder, if the system has one; else one of the user's own in the
/// common folder for temporary files, where a stranger may have made it first: see [`private_folder`](crate::socket_file::private_folder).
#[cfg(unix)]
pub fn default_folder() -> PathBuf {
    use std::os::unix::fs::MetadataExt;
    let own = rustix::process::geteuid().as_raw();
    // After `sudo`, it may be another user's.
    let is_own = |folder: &PathBuf| folder.metadata().is_ok_and(|there| there.uid() == own);
    let runtime = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from);
    runtime
        .filter(|folder| folder.is_absolute() && is_own(folder))
        .unwrap_or_else(|| std::env::temp_dir().join(format!("cantap-{own}")))
}

/// The default path of a server's socket.
#[cfg(unix)]
pub fn default_socket() -> PathBuf {
    default_folder().join("cantap.sock")
}

/// Connects to a server on this machine, which must be run by this user or by root;
/// [`PermissionDenied`](io::ErrorKind::PermissionDenied) if it is somebody else's.
#[cfg(unix)]
pub fn unix(path: &Path) -> io::Result<Link> {
    let reader = UnixStream::connect(path)?;
    crate::peer::check(&reader)?;
    reader.set_read_timeout(Some(SOCKET_TIMEOUT))?;
    reader.set_write_timeout(Some(SOCKET_TIMEOUT))?;
    let writer = reader.try_clone()?;
    Ok(acknowledging(Link::new(reader, writer)))
}

/// Connects to a server at `HOST:PORT`, without encryption.
pub fn tcp(address: &str) -> io::Result<Link> {
    let reader = dial(address)?;
    let writer = reader.try_clone()?;
    Ok(acknowledging(Link::new(reader, writer)))
}

/// A socket that returns within a fraction of a second.
pub(crate) fn dial(address: &str) -> io::Result<TcpStream> {
    let mut failed = io::Error::new(io::ErrorKind::NotFound, "the name has no address");
    for address in resolve(address)? {
        match TcpStream::connect_timeout(&address, CONNECT_TIMEOUT) {
            Ok(stream) => {
                prepare(&stream)?;
                return Ok(stream);
            }
            Err(error) => failed = error,
        }
    }
    Err(failed)
}

/// The addresses of `HOST:PORT`. The standard library takes no zone in brackets, as in `[fe80::1%eth0]:29537`, but the system does without
/// them.
fn resolve(address: &str) -> io::Result<Vec<SocketAddr>> {
    let in_brackets = address.strip_prefix('[').and_then(|rest| rest.rsplit_once("]:"));
    let with_zone = in_brackets.filter(|(host, _)| host.contains('%'));
    Ok(match with_zone.and_then(|(host, port)| Some((host, port.parse::<u16>().ok()?))) {
        Some(with_zone) => with_zone.to_socket_addrs()?.collect(),
        None => address.to_socket_addrs()?.collect(),
    })
}

pub(crate) fn prepare(stream: &TcpStream) -> io::Result<()> {
    stream.set_read_timeout(Some(SOCKET_TIMEOUT))?;
    stream.set_write_timeout(Some(SOCKET_TIMEOUT))?;
    // An answer is a small packet that somebody is waiting for.
    stream.set_nodelay(true)
}

/// Connects to a program that is a server, through its standard input and output, once it has sent [`READY`]. The user sees its standard
/// error. It ends with the link. If it has ended, the link is closed.
pub fn program(command: &mut Command) -> io::Result<Link> {
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
    let (Some(writer), Some(mut output)) = (child.stdin.take(), child.stdout.take()) else {
        return Err(io::ErrorKind::BrokenPipe.into());
    };
    let child = Running(child);
    // Its output can only be waited for without a time limit.
    let (reader, mut to_reader) = pipe(PIPE_BYTES);
    std::thread::Builder::new().name("cantap-program".to_owned()).spawn(move || {
        let mut bytes = vec![0; 64 * 1024];
        while let Ok(len @ 1..) = output.read(&mut bytes) {
            let patience = Duration::MAX;
            if cantap::device::write_patiently(&mut to_reader, &bytes[..len], patience).is_err() {
                return;
            }
        }
    })?;
    if !reader.wait_for_bytes(START_TIMEOUT) && !reader.is_closed() {
        return Err(io::Error::new(io::ErrorKind::TimedOut, "it is not ready after 30 s"));
    }
    Ok(acknowledging(Link::new(reader, writer).keeping(child)))
}

/// A program that ends when nobody needs it any more.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // It ends on its own when its input does, unless something delays it.
        for _ in 0..20 {
            if matches!(self.0.try_wait(), Ok(Some(_)) | Err(_)) {
                return;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
