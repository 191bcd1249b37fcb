//! `--pty`: the emulated device as a serial port.

use std::time::Duration;

use cantap_emu::elf::Image;
use cantap_sim::run::Options;

#[cfg(unix)]
pub use terminal::pty;

#[cfg(unix)]
mod terminal {
    use std::io::{self, Write};
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};

    use cantap_sim::link::{Client, Manner, Pace, Served};
    use cantap_sim::pty::Pty;

    use super::{Duration, Image, Options};

    /// What shells report for a program that Ctrl-C ended.
    const ENDED_BY_SIGNAL: i32 = 130;

    /// Serves the device until it fails, until `seconds` of emulated time are over, or until the user or the system
    /// asks it to end.
    pub fn pty(
        image: Image,
        options: Options,
        seconds: Option<Duration>,
        real_time: bool,
    ) -> anyhow::Result<()> {
        let pace = if real_time { Pace::RealTime } else { Pace::Client };
        let mut served = Served::start(image, options, Manner { pace, ..Manner::default() })?;
        let client = UntilAsked { pty: Pty::open()?, asked: watch()? };
        let mut out = io::stdout().lock();
        writeln!(out, "{}", client.pty.name())?;
        out.flush()?;
        drop(out);
        let end = served.until(seconds, &client);
        if client.is_asked() { Ok(()) } else { Ok(end?) }
    }

    /// From now on Ctrl-C and the system's polite request to end (SIGTERM) set a flag. Asked twice, the program ends at
    /// once.
    fn watch() -> anyhow::Result<Arc<AtomicBool>> {
        let asked = Arc::new(AtomicBool::new(false));
        let flag = Arc::clone(&asked);
        ctrlc::set_handler(move || {
            if flag.swap(true, Ordering::Relaxed) {
                std::process::exit(ENDED_BY_SIGNAL);
            }
        })?;
        Ok(asked)
    }

    /// A terminal, until it is asked to end.
    struct UntilAsked {
        pty: Pty,
        asked: Arc<AtomicBool>,
    }

    impl UntilAsked {
        fn is_asked(&self) -> bool {
            self.asked.load(Ordering::Relaxed)
        }
    }

    impl Client for UntilAsked {
        fn receive(&self) -> io::Result<Vec<u8>> {
            if self.is_asked() { Err(io::ErrorKind::BrokenPipe.into()) } else { self.pty.read() }
        }

        fn deliver(&self, bytes: &[u8]) -> io::Result<usize> {
            self.pty.write(bytes)
        }

        fn is_open(&self) -> bool {
            self.pty.has_client()
        }
    }
}

/// There are no pseudo-terminals here.
#[cfg(not(unix))]
pub fn pty(_: Image, _: Options, _: Option<Duration>, _: bool) -> anyhow::Result<()> {
    anyhow::bail!("this system has no pseudo-terminals; use `cantap … -d emu:FIRMWARE.elf`")
}
