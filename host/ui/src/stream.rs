//! What a browser's connection has to be able to do, encrypted or not.

use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::time::Duration;

/// A connection. A read or write that waits in vain ends with [`WouldBlock`](io::ErrorKind::WouldBlock) or
/// [`TimedOut`](io::ErrorKind::TimedOut).
pub trait Stream: Read + Write + Send {
    /// How long a read waits. It may end earlier.
    ///
    /// # Errors
    ///
    /// If the connection has ended.
    fn set_read_timeout(&self, timeout: Duration) -> io::Result<()>;
}

impl Stream for TcpStream {
    fn set_read_timeout(&self, timeout: Duration) -> io::Result<()> {
        Self::set_read_timeout(self, Some(timeout))
    }
}

/// Whether a read or write has only waited in vain.
pub(crate) fn is_idle(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut | io::ErrorKind::Interrupted)
}

/// A connection on which something is answered.
pub type Connection = Box<dyn Stream>;
