//! Security access: the ECU's seed goes to the user's command, and the command's key to the ECU.

use std::fmt::Write as _;
use std::io::{Read as _, Write as _};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};

use super::hex::{Hex, byte, bytes};
use cantap_work::interrupt;
use cantap_work::uds::Client;

/// How often to check whether the command has ended.
const LOOK_EVERY: Duration = Duration::from_millis(5);

/// How to unlock the ECU; commands flatten this into their arguments.
#[derive(clap::Args, Clone)]
pub struct KeyArgs {
    /// Then unlock the ECU at this level: an odd number in hexadecimal, as 1. Requires --key-command.
    #[arg(long, value_name = "LEVEL", value_parser = level, requires = "key_command", global = true)]
    security: Option<u8>,
    /// A command that computes the key: it gets the seed in hexadecimal on standard input, and in place of {seed}, and prints the key
    /// in hexadecimal.
    #[arg(long, value_name = "COMMAND", global = true)]
    key_command: Option<String>,
}

/// See [`KeyArgs`].
pub fn level(text: &str) -> Result<u8, String> {
    let level = byte(text).ok().filter(|level| level % 2 == 1 && *level < 0x7F);
    level.ok_or_else(|| "levels are odd numbers from 1 to 7D, in hexadecimal".to_owned())
}

impl KeyArgs {
    /// Whether there is a command that computes keys.
    pub const fn has_command(&self) -> bool {
        self.key_command.is_some()
    }

    /// Unlocks it, if requested.
    pub fn unlock(&self, client: &mut Client<'_>) -> anyhow::Result<()> {
        self.security.map_or(Ok(()), |level| self.unlock_at(level, client))
    }

    /// Unlocks it at this level. A session that is open is kept while the key is computed.
    pub fn unlock_at(&self, level: u8, client: &mut Client<'_>) -> anyhow::Result<()> {
        let Some(command) = &self.key_command else { return Ok(()) };
        let answer = client.ask_and_show(&[0x27, level])?;
        let seed = answer.data.get(2..).unwrap_or_default();
        // An ECU that is already unlocked sends a seed of zeros (ISO 14229-1).
        if seed.iter().all(|byte| *byte == 0) {
            return Ok(());
        }
        let key = key(command, seed, client)?;
        client.ask(&[&[0x27, level + 1][..], &key].concat())?;
        client.all_agreed()
    }
}

fn key(command: &str, seed: &[u8], client: &mut Client<'_>) -> anyhow::Result<Vec<u8>> {
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
    let status = end_of(&mut child, command, client)?;
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

/// Waits for the command, which is ended by Ctrl-C or when it takes too long: the ECU does not wait for ever either.
fn end_of(child: &mut Child, command: &str, client: &mut Client<'_>) -> anyhow::Result<ExitStatus> {
    let (started, patience) = (Instant::now(), client.patience());
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
        let kept = client.wait(LOOK_EVERY);
        if kept.is_err() {
            let _ = child.kill();
            let _ = child.wait();
        }
        kept?;
    }
}
