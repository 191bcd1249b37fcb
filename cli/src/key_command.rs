//! The user's command that computes an ECU's key from its seed.

use std::fmt::Write as _;
use std::io::{Read as _, Write as _};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};

use crate::commands::uds::hex::{Hex, bytes};
use cantap_work::interrupt;

/// How often to check whether the command has ended.
const LOOK_EVERY: Duration = Duration::from_millis(5);

/// The key that the command computes for a seed. While it does, `wait` passes the time, which may be what keeps a session. The command is ended
/// by Ctrl-C, or when it takes longer than `patience`: the ECU does not wait for ever either.
pub fn key(
    command: &str,
    seed: &[u8],
    patience: Duration,
    wait: impl FnMut(Duration) -> anyhow::Result<()>,
) -> anyhow::Result<Vec<u8>> {
    let seed = seed.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02X}");
        text
    });
    let line = command.replace("{seed}", &seed);
    let mut shell = if cfg!(windows) { Command::new("cmd") } else { Command::new("sh") };
    shell.args([if cfg!(windows) { "/C" } else { "-c" }, &line]).stdin(Stdio::piped()).stdout(Stdio::piped());
    let mut child = shell.spawn().context("cannot run the shell for --key-command")?;
    if let Some(mut stdin) = child.stdin.take() {
        // A command that takes the seed from its arguments may not read it.
        let _ = writeln!(stdin, "{seed}");
    }
    let mut stdout = child.stdout.take().context("cannot read from --key-command")?;
    let printed = std::thread::spawn(move || {
        let mut text = Vec::new();
        stdout.read_to_end(&mut text).map(|_| text)
    });
    let status = end_of(&mut child, command, patience, wait)?;
    ensure!(status.success(), "--key-command '{command}' failed: {status}; no key was sent");
    let printed = printed.join().ok().and_then(Result::ok).context("cannot read from --key-command")?;
    let text = String::from_utf8_lossy(&printed);
    match bytes(text.trim()) {
        Ok(Hex(key)) => Ok(key),
        Err(_) => {
            bail!(
                "--key-command '{command}' printed '{}', which is not a key in hexadecimal; no key was sent",
                text.trim()
            )
        }
    }
}

/// Waits for the command.
fn end_of(
    child: &mut Child,
    command: &str,
    patience: Duration,
    mut wait: impl FnMut(Duration) -> anyhow::Result<()>,
) -> anyhow::Result<ExitStatus> {
    let started = Instant::now();
    loop {
        if let Some(status) = child.try_wait().context("cannot wait for --key-command")? {
            return Ok(status);
        }
        let is_late = started.elapsed() >= patience;
        if is_late || interrupt::requested() {
            let _ = child.kill();
            let _ = child.wait();
        }
        ensure!(!interrupt::requested(), "ended by Ctrl-C during --key-command; no key was sent");
        ensure!(
            !is_late,
            "--key-command '{command}' did not end within {} s and was stopped; no key was sent; --patience gives it more time",
            patience.as_secs_f64()
        );
        let kept = wait(LOOK_EVERY);
        if kept.is_err() {
            let _ = child.kill();
            let _ = child.wait();
        }
        kept?;
    }
}
