//! Scripts as nodes on a real bus, through a device.

mod events;
mod port;
mod repeat;
mod repeated;
mod run;
mod run_clock;
mod settings;
mod thread;
mod thread_port;

use cantap::{Device, TraceRecord};

use crate::node::{Script, ScriptError};
use crate::report::{Message, Report};

pub use events::{ScriptCounts, ScriptEvent};
use run::Keys;
pub use run::LiveRun;
pub use settings::{BrokenOff, Live, LiveError};
pub use thread::ScriptThread;

impl Live {
    /// Runs scripts on the open channels of a device, which have to be in normal mode to send. Times are those of the device's clock, by which
    /// scripts have their turns, too, as soon as this computer comes to it; what the device repeats by itself keeps its clock exactly.
    ///
    /// `keys` returns the next key that the user has typed, if there is one; without it, none come.
    ///
    /// At the end, however it comes, nothing is repeated any more.
    ///
    /// # Errors
    /// If a script is not in the language, or the device is gone, with the report until then; what else goes wrong is in the report.
    pub fn run(
        &self,
        device: &Device,
        scripts: &[Script],
        on_record: &mut dyn FnMut(TraceRecord),
        on_message: &mut dyn FnMut(Message),
        keys: Option<&mut dyn FnMut() -> Option<char>>,
        goes_on: &mut dyn FnMut() -> bool,
    ) -> Result<Report, Box<BrokenOff>> {
        if scripts.is_empty() {
            return Err(broken_off(ScriptError::None.into(), Report::default()));
        }
        let mut run = self.start(device);
        if let ([_], [(channel, _)]) = (scripts, &device.open_channels()[..]) {
            run.let_device_reply(*channel, device.hello().trigger_slots);
        }
        for script in scripts {
            run.add(script).map_err(|error| broken_off(error.into(), Report::default()))?;
        }
        let keys = keys.map(|next| Box::new(next) as Keys<'_>);
        let result = run.go(device.records(), self.duration, on_record, on_message, keys, goes_on);
        let (report, messages) = run.finish();
        messages.into_iter().for_each(on_message);
        match result {
            Ok(()) => Ok(report),
            Err(error) => Err(broken_off(error, report)),
        }
    }
}

fn broken_off(error: LiveError, report: Report) -> Box<BrokenOff> {
    Box::new(BrokenOff { error, report })
}
