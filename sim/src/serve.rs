//! `--pty`: the emulated device as a serial port.

use std::io::{self, Write};
use std::time::Duration;

use cantap_sim::elf::Image;
use cantap_sim::run::Options;

/// Serves the device until it fails or `seconds` of emulated time are over.
#[cfg(unix)]
pub fn pty(image: Image, options: Options, seconds: Option<Duration>, real_time: bool) -> anyhow::Result<()> {
    use cantap_sim::link::{Manner, Pace, Served};
    use cantap_sim::pty::Pty;

    let pace = if real_time { Pace::RealTime } else { Pace::Client };
    let mut served = Served::start(image, options, Manner { pace, ..Manner::default() })?;
    let pty = Pty::open()?;
    let mut out = io::stdout().lock();
    writeln!(out, "{}", pty.name())?;
    out.flush()?;
    drop(out);
    served.until(seconds, &pty)?;
    Ok(())
}

/// There are no pseudo-terminals here.
#[cfg(not(unix))]
pub fn pty(_: Image, _: Options, _: Option<Duration>, _: bool) -> anyhow::Result<()> {
    anyhow::bail!("this system has no pseudo-terminals; use `cantap … -d emu:FIRMWARE.elf`")
}
