//! The pipe from which Wireshark reads a capture.

use std::fs::{File, OpenOptions};
use std::io;
use std::path::Path;
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::{Duration, Instant};

use anyhow::Context;

use cantap_work::interrupt;

/// How often to check whether to continue.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// A pipe being opened, which waits until somebody reads it.
pub struct Opening(Receiver<io::Result<File>>);

impl Opening {
    /// Starts opening.
    pub fn start(path: &Path) -> anyhow::Result<Self> {
        let (sender, opened) = sync_channel(1);
        let path = path.to_owned();
        let open = move || {
            let opened = OpenOptions::new().write(true).open(&path);
            // If nobody waits any more, this closes it.
            let _ = sender.send(opened);
        };
        std::thread::Builder::new()
            .name("cantap-extcap-pipe".to_owned())
            .spawn(open)
            .context("the system refused a thread; close other programs and try again")?;
        Ok(Self(opened))
    }

    /// The pipe; `None` if the capture should end before anybody reads, or if nobody does within this time.
    pub fn wait(&self, patience: Duration) -> io::Result<Option<File>> {
        let deadline = Instant::now() + patience;
        loop {
            match self.0.recv_timeout(LOOK_EVERY) {
                Ok(opened) => return opened.map(Some),
                Err(RecvTimeoutError::Disconnected) => return Ok(None),
                Err(RecvTimeoutError::Timeout) if interrupt::requested() || Instant::now() >= deadline => {
                    return Ok(None);
                }
                Err(RecvTimeoutError::Timeout) => {}
            }
        }
    }
}
