//! The scripts of a session: those that run, and the periodic entries that they share with the send list.

use std::collections::BTreeSet;

use cantap::device::channel_number;
use cantap::{Channel, Device, TraceRecord};
use cantap_scripts::{Live, Script, ScriptThread};
use cantap_work::gateway::Named;

/// The device that scripts run on.
pub(super) const BOARD: usize = 0;

/// The scripts that run.
pub(super) struct Running {
    pub thread: ScriptThread,
    /// By place.
    pub names: Vec<String>,
}

/// The scripts of a session.
#[derive(Default)]
pub(super) struct SessionScripts {
    pub running: Option<Running>,
    /// The device's periodic entries that the send list has, by channel and slot.
    entries: BTreeSet<(usize, u8)>,
    /// The names of the gateway's rules, while their number is the same.
    pub rules: Option<Named>,
}

impl SessionScripts {
    /// Whether any runs: what they want is not to wait then.
    pub fn are_running(&self) -> bool {
        self.running.is_some()
    }

    /// Takes a periodic entry of the device for the send list; false if a script has it.
    pub fn claim(&mut self, channel: Channel, slot: u8) -> bool {
        let is_free = self.running.as_ref().is_none_or(|running| running.thread.claim(channel, slot));
        if is_free {
            self.entries.insert((channel.index(), slot));
        }
        is_free
    }

    /// An entry of the send list has ended.
    pub fn release(&mut self, channel: Channel, slot: u8) {
        self.entries.remove(&(channel.index(), slot));
        if let Some(running) = &self.running {
            running.thread.release(channel, slot);
        }
    }

    /// Hands the device's records to the scripts.
    pub fn take(&mut self, records: &[TraceRecord]) {
        let is_last = channel_number(BOARD, Channel::ALL[Channel::ALL.len() - 1]);
        if let Some(running) = &mut self.running {
            if records.iter().all(|record| record.channel <= is_last) {
                running.thread.take(records);
            } else {
                let own: Vec<_> =
                    records.iter().filter(|record| record.channel <= is_last).copied().collect();
                running.thread.take(&own);
            }
        }
    }

    pub fn key(&self, key: char) {
        if let Some(running) = &self.running {
            running.thread.key(key);
        }
    }

    pub fn start(&mut self, live: &Live, device: &Device, script: Script) -> Result<(), String> {
        let running = match &mut self.running {
            Some(running) => running,
            none => {
                let thread = ScriptThread::start(live, device).map_err(|error| error.to_string())?;
                for (channel, slot) in &self.entries {
                    // Nobody else has any yet.
                    let _ = thread.claim(Channel::ALL[*channel], *slot);
                }
                none.insert(Running { thread, names: Vec::new() })
            }
        };
        let name = script.name.clone();
        running.thread.add(script).map_err(|error| error.to_string())?;
        running.names.push(name);
        Ok(())
    }

    /// Ends a script; whether it ran.
    pub fn stop(&mut self, name: &str) -> bool {
        let Some(running) = &mut self.running else { return false };
        // The last one: it may have been started several times.
        let Some(place) = running.names.iter().rposition(|own| own == name) else { return false };
        running.thread.end(place);
        true
    }
}
