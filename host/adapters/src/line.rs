//! A byte stream to an adapter: a serial port or a TCP connection.

use std::io::{self, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

use cantap::device::Link;

use crate::driver::OpenError;
use crate::source::{Piece, Source};

/// A read returns after this time.
const READ_TIMEOUT: Duration = Duration::from_millis(50);
/// Time limit for a connection, for each address of a host's name.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// A line that takes no bytes for this long hangs.
const WRITE_TIMEOUT: Duration = Duration::from_secs(1);

/// Both directions.
pub(crate) struct Line {
    writer: Box<dyn Write + Send>,
    source: Source<Vec<u8>>,
    /// The first failure to write.
    failed: Option<String>,
}

impl Line {
    /// Over any stream.
    pub fn over(link: Link) -> io::Result<Self> {
        let Link { reader, writer, keep_alive: _ } = link;
        Ok(Self { writer, source: Source::of_bytes(reader)?, failed: None })
    }

    /// On a serial port.
    pub fn serial(port: &str, baud: u32) -> Result<Self, OpenError> {
        let link = cantap::device::open_port_at(port, baud)?;
        Self::over(link).map_err(|source| OpenError::Unreachable { address: port.to_owned(), source })
    }

    /// To `HOST:PORT`.
    pub fn tcp(place: &str) -> Result<Self, OpenError> {
        connect(place)
            .and_then(|stream| Self::over(Link::new(stream.try_clone()?, stream)))
            .map_err(|source| OpenError::Unreachable { address: place.to_owned(), source })
    }

    /// Writes all of it. A failure ends the adapter at the next [`Line::next`].
    pub fn write(&mut self, bytes: &[u8]) {
        if self.failed.is_none()
            && let Err(error) = cantap::device::write_patiently(&mut *self.writer, bytes, WRITE_TIMEOUT)
        {
            self.failed = Some(error.to_string());
        }
    }

    /// What arrives within `wait`, if anything.
    pub fn next(&mut self, wait: Duration) -> Result<Option<Piece<Vec<u8>>>, String> {
        match &self.failed {
            Some(reason) => Err(reason.clone()),
            None => self.source.next(wait),
        }
    }

    /// Throws away what arrives, until nothing has for this long; or, if it goes on, until ten times that.
    pub fn discard(&mut self, quiet: Duration) -> Result<(), String> {
        let deadline = Instant::now() + 10 * quiet;
        while self.next(quiet)?.is_some() && Instant::now() < deadline {}
        Ok(())
    }
}

fn connect(place: &str) -> io::Result<TcpStream> {
    let mut last = io::Error::new(io::ErrorKind::NotFound, "the name has no address");
    for address in place.to_socket_addrs()? {
        match TcpStream::connect_timeout(&address, CONNECT_TIMEOUT) {
            Ok(stream) => {
                stream.set_read_timeout(Some(READ_TIMEOUT))?;
                stream.set_write_timeout(Some(READ_TIMEOUT))?;
                stream.set_nodelay(true)?;
                return Ok(stream);
            }
            Err(error) => last = error,
        }
    }
    Err(last)
}
