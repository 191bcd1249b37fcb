//! Events become lines in a thread of their own: making them takes as long as reading the frames that they are of.

use std::io::{self, Write as _};
use std::sync::mpsc::{Receiver, Sender, SyncSender, channel, sync_channel};
use std::thread::{self, JoinHandle};

use cantap_protocols::Event;

use super::line;

/// Events that go to the thread together.
const BATCH: usize = 256;
/// Batches that may wait there. A reader of a pipe that is slow makes all else wait, and memory stays as it is.
const MOST_WAITING: usize = 4;

type Writer = JoinHandle<io::Result<()>>;

/// Writes events to standard output, in order.
pub(super) struct Lines {
    batch: Vec<Event>,
    /// Batches that were printed. They come back to be freed by the thread that allocated them: memory freed by another costs the allocator a lock.
    written: Receiver<Vec<Event>>,
    /// Taken when it ends.
    thread: Option<(SyncSender<Vec<Event>>, Writer)>,
}

impl Lines {
    /// As text or as JSON. The error is that there is no thread to be had.
    pub fn new(json: bool) -> io::Result<Self> {
        let (sender, receiver) = sync_channel(MOST_WAITING);
        let (done, written) = channel();
        let thread = thread::Builder::new().name("lines".to_owned());
        let handle = thread.spawn(move || run(&receiver, &done, json))?;
        Ok(Self { batch: Vec::with_capacity(BATCH), written, thread: Some((sender, handle)) })
    }

    /// Writes one. The error may be that of an earlier one.
    pub fn write(&mut self, event: Event) -> io::Result<()> {
        self.batch.push(event);
        if self.batch.len() < BATCH { Ok(()) } else { self.flush() }
    }

    /// Hands what was written to the thread, which prints it in its turn.
    pub fn flush(&mut self) -> io::Result<()> {
        let Some((sender, _)) = self.thread.as_ref().filter(|_| !self.batch.is_empty()) else {
            return Ok(());
        };
        let mut next = self.written.try_recv().unwrap_or_else(|_| Vec::with_capacity(BATCH));
        next.clear();
        let batch = std::mem::replace(&mut self.batch, next);
        // Nobody takes it any more where writing has failed: why, the thread says.
        sender.send(batch).or_else(|_| self.end())
    }

    /// Returns when everything is written.
    pub fn finish(mut self) -> io::Result<()> {
        self.flush()?;
        self.end()
    }

    fn end(&mut self) -> io::Result<()> {
        let Some((sender, handle)) = self.thread.take() else { return Ok(()) };
        drop(sender);
        match handle.join() {
            Ok(written) => written,
            Err(panic) => std::panic::resume_unwind(panic),
        }
    }
}

impl Drop for Lines {
    /// What was said before an error is shown, too.
    fn drop(&mut self) {
        if !thread::panicking() {
            let _ = self.flush();
            let _ = self.end();
        }
    }
}

/// The thread: each batch leaves as a whole.
fn run(batches: &Receiver<Vec<Event>>, done: &Sender<Vec<Event>>, json: bool) -> io::Result<()> {
    let mut out = io::stdout().lock();
    let mut text = String::new();
    for batch in batches {
        for event in &batch {
            line::push(&mut text, event, json);
        }
        out.write_all(text.as_bytes())?;
        out.flush()?;
        text.clear();
        // At the end nobody wants it.
        let _ = done.send(batch);
    }
    Ok(())
}
