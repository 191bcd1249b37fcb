//! Asks a vehicle on the first device, while its page is shown.

use std::time::Duration;

use cantap::{Device, TraceRecord};
use cantap_work::advice;
use cantap_work::obd::{Asked, Asking, AskingState};

use super::{Source, lock};

/// As `cantap obd` has them without options.
const P2: Duration = Duration::from_millis(200);
const PERIOD: Duration = Duration::from_secs(1);

impl Source<'_> {
    /// Begins to ask, or ends it.
    pub(super) fn ask(&mut self, device: Option<&Device>, on: bool) {
        if !on {
            if let Some(asking) = &mut self.asking {
                asking.leave();
            }
            return;
        }
        let Some(device) = device else {
            return self.asking_ended("there is no device to ask with; open one with D");
        };
        let open = device.open_channels().into_iter();
        // Whatever the display believes: nothing is sent where the device only listens.
        let channels = open.filter(|(_, config)| config.mode.transmits()).map(|(channel, _)| channel);
        match Asking::new(channels, P2, PERIOD) {
            Some(asking) => self.asking = Some(asking),
            None => self.asking_ended("every channel only listens; m takes part in the bus"),
        }
    }

    /// Sends what is due, and shows what has come.
    pub(super) fn go_on_asking(&mut self, device: &Device) {
        let Some(asking) = &mut self.asking else { return };
        let result = asking.go_on(device);
        let (asked, is_over) = (asking.take_asked(), asking.is_over());
        if !asked.is_empty() {
            lock(self.model).vehicle.take(asked);
        }
        match result {
            Err(error) => self.forget_asking(&advice::explained(&error)),
            Ok(()) if is_over => self.asking = None,
            Ok(()) => {}
        }
    }

    /// Passes on the device's records.
    pub(super) fn show_to_asking(&mut self, records: &[TraceRecord]) {
        if let Some(asking) = &mut self.asking {
            asking.take(records);
        }
    }

    /// The device's session is over.
    pub(super) fn forget_asking(&mut self, reason: &str) {
        if self.asking.take().is_some() && lock(self.model).vehicle.state.is_on() {
            self.asking_ended(reason);
        }
    }

    pub(super) fn asking_ended(&self, reason: &str) {
        let state = AskingState::Ended(reason.trim_end_matches('.').to_owned());
        lock(self.model).vehicle.take(vec![Asked::State(state)]);
    }

    /// Whether an answer is awaited.
    pub(super) fn awaits_an_answer(&self) -> bool {
        self.asking.as_ref().is_some_and(Asking::is_urgent)
    }
}
