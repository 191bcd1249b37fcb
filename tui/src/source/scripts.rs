//! Scripts on the first device: in a thread of their own, so that none of them holds up the records.

use std::collections::BTreeSet;
use std::sync::Arc;

use cantap::device::channel_number;
use cantap::wire::message::capability;
use cantap::{Channel, Device, DeviceError, TraceRecord};
use cantap_scripts::{Live, LiveError, Script, ScriptEvent, ScriptThread};
use cantap_work::advice;
use cantap_work::gateway::{Counts, Named, state_name};

use super::super::model::{LineKind, ScriptState};
use super::{Source, lock};

/// The device that scripts run on.
pub(super) const BOARD: usize = 0;

/// The scripts that run.
struct Running {
    thread: ScriptThread,
    /// By place.
    names: Vec<String>,
}

/// The scripts of a session.
#[derive(Default)]
pub(super) struct SessionScripts {
    running: Option<Running>,
    /// The device's periodic entries that the send list has, by channel and slot.
    entries: BTreeSet<(usize, u8)>,
    /// The names of the gateway's rules, while their number is the same.
    rules: Option<Named>,
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

    fn start(&mut self, live: &Live, device: &Device, script: Script) -> Result<(), String> {
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
    fn stop(&mut self, name: &str) -> bool {
        let Some(running) = &mut self.running else { return false };
        // The last one: it may have been started several times.
        let Some(place) = running.names.iter().rposition(|own| own == name) else { return false };
        running.thread.end(place);
        true
    }
}

impl Source<'_> {
    pub(super) fn start_script(&mut self, device: &Device, script: Script) {
        let decoder = Arc::clone(lock(self.model).seen.signals.decoder());
        let name = script.name.clone();
        lock(self.model).scripts.begin(&name);
        let live = Live { decoder, seed: 0, duration: None };
        if let Err(error) = self.scripts.start(&live, device, script) {
            lock(self.model).scripts.fail(&name, &error);
        }
    }

    pub(super) fn stop_script(&mut self, name: &str) {
        if self.scripts.stop(name) {
            let mut model = lock(self.model);
            model.scripts.set_state(name, ScriptState::Stopped);
            model.scripts.say(LineKind::Note, &format!("{name}: stopped"));
        }
    }

    /// Does what the scripts want, and shows what they have done.
    pub(super) fn serve_scripts(&mut self, device: &Device) {
        let Some(running) = &mut self.scripts.running else { return };
        let mut events = Vec::new();
        let result = running.thread.serve(device, &mut events);
        let is_over = running.thread.is_over();
        self.show_script_events(events);
        match result {
            Err(error) => {
                let reason = match &error {
                    LiveError::Device(error) => advice::explained(error),
                    error => error.to_string(),
                };
                self.end_scripts(Some(device), &reason);
            }
            Ok(()) if is_over => self.end_scripts(Some(device), ""),
            Ok(()) => {}
        }
    }

    /// Ends all that run, for this reason.
    pub(super) fn end_scripts(&mut self, device: Option<&Device>, reason: &str) {
        let Some(Running { thread, names }) = self.scripts.running.take() else { return };
        let last = thread.finish(device);
        let mut model = lock(self.model);
        for name in names {
            if model.scripts.is_running(&name) {
                model.scripts.fail(&name, reason);
            }
        }
        for event in last {
            match event {
                ScriptEvent::Message(message) => {
                    let text =
                        format!("{:.6} {}: {}", message.at_ns as f64 / 1e9, message.script, message.text);
                    model.scripts.say(LineKind::Log, &text);
                }
                ScriptEvent::Counts(counts) => model.scripts.counts = counts,
                _ => {}
            }
        }
    }

    /// The session with the device is over, and with it what belongs to it.
    pub(super) fn forget_scripts(&mut self, device: Option<&Device>, reason: &str) {
        self.end_scripts(device, reason);
        self.scripts = SessionScripts::default();
        lock(self.model).scripts.gateway.clear();
    }

    fn show_script_events(&self, events: Vec<ScriptEvent>) {
        if events.is_empty() {
            return;
        }
        let Some(Running { names, .. }) = &self.scripts.running else { return };
        let mut model = lock(self.model);
        let scripts = &mut model.scripts;
        // A place of which there was an earlier one with this name is no longer the script in the list.
        let is_current = |place: usize| names.iter().rposition(|own| *own == names[place]) == Some(place);
        for event in events {
            match event {
                ScriptEvent::Message(message) => {
                    let text =
                        format!("{:.6} {}: {}", message.at_ns as f64 / 1e9, message.script, message.text);
                    scripts.say(LineKind::Log, &text);
                }
                // It may have been stopped meanwhile.
                ScriptEvent::TestBegan { place, name }
                    if is_current(place) && scripts.is_running(&names[place]) =>
                {
                    scripts.set_state(&names[place], ScriptState::Running(Some(name)));
                }
                ScriptEvent::Test(test) => scripts.take_test(&test),
                ScriptEvent::Ended { place, error: None } if is_current(place) => {
                    scripts.set_state(&names[place], ScriptState::Ended);
                    scripts.say(LineKind::Note, &format!("{}: ended", names[place]));
                }
                ScriptEvent::Ended { place, error: Some(error) } if is_current(place) => {
                    scripts.fail(&names[place], &error);
                }
                ScriptEvent::Refused { place, error } if is_current(place) => {
                    scripts.fail(&names[place], &advice::explained(&error));
                }
                ScriptEvent::Counts(counts) => scripts.counts = counts,
                ScriptEvent::TestBegan { .. } | ScriptEvent::Ended { .. } | ScriptEvent::Refused { .. } => {}
            }
        }
    }

    /// Shows the gateway's rules and counts, if the device is one.
    pub(super) fn show_gateway(&mut self, device: &Device) {
        if device.hello().capabilities & capability::GATEWAY == 0 {
            return;
        }
        // If it does not answer, the stream reports that.
        if let Ok(lines) = gateway(device, &mut self.scripts.rules) {
            lock(self.model).scripts.gateway = lines;
        }
    }
}

fn gateway(device: &Device, rules: &mut Option<Named>) -> Result<Vec<String>, DeviceError> {
    let mut count = 0;
    for from in Channel::ALL {
        count += usize::from(device.gateway_status(from, 0)?.rules);
    }
    if count == 0 {
        return Ok(Vec::new());
    }
    let named = match rules {
        Some(named) if named.rows.len() == count => named,
        rules => rules.insert(Named::of_device(device)?),
    };
    let counts = Counts::of(device, named)?;
    let by = if counts.standalone { ", by the device on its own" } else { "" };
    let state = format!("Gateway {}{by}. {}", state_name(counts.state), counts.line());
    Ok(std::iter::once(state).chain(counts.table(named)).collect())
}
