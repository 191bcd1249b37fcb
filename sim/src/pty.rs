//! A pseudo-terminal in place of the device's serial port, so that any program that opens a serial
//! port can use the emulated device.

use std::io;
use std::os::fd::OwnedFd;
use std::sync::atomic::{AtomicBool, Ordering};

use rustix::fs::OFlags;
use rustix::io::Errno;
use rustix::termios::OptionalActions;
use rustix_openpty::openpty;

/// Most bytes that one exchange moves.
const PIECE: usize = 4096;

/// The device's end of a pseudo-terminal.
#[derive(Debug)]
pub struct Pty {
    controller: OwnedFd,
    name: String,
    /// Whether a client had it open when it was last read.
    has_client: AtomicBool,
}

impl Pty {
    /// Opens one, in raw mode before its name is known: a cooked terminal would change bytes and
    /// echo them.
    pub fn open() -> io::Result<Self> {
        let pair = openpty(None, None)?;
        let mut settings = rustix::termios::tcgetattr(&pair.user)?;
        settings.make_raw();
        rustix::termios::tcsetattr(&pair.user, OptionalActions::Now, &settings)?;
        let path = rustix::termios::ttyname(&pair.user, Vec::new())?;
        let status = rustix::fs::fcntl_getfl(&pair.controller)?;
        rustix::fs::fcntl_setfl(&pair.controller, status | OFlags::NONBLOCK)?;
        let name = path.into_string().map_err(|_| io::Error::other("the terminal's name is not text"))?;
        // While no other end is open, reading reports it; this shows when the last client has closed. The settings
        // stay.
        drop(pair.user);
        Ok(Self { controller: pair.controller, name, has_client: AtomicBool::new(false) })
    }

    /// The name that clients open.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Takes what clients have written, without waiting.
    pub fn read(&self) -> io::Result<Vec<u8>> {
        let mut bytes = vec![0; PIECE];
        let read = rustix::io::read(&self.controller, &mut bytes[..]);
        self.has_client.store(read != Err(Errno::IO), Ordering::Relaxed);
        let len = or_nothing(read)?;
        bytes.truncate(len);
        Ok(bytes)
    }

    /// Whether a client had the terminal open when it was last read.
    pub fn has_client(&self) -> bool {
        self.has_client.load(Ordering::Relaxed)
    }

    /// Writes as much as the terminal takes and returns how much that was.
    pub fn write(&self, bytes: &[u8]) -> io::Result<usize> {
        or_nothing(rustix::io::write(&self.controller, &bytes[..bytes.len().min(PIECE)]))
    }
}

/// A terminal that is not ready, or that nobody has open, moved nothing.
fn or_nothing(result: Result<usize, Errno>) -> io::Result<usize> {
    match result {
        Ok(len) => Ok(len),
        Err(Errno::AGAIN | Errno::INTR | Errno::IO) => Ok(0),
        Err(error) => Err(error.into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;
    use std::io::{Read, Write};

    #[test]
    fn bytes_pass_unchanged_and_each_client_is_seen_to_come_and_go() {
        let pty = Pty::open().unwrap();
        let all: Vec<u8> = (0..=255).collect();
        for _ in 0..2 {
            let mut client = File::options().read(true).write(true).open(pty.name()).unwrap();
            assert_eq!((pty.read().unwrap(), pty.has_client()), (vec![], true));
            assert_eq!(pty.write(&all).unwrap(), all.len());
            let mut read = vec![0; all.len()];
            client.read_exact(&mut read).unwrap();
            assert_eq!(read, all);
            client.write_all(&all).unwrap();
            let mut got = Vec::new();
            while got.len() < all.len() {
                got.extend(pty.read().unwrap());
            }
            assert_eq!(got, all);
            drop(client);
            assert_eq!((pty.read().unwrap(), pty.has_client()), (vec![], false));
        }
    }

    #[test]
    fn a_terminal_that_nobody_reads_takes_no_more_at_some_point() {
        let pty = Pty::open().unwrap();
        let _client = File::options().read(true).write(true).open(pty.name()).unwrap();
        let filled =
            (0..10_000).try_for_each(|_| if pty.write(&[0; PIECE]).unwrap() == 0 { Err(()) } else { Ok(()) });
        assert_eq!(filled, Err(()));
    }
}
