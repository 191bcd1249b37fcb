//! Where clients connect: sockets of this machine.

use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
#[cfg(unix)]
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use cantap_wire::message::Role;

use crate::client::Identity;
use crate::client::admission::Guest;
#[cfg(unix)]
use crate::connect::SOCKET_TIMEOUT;
use crate::connect::prepare;
#[cfg(unix)]
use crate::inherited;
#[cfg(unix)]
use crate::peer;
use crate::places::{NoPlace, Origin, Place, Places, ends, refuse};
#[cfg(unix)]
use crate::socket_file::{self, SocketError, SocketFile};
use crate::{Board, News, writer};

/// How often to check for new connections.
const LOOK_EVERY: Duration = Duration::from_millis(10);

/// Admits clients until it is dropped. Those already admitted stay.
pub struct Listening {
    quit: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    /// To be removed at the end.
    #[cfg(unix)]
    file: Option<SocketFile>,
    address: Option<SocketAddr>,
}

impl Listening {
    /// The address of a TCP socket, with the port chosen by the system.
    pub const fn address(&self) -> Option<SocketAddr> {
        self.address
    }

    pub(crate) fn start(
        name: &str,
        address: Option<SocketAddr>,
        mut accept: impl FnMut() -> io::Result<()> + Send + 'static,
    ) -> io::Result<Self> {
        let quit = Arc::new(AtomicBool::new(false));
        let until = Arc::clone(&quit);
        let thread = std::thread::Builder::new().name(name.to_owned()).spawn(move || {
            while !until.load(Ordering::Relaxed) {
                // Nobody is there, or the client has already gone, or the system has no resources: later it may be
                // different.
                if accept().is_err() {
                    std::thread::sleep(LOOK_EVERY);
                }
            }
        })?;
        Ok(Self {
            quit,
            thread: Some(thread),
            #[cfg(unix)]
            file: None,
            address,
        })
    }
}

impl Drop for Listening {
    fn drop(&mut self) {
        self.quit.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        #[cfg(unix)]
        drop(self.file.take());
    }
}

/// Admits clients of this user on this machine only: nobody else can open the socket at `path`, and the system is asked who each client
/// is. A socket left behind by a server is replaced, and nothing else. If standard input is a socket that listens there, it is taken as it is.
#[cfg(unix)]
pub fn unix(board: &Arc<Board>, path: &Path, role: Role) -> Result<Listening, SocketError> {
    let (listener, file) = if let Some(listener) = inherited::unix(path) {
        (listener, None)
    } else {
        let (listener, file) = socket_file::bind(path)?;
        (listener, Some(file))
    };
    let board = Arc::clone(board);
    let places = Places::new(board.most_clients());
    let mut count = 0;
    let mut listening = Listening::start("cantap-unix", None, move || {
        let (stream, _) = listener.accept()?;
        count += 1;
        let name = format!("local client {count}");
        if let Err(stranger) = peer::check(&stream) {
            board.tell(News::Refused { client: name, reason: stranger.to_string() });
            return Ok(());
        }
        stream.set_nonblocking(false)?;
        stream.set_read_timeout(Some(SOCKET_TIMEOUT))?;
        stream.set_write_timeout(Some(SOCKET_TIMEOUT))?;
        keep_little(&stream)?;
        let ended = stream.try_clone()?;
        let place = places.enter(Origin::HERE, move || drop(ended.shutdown(std::net::Shutdown::Both)));
        let output = stream.try_clone()?;
        let_in(&board, place, stream, output, Arrival { name, role, is_remote: false, identity: None });
        Ok(())
    })?;
    listening.file = file;
    Ok(listening)
}

/// Admits clients, without encryption and authentication: `address` must be one of this machine's own (loopback),
/// which every user of the machine can reach; [`PermissionDenied`](io::ErrorKind::PermissionDenied) for any other.
pub fn tcp(board: &Arc<Board>, address: SocketAddr, role: Role) -> io::Result<Listening> {
    only_loopback(address)?;
    let (listener, address) = bind(address)?;
    let board = Arc::clone(board);
    let places = Places::new(board.most_clients());
    Listening::start("cantap-tcp", Some(address), move || {
        let (stream, peer) = accept(&listener, role)?;
        let name = format!("client {peer}");
        let place = places.enter(Origin::of(&stream, peer), ends(&stream)?);
        let output = stream.try_clone()?;
        // A tunnel may end here.
        let_in(&board, place, stream, output, Arrival { name, role, is_remote: true, identity: None });
        Ok(())
    })
}

