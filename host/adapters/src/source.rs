//! A thread that reads from an adapter and notes when bytes arrived.

use std::io::{self, Read};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use cantap::device::is_idle;

/// Pieces that wait for the driver; then the thread stops reading, and the system's own buffers fill.
const PIECES: usize = 256;
/// Bytes of the longest piece.
const PIECE_BYTES: usize = 4096;

/// Something read, with the time of its arrival.
pub(crate) struct Piece<T> {
    /// When.
    pub at: Instant,
    /// What.
    pub content: T,
}

/// What a thread reads.
pub(crate) struct Source<T> {
    pieces: Receiver<Result<Piece<T>, String>>,
    /// The reason why no more comes.
    ended: Option<String>,
    quit: Arc<AtomicBool>,
    /// If its reads return soon, it is waited for, so that the port is free afterwards.
    thread: Option<JoinHandle<()>>,
}

impl<T: Send + 'static> Source<T> {
    /// Starts a thread that calls `read` until that fails; `Ok(None)` means that there is nothing yet. Only reads that return `in_time`, within
    /// a fraction of a second, are waited for at the end.
    pub fn start(
        in_time: bool,
        mut read: impl FnMut() -> Result<Option<T>, String> + Send + 'static,
    ) -> io::Result<Self> {
        let (sender, pieces) = sync_channel(PIECES);
        let quit = Arc::new(AtomicBool::new(false));
        let for_thread = Arc::clone(&quit);
        let thread = std::thread::Builder::new()
            .name("cantap-adapter-reader".to_owned())
            .spawn(move || while !for_thread.load(Ordering::Relaxed) && step(&mut read, &sender) {})?;
        Ok(Self { pieces, ended: None, quit, thread: in_time.then_some(thread) })
    }

    /// The next piece, if one comes in time. An error is the reason why there will be none.
    pub fn next(&mut self, wait: Duration) -> Result<Option<Piece<T>>, String> {
        if let Some(reason) = &self.ended {
            return Err(reason.clone());
        }
        let reason = match self.pieces.recv_timeout(wait) {
            Ok(Ok(piece)) => return Ok(Some(piece)),
            Err(RecvTimeoutError::Timeout) => return Ok(None),
            Ok(Err(reason)) => reason,
            Err(RecvTimeoutError::Disconnected) => "its reader has ended".to_owned(),
        };
        self.ended = Some(reason.clone());
        Err(reason)
    }
}

impl Source<Vec<u8>> {
    /// Reads bytes.
    pub fn of_bytes(mut reader: Box<dyn Read + Send>) -> io::Result<Self> {
        let mut buffer = vec![0; PIECE_BYTES];
        Self::start(true, move || match reader.read(&mut buffer) {
            Ok(0) => Err("it closed the connection".to_owned()),
            Ok(len) => Ok(Some(buffer[..len].to_vec())),
            Err(error) if is_idle(&error) => Ok(None),
            Err(error) => Err(error.to_string()),
        })
    }
}

impl<T> Drop for Source<T> {
    fn drop(&mut self) {
        self.quit.store(true, Ordering::Relaxed);
        // A thread that waits for room in the channel must find nobody there.
        self.pieces = sync_channel(0).1;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Reads once. Returns whether to go on.
fn step<T>(
    read: &mut impl FnMut() -> Result<Option<T>, String>,
    sender: &SyncSender<Result<Piece<T>, String>>,
) -> bool {
    match read() {
        Ok(None) => true,
        Ok(Some(content)) => sender.send(Ok(Piece { at: Instant::now(), content })).is_ok(),
        Err(reason) => {
            // If nobody listens, nobody needs the reason.
            let _ = sender.send(Err(reason));
            false
        }
    }
}
