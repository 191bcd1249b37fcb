//! A byte pipe within the process: the equivalent of a serial port for virtual devices and tests.

use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// A read from an empty pipe returns after this time, and so does a write to a full one.
const WAIT: Duration = Duration::from_millis(50);

struct State {
    bytes: VecDeque<u8>,
    capacity: usize,
    reader_gone: bool,
    writer_gone: bool,
}

struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        // Every holder of the lock leaves the state consistent.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State>, timeout: Duration) -> MutexGuard<'a, State> {
        self.changed.wait_timeout(state, timeout).unwrap_or_else(PoisonError::into_inner).0
    }
}

/// The end that bytes come out of.
pub struct PipeReader(Arc<Shared>);

/// The end that bytes go into.
pub struct PipeWriter(Arc<Shared>);

/// A pipe that holds `capacity` bytes.
pub fn pipe(capacity: usize) -> (PipeReader, PipeWriter) {
    let state = State { bytes: VecDeque::new(), capacity, reader_gone: false, writer_gone: false };
    let shared = Arc::new(Shared { state: Mutex::new(state), changed: Condvar::new() });
    (PipeReader(Arc::clone(&shared)), PipeWriter(shared))
}

impl PipeReader {
    /// Takes what is there, without waiting.
    pub fn take(&self, out: &mut [u8]) -> usize {
        let mut state = self.0.lock();
        let len = state.take(out);
        drop(state);
        if len > 0 {
            self.0.changed.notify_all();
        }
        len
    }

    /// Waits until there is something to take, at most `timeout`. Returns whether there is.
    pub fn wait_for_bytes(&self, timeout: Duration) -> bool {
        let empty = |state: &mut State| state.bytes.is_empty() && !state.writer_gone;
        let waited = self.0.changed.wait_timeout_while(self.0.lock(), timeout, empty);
        !waited.unwrap_or_else(PoisonError::into_inner).0.bytes.is_empty()
    }

    /// Whether the other end is gone and nothing is left.
    pub fn is_closed(&self) -> bool {
        let state = self.0.lock();
        state.writer_gone && state.bytes.is_empty()
    }
}

impl PipeWriter {
    /// Bytes that fit now.
    pub fn room(&self) -> usize {
        let state = self.0.lock();
        state.capacity - state.bytes.len()
    }

    /// Waits until `len` bytes fit, at most `timeout`. Returns true if they do, or if nobody reads any more.
    pub fn wait_for_room(&self, len: usize, timeout: Duration) -> bool {
        let full = |state: &mut State| state.capacity - state.bytes.len() < len && !state.reader_gone;
        let waited = self.0.changed.wait_timeout_while(self.0.lock(), timeout, full);
        !waited.unwrap_or_else(PoisonError::into_inner).1.timed_out()
    }

    /// Whether the other end is gone.
    pub fn is_closed(&self) -> bool {
        self.0.lock().reader_gone
    }
}

impl State {
    fn take(&mut self, out: &mut [u8]) -> usize {
        let (first, second) = self.bytes.as_slices();
        let from_first = first.len().min(out.len());
        out[..from_first].copy_from_slice(&first[..from_first]);
        let from_second = second.len().min(out.len() - from_first);
        out[from_first..from_first + from_second].copy_from_slice(&second[..from_second]);
        self.bytes.drain(..from_first + from_second);
        from_first + from_second
    }
}

impl Read for PipeReader {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let mut state = self.0.lock();
        if state.bytes.is_empty() && !state.writer_gone {
            state = self.0.wait(state, WAIT);
        }
        if state.bytes.is_empty() && !state.writer_gone {
            return Err(io::ErrorKind::TimedOut.into());
        }
        let len = state.take(out);
        drop(state);
        self.0.changed.notify_all();
        Ok(len)
    }
}

impl Write for PipeWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut state = self.0.lock();
        if state.bytes.len() == state.capacity && !state.reader_gone {
            state = self.0.wait(state, WAIT);
        }
        if state.reader_gone {
            return Err(io::ErrorKind::BrokenPipe.into());
        }
        let len = bytes.len().min(state.capacity - state.bytes.len());
        if len == 0 && !bytes.is_empty() {
            return Err(io::ErrorKind::TimedOut.into());
        }
        state.bytes.extend(&bytes[..len]);
        drop(state);
        self.0.changed.notify_all();
        Ok(len)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Drop for PipeReader {
    fn drop(&mut self) {
        self.0.lock().reader_gone = true;
        self.0.changed.notify_all();
    }
}

impl Drop for PipeWriter {
    fn drop(&mut self) {
        self.0.lock().writer_gone = true;
        self.0.changed.notify_all();
    }
}
