//! A trace that is read by a thread of its own, a few batches ahead of whoever goes through them.

use std::panic;
use std::sync::mpsc::{Receiver, Sender, SyncSender, channel, sync_channel};
use std::thread::{self, JoinHandle};

use cantap_trace::{PlainFrame, TraceRecord};
use pyo3::prelude::*;

use crate::error::Error;
use crate::source::TraceSource;

/// As many as are read while a database is loaded: three megabytes of frames.
const BATCHES: usize = 32;

/// What is read at a time: frames first, then records.
#[derive(Default)]
pub struct Batch {
    pub frames: Vec<PlainFrame>,
    pub records: Vec<TraceRecord>,
    /// Which of the trace's files they are from.
    pub file: usize,
}

/// The thread and its batches.
pub struct Ahead {
    batches: Option<Receiver<Batch>>,
    /// Batches that were gone through, whose memory is used again.
    used: Sender<Batch>,
    thread: Option<JoinHandle<Result<(), Error>>>,
}

impl Ahead {
    /// Begins to read.
    pub fn read(source: TraceSource) -> Result<Self, Error> {
        let (filled, batches) = sync_channel(BATCHES);
        let (used, again) = channel();
        let thread = thread::Builder::new().name("cantap reader".to_owned());
        let thread = thread.spawn(move || fill(source, &filled, &again));
        let thread = thread.map_err(|error| Error::Io(error, "a thread that reads".to_owned()))?;
        Ok(Self { batches: Some(batches), used, thread: Some(thread) })
    }

    /// The next batch; `None` at the end. Its memory goes back by [`Self::give_back`].
    pub fn next(&mut self) -> Result<Option<Batch>, Error> {
        if let Some(batch) = self.batches.as_ref().and_then(|batches| batches.recv().ok()) {
            return Ok(Some(batch));
        }
        self.end()?;
        Ok(None)
    }

    /// Hands a batch back that is not needed any more.
    pub fn give_back(&self, batch: Batch) {
        // At the file's end nobody wants it.
        let _ = self.used.send(batch);
    }

    /// Waits for the thread, which ends when nobody takes its batches.
    fn end(&mut self) -> Result<(), Error> {
        self.batches = None;
        match self.thread.take().map(JoinHandle::join) {
            None => Ok(()),
            Some(Ok(result)) => result,
            Some(Err(panicked)) => panic::resume_unwind(panicked),
        }
    }
}

impl Drop for Ahead {
    fn drop(&mut self) {
        self.batches = None;
        if let Some(thread) = self.thread.take() {
            // Given up on: what it could not read is of no interest. It may be waiting for Python, to read from one of its objects.
            let mut thread = Some(thread);
            let joined = Python::try_attach(|py| py.detach(|| thread.take().map(JoinHandle::join)));
            if joined.is_none() {
                let _ = thread.map(JoinHandle::join);
            }
        }
    }
}

fn fill(mut source: TraceSource, filled: &SyncSender<Batch>, again: &Receiver<Batch>) -> Result<(), Error> {
    loop {
        let mut batch = again.try_recv().unwrap_or_default();
        let more = source.next_mixed(&mut batch.frames, &mut batch.records)?;
        batch.file = source.file();
        if filled.send(batch).is_err() || !more {
            return Ok(());
        }
    }
}