/// Tells a client of our own protocol, and whoever runs the server, why it is not served.
pub(crate) fn turn_away(
    board: &Board,
    output: &mut impl Write,
    client: String,
    reason: &impl std::fmt::Display,
) {
    refuse(output, &reason.to_string());
    board.tell(News::Refused { client, reason: reason.to_string() });
}

/// Refuses an address that can be reached from other machines.
pub(crate) fn only_loopback(address: SocketAddr) -> io::Result<()> {
    if address.ip().is_loopback() { Ok(()) } else { Err(io::ErrorKind::PermissionDenied.into()) }
}

/// A socket at an address: the one that the program was started with, if it is there.
pub(crate) fn bind(address: SocketAddr) -> io::Result<(TcpListener, SocketAddr)> {
    #[cfg(unix)]
    let given = inherited::tcp(address);
    #[cfg(not(unix))]
    let given = None;
    let listener = given.map_or_else(|| TcpListener::bind(address), Ok)?;
    listener.set_nonblocking(true)?;
    let address = listener.local_addr()?;
    Ok((listener, address))
}

/// A connection from somebody who may have this role.
pub(crate) fn accept(listener: &TcpListener, role: Role) -> io::Result<(TcpStream, SocketAddr)> {
    let (stream, peer) = listener.accept()?;
    stream.set_nonblocking(false)?;
    prepare(&stream)?;
    #[cfg(unix)]
    keep_little(&stream)?;
    #[cfg(target_os = "linux")]
    notice_absence(&stream, patience(role))?;
    #[cfg(not(target_os = "linux"))]
    let _ = role;
    Ok((stream, peer))
}

/// For how long somebody who may have this role is waited for while nothing shows that it is still there.
pub(crate) const fn patience(role: Role) -> Duration {
    match role {
        Role::Send => writer::SENDER_PATIENCE,
        Role::Listen | Role::Configure => writer::PATIENCE,
    }
}

/// A computer that was switched off, or whose cable was pulled, sends no end of its connections. The system asks for a sign of life a few
/// times in this period, and ends the connection when there is none, also when data for the peer wait for so long.
#[cfg(target_os = "linux")]
fn notice_absence(stream: &TcpStream, patience: Duration) -> io::Result<()> {
    use nix::sys::socket::{setsockopt, sockopt};
    let third = u32::try_from(patience.as_secs()).unwrap_or(u32::MAX).div_ceil(3);
    setsockopt(stream, sockopt::KeepAlive, &true)?;
    setsockopt(stream, sockopt::TcpKeepIdle, &third)?;
    setsockopt(stream, sockopt::TcpKeepInterval, &third)?;
    setsockopt(stream, sockopt::TcpKeepCount, &2)?;
    // A peer that is there and takes nothing is noticed earlier, and with a reason.
    let patience_ms = u32::try_from(patience.as_millis() + 1000).unwrap_or(u32::MAX);
    Ok(setsockopt(stream, sockopt::TcpUserTimeout, &patience_ms)?)
}

/// Data for a client should wait in its outbox, where answers go first and losses are counted, rather than in the system, whose
/// hundreds of kilobytes are seconds of a slow line. Linux doubles this; it is a second of a line that can carry half of two saturated
/// channels.
#[cfg(unix)]
const SYSTEM_KEEPS: usize = 32 * 1024;

/// Sets how much written data the system buffers.
#[cfg(unix)]
fn keep_little(stream: &impl std::os::fd::AsFd) -> io::Result<()> {
    use nix::sys::socket::{setsockopt, sockopt};
    Ok(setsockopt(stream, sockopt::SndBuf, &SYSTEM_KEEPS)?)
}

/// Who has come to a listener.
pub(crate) struct Arrival {
    /// Its name in messages.
    pub name: String,
    /// The most that it may do.
    pub role: Role,
    /// It is at the other end of a line that can break without notice.
    pub is_remote: bool,
    /// Who it is, if it has shown a certificate.
    pub identity: Option<Identity>,
}

/// Admits whoever has come and has got a place; anybody else learns why it is turned away.
pub(crate) fn let_in(
    board: &Board,
    place: Result<Place, NoPlace>,
    input: impl Read + Send + 'static,
    mut output: impl Write + Send + 'static,
    arrival: Arrival,
) {
    let Arrival { name, role, is_remote, identity } = arrival;
    match place {
        Ok(place) => {
            let client = name.clone();
            let guest = Guest { name, role, place: Some(place), is_counted: false, is_remote, identity };
            if let Err(refused) = board.admit_guest(input, output, guest) {
                board.tell(News::Refused { client, reason: refused.to_string() });
            }
        }
        Err(full) => turn_away(board, &mut output, name, &full),
    }
}
