//! Who is at the other end of a UNIX socket. The mode of a socket's file keeps others out, but not out of a common folder, where a stranger
//! may have made a socket first: so each side asks the system.

use std::io;
use std::os::fd::AsFd;

/// The user at the other end, by number.
#[cfg(any(target_os = "linux", target_os = "android"))]
fn user_of(stream: &impl AsFd) -> io::Result<u32> {
    use nix::sys::socket::{getsockopt, sockopt};
    Ok(getsockopt(stream, sockopt::PeerCredentials)?.uid())
}

/// The user at the other end, by number.
#[cfg(not(any(target_os = "linux", target_os = "android")))]
fn user_of(stream: &impl AsFd) -> io::Result<u32> {
    use nix::sys::socket::{getsockopt, sockopt};
    Ok(getsockopt(stream, sockopt::LocalPeerCred)?.uid())
}

/// Whether one user may be trusted with another's requests and records: the same, or root, who can do anything anyway.
const fn trusts(own: u32, other: u32) -> bool {
    other == own || other == 0
}

/// Checks that the other end is this user or root; [`PermissionDenied`](io::ErrorKind::PermissionDenied) if it is anybody else.
pub fn check(stream: &impl AsFd) -> io::Result<()> {
    let (own, other) = (rustix::process::geteuid().as_raw(), user_of(stream)?);
    if trusts(own, other) {
        return Ok(());
    }
    let reason = format!("user {other} is at the other end, and this is user {own}");
    Err(io::Error::new(io::ErrorKind::PermissionDenied, reason))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn this_user_and_root_are_trusted_and_nobody_else() {
        let (one, _other) = std::os::unix::net::UnixStream::pair().unwrap();
        assert!(check(&one).is_ok());
        assert!(trusts(1000, 1000) && trusts(1000, 0));
        assert!(!trusts(1000, 1001) && !trusts(0, 1000));
    }
}
