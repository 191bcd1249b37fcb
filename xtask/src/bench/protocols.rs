//! Frames per second that all protocols read together. The measurement is an example of cantap-protocols, so that it can be run alone.

use anyhow::Result;
use xshell::cmd;

/// Fails where a bus is read more slowly than was asked for.
pub(super) fn run() -> Result<()> {
    println!("Protocols: buses as a survey finds them, and with every protocol on every channel");
    let shell = crate::workspace::shell()?;
    cmd!(shell, "cargo run --release --quiet -p cantap-protocols --example speed").quiet().run()?;
    Ok(())
}
