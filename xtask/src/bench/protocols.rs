//! Frames per second that all protocols read together. The measurement is an example of cantap-protocols, so that it can also be run
//! by itself.

use anyhow::Result;
use xshell::cmd;

/// Fails if a bus is read more slowly than required.
pub(super) fn run() -> Result<()> {
    println!("Protocols: buses as a survey finds them, and with every protocol on every channel");
    let shell = crate::workspace::shell()?;
    cmd!(shell, "cargo run --release --quiet -p cantap-protocols --example speed").quiet().run()?;
    Ok(())
}
