//! Waits for keys, mouse and changes of size.
//!
//! crossterm's own wait never ends once the terminal is gone: every read then returns nothing, and it keeps reading. So on Unix this
//! module waits, and crossterm is only asked for what has arrived.

use std::io;
use std::time::Duration;

use ratatui::crossterm::event;

/// The result of waiting.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Waited {
    /// An event can be read.
    Event,
    /// Nothing came.
    Nothing,
    /// The terminal is gone.
    #[cfg_attr(not(unix), expect(dead_code, reason = "a console stays"))]
    Gone,
}

/// The terminal's input.
pub struct Keyboard {
    /// The source from which crossterm reads.
    #[cfg(unix)]
    terminal: Box<dyn std::os::fd::AsFd>,
}

impl Keyboard {
    /// The terminal that crossterm uses: standard input, or the controlling terminal if that is something
    /// else.
    #[cfg(unix)]
    pub fn new() -> io::Result<Self> {
        use std::io::IsTerminal;
        if io::stdin().is_terminal() {
            return Ok(Self { terminal: Box::new(io::stdin()) });
        }
        Ok(Self { terminal: Box::new(std::fs::File::open("/dev/tty")?) })
    }

    /// Waits for an event, at most this long.
    #[cfg(unix)]
    pub fn wait(&self, most: Duration) -> io::Result<Waited> {
        use rustix::event::{PollFd, PollFlags, Timespec, poll};
        let mut terminal = [PollFd::new(&self.terminal, PollFlags::IN)];
        let most = Timespec { tv_sec: most.as_secs() as i64, tv_nsec: most.subsec_nanos().into() };
        match poll(&mut terminal, Some(&most)) {
            // A signal, for example because the size has changed.
            Ok(_) | Err(rustix::io::Errno::INTR) => {}
            Err(error) => return Err(error.into()),
        }
        if terminal[0].revents().intersects(PollFlags::HUP | PollFlags::ERR | PollFlags::NVAL) {
            return Ok(Waited::Gone);
        }
        // Its events may already be in crossterm's queue. With a wait of zero it does not look at all.
        Ok(if event::poll(Duration::from_millis(1))? { Waited::Event } else { Waited::Nothing })
    }

    /// The only one.
    #[cfg(not(unix))]
    #[expect(clippy::unnecessary_wraps, reason = "it can fail elsewhere")]
    pub fn new() -> io::Result<Self> {
        Ok(Self {})
    }

    /// Waits for an event, at most this long.
    #[cfg(not(unix))]
    #[expect(clippy::unused_self, reason = "there is only one here")]
    pub fn wait(&self, most: Duration) -> io::Result<Waited> {
        Ok(if event::poll(most)? { Waited::Event } else { Waited::Nothing })
    }
}
