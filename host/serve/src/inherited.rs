//! A listening socket that a program is started with, as its standard input: systemd's `StandardInput=socket`, inetd's "wait". Whoever starts the
//! program can then listen where the program itself may not, and before it is there.

use std::io;
use std::net::{SocketAddr, TcpListener};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixListener;
use std::path::Path;

use nix::sys::socket::{getsockopt, sockopt};

/// Standard input, if it is a socket that listens.
fn standard_input() -> Option<OwnedFd> {
    let input = io::stdin().as_fd().try_clone_to_owned().ok()?;
    getsockopt(&input, sockopt::AcceptConn).ok()?.then_some(input)
}

/// The TCP socket that is standard input, if it listens at this address.
pub fn tcp(address: SocketAddr) -> Option<TcpListener> {
    let listener = TcpListener::from(standard_input()?);
    listener.local_addr().is_ok_and(|there| there == address).then_some(listener)
}

/// The UNIX socket that is standard input, if it listens at this path. Its file belongs to whoever made it.
pub fn unix(path: &Path) -> Option<UnixListener> {
    let listener = UnixListener::from(standard_input()?);
    let is_there = listener.local_addr().is_ok_and(|there| there.as_pathname() == Some(path));
    (is_there && listener.set_nonblocking(true).is_ok()).then_some(listener)
}
