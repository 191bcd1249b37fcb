//! Waiting for keys, mouse and changes of size.
//!
//! crossterm's own wait never ends once the terminal is gone: every read then gives nothing, and it reads on. So on Unix the wait is
//! done here, and crossterm is only asked what has come.

use std::io;
use std::time::Duration;

use ratatui::crossterm::event;

/// What a wait comes to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Waited {
    /// An event can be read.
    Event,
    /// Nothing came.
    Nothing,
    /// There is no terminal any more.
    Gone,
}

/// The terminal's input.
pub struct Keyboard {
    /// Where crossterm reads from.
    #[cfg(unix)]
    terminal: Box<dyn std::os::fd::AsFd>,
}

impl Keyboard {
    /// The one that crossterm uses: standard input, or the controlling terminal if that is something else.
    #[cfg(unix)]
    pub fn new() -> io::Result<Self> {
        use std::io::IsTerminal;
        if io::stdin().is_terminal() {
            return Ok(Self { terminal: Box::new(io::stdin()) });
        }
        Ok(Self { terminal: Box::new(std::fs::File::open("/dev/tty")?) })
    }

    /// Waits for an event, at most for this time.
    #[cfg(unix)]
    pub fn wait(&self, most: Duration) -> io::Result<Waited> {
        use rustix::event::{PollFd, PollFlags, Timespec, poll};
        let mut terminal = [PollFd::new(&self.terminal, PollFlags::IN)];
        let most = Timespec { tv_sec: most.as_secs() as i64, tv_nsec: most.subsec_nanos().into() };
        match poll(&mut terminal, Some(&most)) {
            // A signal, as when the size has changed.
            Ok(_) | Err(rustix::io::Errno::INTR) => {}
            Err(error) => return Err(error.into()),
        }
        if terminal[0].revents().intersects(PollFlags::HUP | PollFlags::ERR | PollFlags::NVAL) {
            return Ok(Waited::Gone);
        }
        Ok(if event::poll(Duration::ZERO)? { Waited::Event } else { Waited::Nothing })
    }

    /// The one that there is.
    #[cfg(not(unix))]
    #[expect(clippy::unnecessary_wraps, reason = "it can fail elsewhere")]
    pub fn new() -> io::Result<Self> {
        Ok(Self {})
    }

    /// Waits for an event, at most for this time.
    #[cfg(not(unix))]
    #[expect(clippy::unused_self, reason = "there is only one here")]
    pub fn wait(&self, most: Duration) -> io::Result<Waited> {
        Ok(if event::poll(most)? { Waited::Event } else { Waited::Nothing })
    }
}
