//! Scripts on the first device: in a thread of their own, so that none of them holds up the records.

use std::sync::Arc;

use cantap::wire::message::capability;
use cantap::{Channel, Device, DeviceError};
use cantap_scripts::{Live, LiveError, Script, ScriptEvent};
use cantap_work::advice;
use cantap_work::gateway::{Counts, Named, state_name};

use super::super::model::{LineKind, ScriptState};
use super::session_scripts::{Running, SessionScripts};
use super::{Source, lock};

impl Source<'_> {
    pub(super) fn start_script(&mut self, device: &Device, script: Script) {
        let decoder = Arc::clone(lock(self.model).seen.signals.decoder());
        let name = script.name.clone();
        lock(self.model).scripts.begin(&name);
        let live = Live { decoder, seed: 0, readable: None, duration: None };
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
