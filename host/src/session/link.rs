//! The byte stream to a device, whatever carries it.

use std::any::Any;
use std::io::{self, Read, Write};

/// Both directions of a byte stream, to be used from two threads.
///
/// Reading must return within a fraction of a second: with bytes, or, while there are none, with a
/// [`TimedOut`](io::ErrorKind::TimedOut) or [`WouldBlock`](io::ErrorKind::WouldBlock) error. No bytes
/// (`Ok(0)`) or any other error means that the other end is gone.
pub struct Link {
    /// From the device.
    pub reader: Box<dyn Read + Send>,
    /// To the device.
    pub writer: Box<dyn Write + Send>,
    /// What must live as long as the stream is in use, such as the thread of a virtual device.
    pub keep_alive: Box<dyn Any + Send>,
}

impl Link {
    /// A stream of two halves with nothing behind them.
    pub fn new(reader: impl Read + Send + 'static, writer: impl Write + Send + 'static) -> Self {
        Self { reader: Box::new(reader), writer: Box::new(writer), keep_alive: Box::new(()) }
    }

    /// The same, but `keep` is dropped only after both halves.
    #[must_use]
    pub fn keeping(mut self, keep: impl Any + Send) -> Self {
        self.keep_alive = Box::new(keep);
        self
    }
}

/// Whether a read merely found nothing yet.
pub fn is_idle(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::TimedOut | io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted)
}
