//! Security access: the ECU's seed goes to the user's command, and the command's key to the ECU.

use super::hex::byte;
use crate::key_command;
use cantap_work::uds::Client;

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
        let patience = client.patience();
        let key = key_command::key(command, seed, patience, |time| client.wait(time))?;
        client.ask(&[&[0x27, level + 1][..], &key].concat())?;
        client.all_agreed()
    }
}
